"""Arms that hand a held part to another arm: plans, their independent check, schedules, exports, and rejected input."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction
from falsework.assembly import HELD, REMOVED
from falsework.errors import PlanError, StateError
from falsework.robots import Cell, RobotPlan, export_plan, nodes_of
from falsework.robots.checks.check import CheckReport, check_robot_plan
from falsework.robots.exports.commands import Begin, Grip, PublishCount, Wait, commands_of
from falsework.robots.model.cell import cell_identity
from falsework.robots.plans.robot_plan import records_of
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_from_dict,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.timeline import arm_shares, bars_of, event_times
from falsework.search.plans.plan_check import validate_plan
from falsework.viewer.arms import Arms
from tests.robots.plans.sunk_cubes import FAR, NEAR, begin, cubes, make_task, planned


@pytest.fixture(scope="module")
def falling() -> Assembly:
    """Cubes, one of which falls if no robot holds it: its post is beside its centre."""
    return cubes(post=0.05)


@pytest.fixture(scope="module")
def begun(falling: Assembly, roofed: Cell) -> dict[str, Any]:
    """The first arm holds the near cube by its side, from which it cannot be lifted."""
    return begin(falling, roofed)


@pytest.fixture(scope="module")
def plan(falling: Assembly, roofed: Cell, begun: dict[str, Any]) -> RobotPlan:
    """A plan that hands the near cube to the second arm."""
    result = planned(falling, roofed, begun, allow_regrasp=True)
    assert result.value is not None
    assert result.statistics["releases"] == 0
    assert result.statistics["hand_overs"] > 0
    return result.value


@pytest.fixture(scope="module")
def timed(falling: Assembly, roofed: Cell, begun: dict[str, Any]) -> RobotPlan:
    """A plan in which the arms move at the same time."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    from falsework import plan_robots
    from falsework.robots import HybridSettings

    given = {key: value for key, value in begun.items() if key != "start"}
    task = make_task(falling, begun, allow_regrasp=True)
    settings = HybridSettings(Direction.DISASSEMBLY, attempts=4)
    found = plan_robots(falling, roofed, task=task, settings=settings, concurrent=True, **given).value
    assert found is not None
    assert found.schedule is not None
    return found


def halves(plan: RobotPlan) -> list[int]:
    """The steps that are half of a hand-over."""
    return [number for number, step in enumerate(plan.steps) if step.hands_over is not None]


def what(report: CheckReport) -> str:
    """The problems of a report in one text."""
    return "; ".join(problem.what for problem in report.problems)


def test_without_support_there_is_no_plan(falling: Assembly, roofed: Cell, begun: dict[str, Any]) -> None:
    found = planned(falling, roofed, begun, allow_regrasp=False)
    assert found.value is None
    assert found.explanation is not None
    assert "remove near-0" in found.explanation.text


def test_the_second_arm_holds_the_part_before_the_first_leaves_it(
    plan: RobotPlan, falling: Assembly, roofed: Cell
) -> None:
    take, leave = halves(plan)
    assert leave == take + 1
    assert plan.keyframes[take].held == (NEAR, None)
    assert plan.keyframes[leave].held == (NEAR, NEAR)
    assert plan.keyframes[leave + 1].held == (None, NEAR)
    assert plan.does(take) == "take near-0 over from arm 1"
    assert plan.does(leave) == "leave near-0 to arm 2"
    assert len(plan) == len(plan.plan) + 2
    np.testing.assert_array_equal(plan.states[take], plan.states[leave + 1])
    assert plan.states[take][NEAR] == HELD
    assert (np.diff(plan.rows) <= 0).all()
    report = check_robot_plan(plan, falling, roofed)
    assert report.good, what(report)
    assert validate_plan(plan.plan, falling).good
    assert plan.plan.replay is not None
    assert plan.plan.replay.stands


def test_in_reverse_the_first_arm_takes_the_part_over_from_the_second(
    plan: RobotPlan, falling: Assembly, roofed: Cell
) -> None:
    back = plan.reverse()
    take, leave = halves(back)
    assert [back.does(take), back.does(leave)] == ["take near-0 over from arm 2", "leave near-0 to arm 1"]
    assert [back.steps[take].robot, back.steps[leave].robot] == [0, 1]
    report = check_robot_plan(back, falling, roofed)
    assert report.good, what(report)
    np.testing.assert_array_equal(back.reverse().actions, plan.actions)


def test_an_arm_may_take_its_part_back_with_another_grasp(falling: Assembly, roofed: Cell) -> None:
    """The second arm has nowhere to put a part, but it holds the part while the first arm changes its grasp."""
    helper = replace(roofed.robots[1], places=np.zeros((0, 4, 4)))
    cell = replace(roofed, robots=(roofed.robots[0], helper))
    begun = begin(falling, cell)
    begun["start"][FAR] = REMOVED
    assert planned(falling, cell, begun, allow_regrasp=False).value is None
    plan = planned(falling, cell, begun, allow_regrasp=True).value
    assert plan is not None
    robots = [plan.steps[step].robot for step in halves(plan)]
    assert robots == [1, 0, 0, 1]
    assert plan.steps[-1].robot == 0
    report = check_robot_plan(plan, falling, cell)
    assert report.good, what(report)
    report = check_robot_plan(plan.reverse(), falling, cell)
    assert report.good, what(report)


def test_no_plan_begins_between_both_halves(plan: RobotPlan, falling: Assembly, roofed: Cell, begun: dict) -> None:
    take, leave = halves(plan)
    for row in (take, leave, leave + 1):
        frame = plan.keyframes[row]
        here = {**begun, "start": plan.states[row], "configurations": frame.configurations, "held": frame.held}
        if row == leave:
            with pytest.raises(StateError, match="two robots hold one part"):
                planned(falling, roofed, here, allow_regrasp=True)
        else:
            assert planned(falling, roofed, here, allow_regrasp=True).value is not None


def test_files_keep_it(plan: RobotPlan, tmp_path: Path) -> None:
    save_robot_plan(plan, tmp_path / "plan.json")
    read = load_robot_plan(tmp_path / "plan.json")
    assert [step.hands_over for step in read.steps] == [step.hands_over for step in plan.steps]
    assert [frame.held for frame in read.keyframes] == [frame.held for frame in plan.keyframes]
    np.testing.assert_array_equal(read.plan.states, plan.plan.states)


def test_files_that_were_tampered_with_are_refused(plan: RobotPlan) -> None:
    take, leave = halves(plan)

    def altered(alter: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
        data = json.loads(json.dumps(robot_plan_to_dict(plan)))
        alter(data)
        return data

    def refused(message: str, alter: Callable[[dict[str, Any]], None]) -> None:
        with pytest.raises(PlanError, match=message):
            robot_plan_from_dict(altered(alter))

    robot_plan_from_dict(altered(lambda data: None))
    refused("far-1 is handed over although it is not held", lambda data: data["steps"][take].update(hands_over=FAR))
    refused("hands_over", lambda data: data["steps"][take].update(hands_over=99))
    refused("hands_over", lambda data: data["steps"][take].update(hands_over="near-0"))
    refused("do not match a plan", lambda data: data["steps"][take].pop("hands_over"))
    refused("no other held part change", lambda data: data["keyframes"][leave].update(held=[0, None]))
    refused("no other held part change", lambda data: data["keyframes"][leave + 1].update(held=[0, 0]))
    refused("handed over to a robot that holds far-1", lambda data: data["keyframes"][take].update(held=[0, 1]))

    def left_first(data: dict[str, Any]) -> None:
        steps = data["steps"]
        steps[take], steps[leave] = steps[leave], steps[take]
        data["keyframes"][leave]["held"] = [None, None]

    refused("near-0 is left before another robot holds it", left_first)


@pytest.mark.parametrize("backwards", [False, True])
def test_the_check_sees_what_files_would_refuse(
    plan: RobotPlan, falling: Assembly, roofed: Cell, backwards: bool
) -> None:
    plan = plan.reverse() if backwards else plan
    take, leave = halves(plan)
    frames, steps = list(plan.keyframes), list(plan.steps)
    frames[leave] = replace(frames[leave], held=(None, None))
    steps[take], steps[leave] = steps[leave], steps[take]
    early = replace(plan, keyframes=tuple(frames), steps=tuple(steps))
    assert "near-0 is left before another robot holds it" in what(check_robot_plan(early, falling, roofed))
    frames = list(plan.keyframes)
    frames[leave + 1] = replace(frames[leave + 1], held=frames[leave].held)  # the first robot never lets go
    report = check_robot_plan(replace(plan, keyframes=tuple(frames)), falling, roofed)
    assert "the robots hold parts [0, 0]" in what(report)
    frames = list(plan.keyframes)
    taker = plan.steps[take].robot
    away = list(frames[leave].configurations)
    away[taker] = roofed.homes[taker]  # the second robot is not at the part
    for row in range(leave, leave + 2):
        frames[row] = replace(frames[row], configurations=tuple(away))
    report = check_robot_plan(replace(plan, keyframes=tuple(frames)), falling, roofed)
    assert not report.good


def test_the_check_sees_the_second_arm_in_the_first(plan: RobotPlan, falling: Assembly, roofed: Cell) -> None:
    """The second arm stands 0.2 m nearer to the first one, which holds the part, and moves as before."""
    base = roofed.robots[1].base.copy()
    base[0, 3] -= 0.2
    near = replace(roofed, robots=(roofed.robots[0], replace(roofed.robots[1], base=base)))
    moved = replace(plan, cell_identity=cell_identity(near), robots=records_of(near))
    report = check_robot_plan(moved, falling, near)
    take, _ = halves(plan)
    assert any(problem.step == take and "collides with arm 1" in problem.what for problem in report.problems)


def test_a_schedule_keeps_the_order_of_both_halves(timed: RobotPlan, falling: Assembly, roofed: Cell) -> None:
    from falsework.robots import schedule_plan, simulate

    for one in (timed, schedule_plan(timed.reverse(), falling, roofed)):
        assert one.schedule is not None
        assert len(halves(one)) == 2
        assert (np.diff(event_times(one, one.schedule)) >= 0).all()
        report = check_robot_plan(one, falling, roofed)
        assert report.good, what(report)
        assert simulate(one, runs=100).good
        for share in arm_shares(one):
            assert share.moves + share.holds + share.waits == pytest.approx(1.0)


def test_a_schedule_in_which_the_first_arm_may_leave_early_is_refused(
    timed: RobotPlan, falling: Assembly, roofed: Cell
) -> None:
    """Without the edges between both halves, a delay of the second arm would leave the part to nobody."""
    graph = timed.schedule
    assert graph is not None
    take, leave = halves(timed)
    nodes = nodes_of(timed)[0]
    of = [{k for k, node in enumerate(nodes) if node.step == step} for step in (take, leave)]
    kept = tuple(edge for edge in graph.edges if not (edge.before in of[0] and edge.after in of[1]))
    assert len(kept) < len(graph.edges)
    report = check_robot_plan(replace(timed, schedule=replace(graph, edges=kept)), falling, roofed)
    assert not report.good


def test_controllers_close_the_second_gripper_before_they_open_the_first(
    plan: RobotPlan, roofed: Cell, tmp_path: Path
) -> None:
    take, leave = halves(plan)
    assert [plan.grip(take), plan.grip(leave)] == ["close", "open"]
    export_plan(plan, tmp_path, "ros2-json")
    sequences = [json.loads((tmp_path / f"step-{step + 1:03d}.json").read_text()) for step in (take, leave)]
    assert sequences[0]["do"] == "take near-0 over from arm 1"
    assert sequences[0]["sequence"][-1]["gripper"] == "close"
    assert sequences[1]["sequence"][0]["gripper"] == "open"
    commands = list(commands_of(plan, plan.steps[leave].robot))
    after = commands[commands.index(Begin(leave)) + 1 :]
    waits = [command for command in after[: after.index(Grip(close=False))] if isinstance(command, Wait)]
    assert [wait.robot for wait in waits] == [plan.steps[take].robot]
    others = list(commands_of(plan, plan.steps[take].robot))
    closed = others.index(Grip(close=True), others.index(Begin(take)))
    assert next(command for command in others[closed:] if isinstance(command, PublishCount)).count == waits[0].count
    for kind in ("rapid", "urscript", "csv"):
        export_plan(plan, tmp_path / kind, kind, cell=roofed, force=True)
        text = "".join(path.read_text() for path in sorted((tmp_path / kind).rglob("*")) if path.is_file())
        assert "take near-0 over from arm 1" in text


def test_a_bag_has_the_motions_of_both_arms(plan: RobotPlan, tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="bags need mcap; pip install 'falsework[schedule]'")
    pytest.importorskip("rosbags", reason="bags need rosbags; pip install 'falsework[schedule]'")
    from falsework.robots.exports.mcap_bag import write_bag

    moves = sum(len(step.trajectories) for step in plan.steps)
    carried = sum(action >= len(plan.plan.boundary) for action in plan.actions.tolist())
    assert write_bag(plan, tmp_path / "plan.mcap") == 2 * moves + 2 * carried


def test_a_chart_shows_both_arms_at_the_part(timed: RobotPlan) -> None:
    bars = [bar for bar in bars_of(timed) if bar.does == "holds" and bar.part == NEAR]
    assert {bar.robot for bar in bars} == {0, 1}
    first = max(bar.end for bar in bars if bar.robot == 0)
    assert min(bar.begin for bar in bars if bar.robot == 1) <= first


@pytest.mark.parametrize("direction", list(Direction))
def test_the_page_plays_both_halves(plan: RobotPlan, roofed: Cell, direction: Direction) -> None:
    """Both halves belong to the action that they come before, and configurations go on without a jump."""
    arms = Arms(plan, roofed, Direction.DISASSEMBLY).turned(direction)
    assert arms.clock.makespan == pytest.approx(plan.seconds)
    holders = arms.holders()
    assert holders.shape == plan.plan.states.shape
    held = (plan.plan.states == HELD) & ~plan.plan.boundary
    np.testing.assert_array_equal(holders >= 0, held)
    times = np.linspace(0.0, arms.clock.makespan, 2000)
    poses = np.array([[pose[:3, 3] for pose in arms.at_time(time).poses] for time in times])
    assert np.abs(np.diff(poses, axis=0)).max() < 0.05
