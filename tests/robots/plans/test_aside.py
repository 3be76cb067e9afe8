"""Robot plans in which arms move parts that they hold aside for others, and sets leave in several moves."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, check, make_task, plan_robots
from falsework.assembly import HELD
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.library.voxels import surface
from falsework.errors import PlanError
from falsework.robots import Cell, RobotPlan
from falsework.robots.exports.export import export_plan
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.plans.loads import moved_aside
from falsework.robots.plans.robot_plan_file import robot_plan_from_dict, robot_plan_to_dict
from falsework.robots.plans.timeline import bars_of, interruption, schedule_of
from falsework.robots.schedule.simulation import simulate
from falsework.viewer.arms import Arms
from tests.robots.plans.conftest import make_cell
from tests.robots.plans.test_ways import bowed, cells, moved, value


@cache
def pit() -> Assembly:
    """A bar in a pit, below a cap: while the cap is held aside, the bar leaves upwards."""
    walls = [
        ((-0.3, -0.2, 0.0), (-0.2, 0.2, 0.1)),
        ((0.2, -0.2, 0.0), (0.3, 0.2, 0.1)),
        ((-0.2, -0.2, 0.0), (0.2, -0.1, 0.1)),
        ((-0.2, 0.1, 0.0), (0.2, 0.2, 0.1)),
    ]
    made = gather(
        [
            box("bar", (-0.2, -0.1, 0.0), (0.2, 0.1, 0.2)),
            box("cap", (0.05, -0.1, 0.2), (0.25, 0.1, 0.3)),
            box("ground", (-0.6, -0.6, -0.05), (0.6, 0.6, 0.0), fixed=True),
            *(box("wall", low, high, fixed=True) for low, high in walls),
        ]
    )
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="pit")


@cache
def tied() -> Assembly:
    """Two bars with tongues in each other, at one end under a lip: they leave together, out and then up."""
    tongues = cells(range(2, 3), range(2, 3), range(1)), cells(range(4, 5), range(1, 2), range(1))
    one = (cells(range(6), range(2), range(2)) | tongues[0]) - tongues[1]
    two = (cells(range(6), range(2, 4), range(2)) | tongues[1]) - tongues[0]
    way = cells(range(9), range(4), range(2)) | cells(range(3, 9), range(4), range(2, 3))
    way |= cells(range(9, 10), range(-1, 5), range(2, 3))
    tray = cells(range(-1, 10), range(-1, 5), range(-1, 3)) - way
    solids = [
        replace(surface(name, solid, (0.05, 0.15, 0.05), (-0.2, -0.3, 0.05)), fixed=name == "tray")
        for name, solid in (("one", one), ("two", two), ("tray", tray))
    ]
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=100.0, name="tied")


@pytest.fixture(scope="module")
def cell() -> Cell:
    return make_cell(payload=20.0)


@pytest.fixture(scope="module")
def capped(cell: Cell) -> RobotPlan:
    assembly = pit()
    target = np.where(np.arange(assembly.part_count) == 0, 0, HELD)
    task = make_task(assembly, 2, target=target, moves=2)
    return value(plan_robots(assembly, cell, task=task, concurrent=True))


def refused(plan: RobotPlan, cell: Cell, *texts: str) -> None:
    problems = [problem.what for problem in check(pit(), plan, cell).problems]
    assert any(text in what for what in problems for text in texts), problems


def test_one_arm_holds_a_cap_aside_while_another_inserts_what_is_below(capped: RobotPlan, cell: Cell) -> None:
    assembly = pit()
    assert not assembly.clearance.can_leave(np.full((1, assembly.part_count), 2, np.uint8))[0, 0]
    for plan in (capped, capped.reverse()):
        report = check(assembly, plan, cell)
        assert report.good, report.problems
    does = [capped.does(step) for step in range(3)]
    assert does == ["move cap-1 aside", "insert bar-0", "move cap-1 back"]
    aside, back = (capped.steps[step] for step in (0, 2))
    assert aside.robots == back.robots != capped.steps[1].robots
    ends = tool_pose(cell.robots[aside.robot], aside.trajectories[0].positions[[0, -1]])[:, :3, 3]
    np.testing.assert_allclose(ends[1] - ends[0], (0.15, 0.0, 0.0), atol=1e-4)
    np.testing.assert_allclose(back.trajectories[0].positions[-1], aside.trajectories[0].positions[0], atol=1e-9)
    assert [capped.standing[row, 1] for row in range(4)] == [True, False, False, True]
    assert simulate(capped, runs=50).good
    again = robot_plan_from_dict(json.loads(json.dumps(robot_plan_to_dict(capped))))
    assert check(assembly, again, cell).good


def test_a_cap_beside_its_way_or_not_moved_is_refused(capped: RobotPlan, cell: Cell) -> None:
    bare = replace(capped, schedule=None)
    refused(moved(bare, 0, 0, capped.steps[0].robot, bowed), cell, "is no straight line: the tool is")
    way = capped.plan.exit_paths[0]
    for moves, text in (
        ((replace(way[0], distance=0.1), way[1]), "beyond its end"),
        ((replace(way[0], distance=0.25), way[1]), "before its end"),
        ((way[0], way[0], way[1]), "its way has other moves than the robots make before and after it"),
        (way[1:], "it moves a held part aside, which is on no way"),
    ):
        plan = replace(capped.plan, exit_paths=(moves, *capped.plan.exit_paths[1:]))
        refused(replace(bare, plan=plan), cell, text)


def test_keyframes_that_disown_what_is_aside_are_refused(capped: RobotPlan, cell: Cell) -> None:
    """A cap that nothing holds, that is in place while it is carried, or in the hand of the other arm."""
    frame, arm = capped.keyframes[1], capped.steps[0].robot
    assert frame.carried[arm] == 1
    for other, text in (
        (replace(frame, carried=()), "the robots hold parts"),
        (replace(frame, held=frame.carried), "carries a part that is in place, or holds another one"),
        (replace(frame, carried=frame.carried[::-1]), "comes to carry another part without a motion"),
    ):
        frames = (capped.keyframes[0], other, *capped.keyframes[2:])
        refused(replace(capped, keyframes=frames, schedule=None), cell, text)


def test_an_interruption_waits_until_what_is_aside_is_back(capped: RobotPlan) -> None:
    starts = schedule_of(capped).starts()
    for seconds in np.linspace(0.0, capped.makespan, 30):
        now = interruption(capped, float(seconds))
        assert all(grip is None for grip in now.gripped)
        aside = [k for k, node in enumerate(schedule_of(capped).nodes) if moved_aside(capped, node.step)]
        assert (now.done == 0) == (seconds < starts[aside[0]])


def test_a_plan_in_which_a_part_stays_aside_is_not_continued(capped: RobotPlan) -> None:
    frames = (
        capped.keyframes[0],
        *(replace(frame, carried=capped.keyframes[1].carried) for frame in capped.keyframes[1:]),
    )
    with pytest.raises(PlanError, match="never comes back"):
        interruption(replace(capped, keyframes=frames), capped.makespan / 2)


def test_the_page_and_exports_know_what_is_aside(capped: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    arm = capped.steps[0].robot
    arms = Arms(capped, cell, capped.direction)
    assert (arms.holders()[:2, 1] == arm).all()
    times = schedule_of(capped).starts()
    nodes = schedule_of(capped).nodes
    (back,) = [k for k, node in enumerate(nodes) if node.step == 2]
    (carried,) = [part for part in arms.at_time(float(times[back]) - 1e-3).carried if part.part == 1]
    np.testing.assert_allclose(carried.pose[:3, 3], (0.15, 0.0, 0.0), atol=1e-3)
    held = [bar for bar in bars_of(capped) if bar.robot == arm and bar.part == 1]
    assert {bar.does for bar in held} == {"holds", "carries"}
    for form in ("rapid", "urscript", "ros2-goals", "csv"):
        assert export_plan(capped, tmp_path / form, form, structure=pit(), cell=cell, force=True)
    program = (tmp_path / "rapid" / f"arm_{arm + 1}.mod").read_text()
    assert "move cap-1 aside" in program
    assert program.count("arm_2_gripper") <= 2


@pytest.mark.parametrize(("payload", "arms"), [(1.2, 2), (20.0, 1)])
def test_a_set_leaves_in_several_moves_by_two_arms_or_by_one(payload: float, arms: int) -> None:
    assembly, strong = tied(), make_cell(payload=payload)
    result = plan_robots(assembly, strong, task=make_task(assembly, 2, parts_at_once=2, moves=2), concurrent=True)
    plan = value(result)
    for same in (plan, plan.reverse()):
        report = check(result.structure or assembly, same, strong)
        assert report.good, report.problems
    (joint,) = [k for k, step in enumerate(plan.steps) if plan.does(k).startswith("insert")]
    assert len(plan.steps[joint].robots) == arms
    if arms == 2:
        assert plan.does(joint + 1) == "move one-0 and two-1 back"
        assert sorted(moved_aside(plan, joint + 1).values()) == [0, 1]
        out = replace(plan.steps[joint + 1], partners=())
        steps = (*plan.steps[: joint + 1], out, *plan.steps[joint + 2 :])
        report = check(assembly, replace(plan, steps=steps, schedule=None), strong)
        assert any("comes to carry another part without a motion" in problem.what for problem in report.problems)
