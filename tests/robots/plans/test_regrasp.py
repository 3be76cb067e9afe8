"""Arms that release a part and hold it again: plans, their independent check, schedules, and rejected input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, Outcome, Task, Verdict, plan_robots
from falsework.assembly import HELD, INSTALLED, REMOVED, complete_state
from falsework.errors import InputError, PlanError, StateError
from falsework.geometry.clearance.protocol import Clearance
from falsework.robots import Cell, HybridSettings, KeyframeGraph, Obstacle, RobotPlan, export_plan, nodes_of
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.exports.commands import Begin, Grip, Wait, commands_of
from falsework.robots.keyframes.failure_report import describe_failure
from falsework.robots.model.shapes import block
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_from_dict,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.timeline import arm_shares, bars_of, event_times
from falsework.search import Oracle
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.result import Route
from falsework.stability import Verdicts
from tests.robots.plans.orders import APART
from tests.robots.plans.sunk_cubes import FAR, NEAR, begin, cubes, make_task, planned


@pytest.fixture(scope="module")
def sunk() -> Assembly:
    """Cubes that stand."""
    return cubes()


@pytest.fixture(scope="module")
def begun(sunk: Assembly, roofed: Cell) -> dict:
    """The first arm holds the near cube by its side, from which it cannot be lifted."""
    return begin(sunk, roofed)


@pytest.fixture(scope="module")
def plan(sunk: Assembly, roofed: Cell, begun: dict) -> RobotPlan:
    """A plan that holds the near cube again from above."""
    found = planned(sunk, roofed, begun, allow_regrasp=True).value
    assert found is not None
    return found


def test_without_regrasping_there_is_no_plan(sunk: Assembly, roofed: Cell, begun: dict) -> None:
    found = planned(sunk, roofed, begun, allow_regrasp=False)
    assert found.value is None
    assert found.explanation is not None
    assert "remove near-0" in found.explanation.text


def test_with_regrasping_the_part_leaves_by_another_grasp(plan: RobotPlan, sunk: Assembly, roofed: Cell) -> None:
    states = plan.states[:, NEAR].tolist()
    assert plan.plan.allow_regrasp
    release = states.index(INSTALLED)
    again = states.index(HELD, release)
    assert states[release - 1] == HELD
    assert states[-1] == REMOVED
    first, second = plan.keyframes[0], plan.keyframes[again]
    robot = second.held.index(NEAR)
    assert robot != 0 or np.abs(second.configurations[0] - first.configurations[0]).max() > 0.1
    assert plan.does(release - 1) == "release near-0"
    assert plan.steps[release - 1].trajectories[0].touches == NEAR
    report = check_robot_plan(plan, sunk, roofed)
    assert report.good, [str(problem) for problem in report.problems]
    assert validate_plan(plan.plan, sunk).good
    assert plan.plan.replay is not None
    assert plan.plan.replay.stands


def test_in_reverse_the_release_is_a_hold(plan: RobotPlan, sunk: Assembly, roofed: Cell) -> None:
    back = plan.reverse()
    kinds = [plan.grip(step) for step in range(len(plan))]
    assert kinds.count("open") == 1
    swapped = {"open": "close", "close": "open", None: None}
    assert [back.grip(step) for step in range(len(plan))] == [swapped[kind] for kind in kinds[::-1]]
    report = check_robot_plan(back, sunk, roofed)
    assert report.good, [str(problem) for problem in report.problems]
    assert validate_plan(back.plan, sunk).good
    place = len(plan) - kinds.index("open")
    assert "holding near-0" in describe_failure("plan", plan.plan.route, place, sunk.names)
    for one in (plan, back):
        events = nodes_of(one)[1]
        nodes = nodes_of(one)[0]
        for step in range(len(one)):
            own = [k for k, node in enumerate(nodes) if node.step == step]
            if one.grip(step) is not None:
                assert nodes[events[step].node].trajectory is None
                assert events[step].node == (own[-1] if one.grip(step) == "close" else own[0])


def test_a_chart_shows_an_arm_at_a_part_only_while_that_is_held(plan: RobotPlan) -> None:
    for one in (plan, plan.reverse()):
        nodes, events = nodes_of(one)
        begins = np.cumsum([0.0, *(node.seconds for node in nodes)])
        times = [begins[event.node + event.at_end] for event in events]
        holds = [bar for bar in bars_of(one) if bar.does == "holds"]
        assert holds
        for bar in holds:
            assert one.states[np.searchsorted(times, (bar.begin + bar.end) / 2)][bar.part] == HELD


def test_files_keep_it(plan: RobotPlan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    save_robot_plan(plan, path)
    read = load_robot_plan(path)
    assert read.plan.allow_regrasp
    np.testing.assert_array_equal(read.plan.actions, plan.plan.actions)
    np.testing.assert_array_equal(read.plan.states, plan.plan.states)
    data = robot_plan_to_dict(plan)
    data["plan"]["rules"]["support"] = False
    with pytest.raises(PlanError, match="does 'hold' with part"):
        robot_plan_from_dict(data)


def test_a_release_of_what_is_not_held_is_refused(plan: RobotPlan) -> None:
    data = json.loads(json.dumps(robot_plan_to_dict(plan)))
    step = [entry["do"] for entry in data["plan"]["steps"]].index("release")
    data["plan"]["steps"][step]["part"] = FAR
    with pytest.raises(PlanError, match=f"cannot release part {FAR}, which is removed"):
        robot_plan_from_dict(data)


def test_the_check_sees_another_arm_let_go(plan: RobotPlan, sunk: Assembly, roofed: Cell) -> None:
    """Keyframes in which the released part stays held are against the states."""
    release = next(step for step in range(len(plan)) if plan.grip(step) == "open")
    frames = list(plan.keyframes)
    frames[release + 1] = replace(frames[release + 1], held=frames[release].held)
    report = check_robot_plan(replace(plan, keyframes=tuple(frames)), sunk, roofed)
    assert any("the robots hold parts" in problem.what for problem in report.problems)


def test_programs_open_the_gripper_before_the_retreat(plan: RobotPlan, tmp_path: Path) -> None:
    step = next(step for step in range(len(plan)) if plan.grip(step) == "open")
    export_plan(plan, tmp_path / "there", "ros2-json")
    sequence = json.loads((tmp_path / "there" / f"step-{step + 1:03d}.json").read_text())["sequence"]
    assert sequence[0]["gripper"] == "open"
    assert all("joint_trajectory" in entry for entry in sequence[1:])
    export_plan(plan.reverse(), tmp_path / "back", "ros2-json")
    sequence = json.loads((tmp_path / "back" / f"step-{len(plan) - step:03d}.json").read_text())["sequence"]
    assert sequence[-1]["gripper"] == "close"
    commands = list(commands_of(plan, plan.steps[step].robot))
    doing = [command for command in commands[commands.index(Begin(step)) + 1 :] if not isinstance(command, Wait)]
    assert doing[0] == Grip(close=False)


def test_a_schedule_keeps_the_order_of_release_and_hold(sunk: Assembly, roofed: Cell, begun: dict) -> None:
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    from falsework.robots import schedule_plan, simulate

    task = make_task(sunk, begun, allow_regrasp=True)
    given = {key: value for key, value in begun.items() if key != "start"}
    settings = HybridSettings(Direction.DISASSEMBLY, attempts=4)
    plan = plan_robots(sunk, roofed, task=task, settings=settings, concurrent=True, **given).value
    assert plan is not None
    assert "open" in [plan.grip(step) for step in range(len(plan))]
    for one in (plan, schedule_plan(plan.reverse(), sunk, roofed)):
        assert one.schedule is not None
        assert (np.diff(event_times(one, one.schedule)) >= 0).all()
        report = check_robot_plan(one, sunk, roofed)
        assert report.good, [str(problem) for problem in report.problems]
        assert validate_plan(one.plan, sunk).good
        assert simulate(one, runs=100).good
        for share in arm_shares(one):
            assert share.moves + share.holds + share.waits == pytest.approx(1.0)


def test_the_check_refuses_the_release_of_a_part_that_would_fall(plan: RobotPlan) -> None:
    """Where the near cube stands on a narrow post beside its centre, it is handed over (`test_hand_over.py`)."""
    falling = cubes(post=0.05)
    report = validate_plan(replace(plan.plan, identity=falling.identity), falling)
    assert not report.good
    assert "(release near-0)" in report.reason


def test_a_grasp_that_cannot_leave_is_the_last_choice(sunk: Assembly, roofed: Cell) -> None:
    lid = block((-0.12, -0.12, 0.25), (0.12, 0.12, 0.27))
    east = ((0.13, -0.4, 0.17), (0.22, 0.4, 0.19))
    south, north = (((-0.12, y, 0.17), (0.12, y + 0.09, 0.19)) for y in (-0.22, 0.13))
    bars = [block(low, high) for low, high in (east, south, north)]
    covered = replace(roofed, obstacles=(*roofed.obstacles, Obstacle("lid and bars", (lid, *bars))))
    graph = KeyframeGraph(sunk, covered)
    root = graph.start(complete_state(sunk.boundary), covered.homes, (None, None))
    assert next(graph.edges(root, NEAR), None) is None
    assert next(graph.edges(root, FAR), None) is not None
    graph.allow_regrasp = True
    hold = next(graph.edges(root, NEAR))
    assert not hold.node.can_release(NEAR)  # it need not have been held
    assert not hold.node.was_released(NEAR)
    removal = next(graph.edges(next(graph.edges(hold.node, FAR)).node, FAR + sunk.part_count))
    assert removal.node.can_release(NEAR)
    stays, goes = list(graph.edges(removal.node, NEAR))
    assert [segment.kind for segment in stays.segments] == ["line"]
    assert [segment.kind for segment in goes.segments] == ["line", "free"]
    np.testing.assert_array_equal(goes.node.configurations[hold.robot], covered.homes[hold.robot])
    assert stays.node.state[NEAR] == INSTALLED
    assert stays.node.held[hold.robot] is None
    assert stays.node.was_released(NEAR)
    assert next(graph.edges(stays.node, NEAR), None) is None  # the next grasp must be one that can leave


class Rules(Oracle, Clearance):
    """Five parts that can leave in one order only, and the sets of them that must be held where others are gone."""

    holds_keep_stable, replayer = True, None
    order = (0, 1, 3, 2, 4)
    needed = (((),), ((2,), (1, 4)), ((2,), (4,)), ((4,),), ((4,),), ((),))
    """Sets of which one must be held, by number of parts that are gone."""

    def _stable(self, states: np.ndarray) -> np.ndarray:
        """Which states of five parts on the ground stand."""
        gone = [[part for part in self.order if not state[part]] for state in states]
        return np.array(
            [
                tuple(parts) == self.order[: len(parts)]
                and any(all(state[part] == HELD for part in choice) for choice in self.needed[len(parts)])
                for state, parts in zip(states, gone, strict=True)
            ]
        )

    def verdicts(
        self, states: np.ndarray, *, near: np.ndarray | None = None, require_certificate: bool = False
    ) -> Verdicts:
        """Verdicts on them."""
        verdicts = Verdicts.all_undecided(len(states))
        verdicts.verdict[:] = np.where(self._stable(states), Verdict.STABLE, Verdict.UNSTABLE)
        return verdicts

    def can_leave(self, states: np.ndarray, wanted: np.ndarray | None = None) -> np.ndarray:
        """Which parts can leave."""
        free = np.zeros(states.shape, dtype=bool)
        for place, part in enumerate(self.order):
            free[:, part] = (states[:, self.order[:place]] == REMOVED).all(axis=1)
        return free

    def caveat(self, parts: np.ndarray) -> str:
        """Why exits may be missing."""
        return ""


def test_an_abstract_plan_may_need_a_release(column: Assembly) -> None:
    """Part 2 is held from the first removal on, and two robots are needed elsewhere before it can leave."""

    def level(states, actions, direction) -> np.ndarray:
        return np.zeros(actions.shape)

    rules: Any = Rules()
    boundary = np.arange(6) == 5
    plain = SolvabilityCheck(column, Task.from_rules(boundary, 2, clearance=rules), rules, guide=level)
    assert plain.prepare().outcome is Outcome.PROVED_IMPOSSIBLE
    check = SolvabilityCheck(
        column, Task.from_rules(boundary, 2, clearance=rules, allow_regrasp=True), rules, guide=level
    )
    route = check.prepare().routes[0]
    actions = list(enumerate(route.actions.tolist()))
    released = [(row, action) for row, action in actions if action < 6 and route.states[row][action] == HELD]
    assert released
    for row, action in released:
        assert check.planned_releases(route.states[row]) == [action]
        assert check.planned_releases(route.states[row + 1]) == []
    check.forbid(route, 1)  # states before the last but one lead on no longer: no other way round
    assert not check.stays(route.states[0])


def test_a_planned_release_is_carried_out_at_once(
    sunk: Assembly, roofed: Cell, begun: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Releases that the abstract plan has are edges in the first turn of the search."""
    prepare, states = SolvabilityCheck.prepare, [begun["start"]]
    for part, value in ((NEAR, INSTALLED), (FAR, HELD), (FAR, REMOVED), (NEAR, HELD), (NEAR, REMOVED)):
        states.append(states[-1].copy())
        states[-1][part] = value

    def prepared(check: SolvabilityCheck, stop: Any = None) -> Any:
        result = prepare(check, stop)
        check.follow([Route.from_states(np.array(states))])
        return result

    task = make_task(sunk, begun, allow_regrasp=True)
    given: dict[str, Any] = {key: value for key, value in begun.items() if key != "start"}
    given["settings"] = HybridSettings(Direction.DISASSEMBLY, attempts=1)
    assert plan_robots(sunk, roofed, task=task, **given).value is None
    monkeypatch.setattr(SolvabilityCheck, "prepare", prepared)
    found = plan_robots(sunk, roofed, task=task, **given).value
    assert found is not None
    np.testing.assert_array_equal(found.states, states)
    assert check_robot_plan(found, sunk, roofed).good


def test_rejected_input(sunk: Assembly, roofed: Cell, begun: dict) -> None:
    with pytest.raises(InputError, match="repeated holds take no missing parts"):
        Task.from_rules(sunk.boundary, 2, allow_regrasp=True, missing=[NEAR])
    target = begun["start"].copy()
    target[NEAR] = INSTALLED
    task = Task.from_rules(sunk.boundary, 2, start=begun["start"], target=target, allow_regrasp=True)
    with pytest.raises(StateError, match="near-0 is held in the start and installed in the target"):
        plan_robots(
            sunk,
            roofed,
            task=task,
            configurations=begun["configurations"],
            held=begun["held"],
            settings=APART,
        )
    task = replace(Task.from_rules(sunk.boundary, 2, allow_regrasp=True), props=(NEAR,))
    with pytest.raises(InputError, match="robot plans have no props"):
        plan_robots(sunk, roofed, task=task, settings=APART)
