"""Schedules: arms that move at the same time, in closed-form cases and against an independent check."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework import Assembly, Direction, plan_robots
from falsework.errors import InputError, PlanError
from falsework.robots import Cell, HybridSettings, Precedence, RobotPlan, nodes_of, schedule_plan, simulate
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.keyframes.failure_report import Explanation
from falsework.robots.keyframes.keyframe_graph import KeyframeSettings
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.planning.hybrid_search import HybridSearch
from falsework.robots.plans.robot_plan_file import load_robot_plan, robot_plan_to_dict, save_robot_plan
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import arm_shares, event_times
from falsework.search.problem.deadline import Deadline
from tests.older_files import as_robot_version_2
from tests.robots.plans.orders import APART
from tests.robots.plans.sampled_schedule import check_schedule


@pytest.fixture(scope="module")
def planned(planned_in_turn: Callable[[Assembly, Cell], RobotPlan], row: Assembly, wide: Cell) -> RobotPlan:
    """A plan for them that lets both arms work, one after the other."""
    return planned_in_turn(row, wide)


@pytest.fixture(scope="module")
def scheduled(planned: RobotPlan, row: Assembly, wide: Cell) -> RobotPlan:
    """The same with both at once."""
    return schedule_plan(planned, row, wide)


def graph_of(plan: RobotPlan) -> TemporalPlanGraph:
    """Its schedule."""
    assert plan.schedule is not None
    return plan.schedule


@pytest.mark.usefixtures("without_numba")
def test_arguments_have_the_types_of_the_portable_code(row: Assembly, wide: Cell) -> None:
    """Numba, which takes twenty seconds where LLVM takes two, compiles nothing for a plan and its schedule."""
    plan = plan_robots(row, wide, settings=HybridSettings(Direction.DISASSEMBLY, seed=1), concurrent=True).value
    assert plan is not None
    assert plan.schedule is not None


def test_both_arms_work_and_the_makespan_shrinks(planned: RobotPlan, scheduled: RobotPlan) -> None:
    graph = graph_of(scheduled)
    assert {step.robot for step in planned.steps} == {0, 1}
    assert graph.sequential == pytest.approx(planned.seconds)
    assert graph.lower_bound <= graph.makespan + 1e-3 < 0.9 * planned.seconds
    busiest = max(sum(graph.nodes[k].seconds for k in graph.of_robot(robot)) for robot in (0, 1))
    assert graph.makespan >= busiest - 1e-9


def test_states_come_in_their_order(scheduled: RobotPlan) -> None:
    events = event_times(scheduled, graph_of(scheduled))
    assert len(events) == len(scheduled)
    assert (np.diff(events) >= 0).all()


def test_the_independent_check_agrees(scheduled: RobotPlan, row: Assembly, wide: Cell) -> None:
    report = check_robot_plan(scheduled, row, wide)
    assert report.good, report.problems
    assert report.delays is not None
    assert report.delays.overlaps > 0
    judge = PinocchioCollisionChecker(wide, place_parts(row), 0.001)
    nodes = len(graph_of(scheduled).nodes)
    for seed in range(3):
        problems, _ = check_schedule(scheduled, wide, judge, stretch=1 + np.random.default_rng(seed).random(nodes))
        assert not problems


def test_the_check_finds_arms_that_do_not_wait(scheduled: RobotPlan, row: Assembly, wide: Cell) -> None:
    graph, nodes = graph_of(scheduled), nodes_of(scheduled)[0]
    late, early = graph.of_robot(0)[0], graph.of_robot(1)[-1]
    arms = [edge for edge in graph.edges if edge.why == "arm"]
    arms.append(Precedence(early, nodes[early].seconds, late, "volume"))
    careless = replace(scheduled, schedule=TemporalPlanGraph(nodes, tuple(arms), 2, 0.0))
    report = check_robot_plan(careless, row, wide)
    assert any("does not wait" in problem.what for problem in report.problems)


def test_assembly_is_scheduled_as_well(planned: RobotPlan, scheduled: RobotPlan, row: Assembly, wide: Cell) -> None:
    judge = PinocchioCollisionChecker(wide, place_parts(row), 0.001)
    for plan in (schedule_plan(planned.reverse(), row, wide), scheduled.reverse()):
        assert plan.direction is Direction.ASSEMBLY
        assert plan.makespan <= planned.seconds + 1e-6
        assert not check_schedule(plan, wide, judge)[0]
        assert simulate(plan, runs=20).good


def test_delays_change_neither_order_nor_safety(scheduled: RobotPlan) -> None:
    report = simulate(scheduled, runs=200)
    assert report.good
    assert (report.makespans >= scheduled.makespan).all()
    assert (report.makespans <= 2 * scheduled.makespan + 1e-9).all()


@pytest.mark.parametrize("most", [-0.1, np.nan, np.inf])
def test_delays_that_are_none(scheduled: RobotPlan, most: float) -> None:
    with pytest.raises(InputError, match="a finite share, not negative"):
        simulate(scheduled, most=most)


def test_a_seed_that_is_none(scheduled: RobotPlan) -> None:
    with pytest.raises(InputError, match="a seed is not negative"):
        simulate(scheduled, seed=-1)
    with pytest.raises(InputError, match="a seed is not negative"):
        HybridSettings(Direction.DISASSEMBLY, seed=-1)


def test_a_plan_without_a_schedule(planned: RobotPlan) -> None:
    assert planned.makespan == planned.seconds
    with pytest.raises(PlanError, match="no schedule to simulate"):
        simulate(planned)


def test_arms_spend_all_their_time_somehow(scheduled: RobotPlan) -> None:
    for share in arm_shares(scheduled):
        assert share.moves > 0
        assert share.moves + share.holds + share.waits == pytest.approx(1.0)


def test_one_arm_stays_sequential(column: Assembly, cell_of: Callable[..., Cell]) -> None:
    cell = cell_of(1)
    plan = plan_robots(column, cell, settings=APART).value
    assert plan is not None
    graph = graph_of(schedule_plan(plan, column, cell))
    assert graph.makespan == pytest.approx(plan.seconds)
    assert graph.lower_bound == pytest.approx(plan.seconds, abs=0.1)


def test_files_keep_the_schedule(scheduled: RobotPlan, tmp_path: Path) -> None:
    save_robot_plan(scheduled, tmp_path / "plan.json")
    loaded = load_robot_plan(tmp_path / "plan.json")
    assert graph_of(loaded).starts() == pytest.approx(graph_of(scheduled).starts(), abs=1e-6)


def test_files_of_the_first_format(planned: RobotPlan, tmp_path: Path) -> None:
    """Refused by name, as plan files of versions 1 and 2 are."""
    data = as_robot_version_2(planned) | {"format": "falsework.robot-plan/1"}
    (tmp_path / "old.json").write_text(json.dumps(data))
    with pytest.raises(PlanError, match=r"its format is 'falsework\.robot-plan/1'; this version reads .*; plan again"):
        load_robot_plan(tmp_path / "old.json")


def test_files_of_the_second_format(scheduled: RobotPlan, tmp_path: Path) -> None:
    """Their order is that of the plan in them, which is read in the order of assembly."""
    for plan in (scheduled, scheduled.reverse()):
        (tmp_path / "old.json").write_text(json.dumps(as_robot_version_2(plan)))
        loaded = load_robot_plan(tmp_path / "old.json")
        assert loaded.direction is plan.direction
        assert loaded.makespan == pytest.approx(plan.makespan)
        np.testing.assert_array_equal(loaded.plan.states, plan.plan.states)
        np.testing.assert_array_equal(loaded.states, plan.states)
        np.testing.assert_array_equal(loaded.actions, plan.actions)
        assert [loaded.does(step) for step in range(len(plan))] == [plan.does(step) for step in range(len(plan))]
        save_robot_plan(loaded, tmp_path / "new.json")
        assert json.loads((tmp_path / "new.json").read_text())["direction"] == plan.direction.value
    damaged = as_robot_version_2(scheduled)
    del damaged["plan"]["direction"]
    (tmp_path / "old.json").write_text(json.dumps(damaged))
    with pytest.raises(PlanError, match="direction is None; give one of assembly, disassembly"):
        load_robot_plan(tmp_path / "old.json")


@pytest.mark.parametrize(
    ("key", "entry", "message"),
    [
        ("precedences", {"before": 3, "offset": 0.0, "after": 2, "why": "volume"}, "in a cycle"),
        ("precedences", {"before": 0, "offset": -1.0, "after": 2, "why": "volume"}, "offset is -1.0"),
        (
            "precedences",
            {"before": 0, "offset": 0.0, "after": 999, "why": "volume"},
            "is between motions 0 and 999; motions are numbered from 0 to",
        ),
        ("precedences", {"before": 0, "offset": 0.0, "after": 2, "why": "luck"}, "why is 'luck'"),
        ("motions", {"robot": 0, "step": 0, "trajectory": 0, "start": 0.0, "seconds": 1.0}, "motions, its steps have"),
    ],
)
def test_damaged_schedules(scheduled: RobotPlan, tmp_path: Path, key: str, entry: dict, message: str) -> None:
    data = json.loads(json.dumps(robot_plan_to_dict(scheduled)))
    data["schedule"][key].append(entry)
    (tmp_path / "bad.json").write_text(json.dumps(data))
    with pytest.raises(PlanError) as caught:
        load_robot_plan(tmp_path / "bad.json")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("makespan", "long", "schedule.makespan is 'long'"),
        ("makespan", 1.0, "schedule.makespan is 1, its motions take"),
        ("sequential", 1.0, "schedule.sequential is 1, its motions take"),
        ("lower_bound", 1e6, "above its makespan"),
    ],
)
def test_times_that_do_not_fit_the_motions(
    scheduled: RobotPlan, tmp_path: Path, key: str, value: object, message: str
) -> None:
    data = robot_plan_to_dict(scheduled)
    data["schedule"][key] = value
    (tmp_path / "bad.json").write_text(json.dumps(data))
    with pytest.raises(PlanError, match=message):
        load_robot_plan(tmp_path / "bad.json")


def test_a_deadline_that_the_first_search_uses_up_ends_without_a_plan(row: Assembly, wide: Cell) -> None:
    found = plan_robots(row, wide, settings=HybridSettings(Direction.DISASSEMBLY), deadline=1e-3, concurrent=True)
    assert found.value is None
    assert found.statistics["search"] == "sequential"


def given_lines(settings: HybridSettings) -> bool:
    """Whether a search has the lines of its settings, not shorter ones."""
    return settings.keyframes == KeyframeSettings()


def test_the_longer_of_two_partial_plans_is_kept(row: Assembly, wide: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second search has what is left of the deadline, and often gets less far."""
    partial = SimpleNamespace(statistics={})

    def search(
        graph: Any, task: Any, oracle: Any, guide: Any, settings: HybridSettings, *more: Any, **choices: Any
    ) -> Any:
        first = not given_lines(settings)
        why = Explanation("interrupted", 3 if first else 1, 6, (), None, (), "stopped")
        found = HybridResult(None, partial if first else None, why, {})  # type: ignore[arg-type]
        return SimpleNamespace(run=lambda root: found)

    monkeypatch.setattr("falsework.robots.planning.hybrid_planner.HybridSearch", search)
    found = plan_robots(row, wide, settings=HybridSettings(Direction.DISASSEMBLY), deadline=10.0, concurrent=True)
    assert found.partial is partial
    assert found.explanation is not None
    assert found.explanation.reached == 3
    assert found.statistics["search"] == partial.statistics["search"] == "together"


def test_longer_lines_are_tried_where_short_ones_lead_to_no_plan(
    row: Assembly, wide: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = HybridSettings(Direction.DISASSEMBLY)
    found = plan_robots(row, wide, settings=settings, deadline=120.0, concurrent=True)
    assert found.value is not None
    assert found.value.schedule is not None
    assert found.statistics["search"] == "together"

    def search(*given: Any, **more: Any) -> HybridSearch:
        made = HybridSearch(*given, **more)
        if not given_lines(made.settings):
            made.clock = Deadline(1e-9)
        return made

    monkeypatch.setattr("falsework.robots.planning.hybrid_planner.HybridSearch", search)
    other = plan_robots(row, wide, settings=settings, deadline=120.0, concurrent=True)
    alone = plan_robots(row, wide, settings=APART).value
    assert other.value is not None
    assert alone is not None
    assert other.value.schedule is not None
    assert other.statistics["search"] == other.value.statistics["search"] == "sequential"
    assert other.value.makespan <= alone.seconds
