"""The independent check: valid plans pass in both directions, and every kind of damage is found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, check
from falsework.errors import InputError, PlanError
from falsework.robots import Cell, Obstacle, RobotPlan, RobotStep, Trajectory
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import block
from falsework.search import Demands


def with_trajectory(plan: RobotPlan, index: int, order: int, change: Callable[[Trajectory], Trajectory]) -> RobotPlan:
    step = plan.steps[index]
    trajectories = list(step.trajectories)
    trajectories[order] = change(trajectories[order])
    steps = list(plan.steps)
    steps[index] = RobotStep(step.robot, tuple(trajectories))
    return replace(plan, steps=tuple(steps))


def faster(trajectory: Trajectory, factor: float) -> Trajectory:
    return replace(trajectory, times=trajectory.times / factor, velocities=trajectory.velocities * factor)


def test_a_plan_and_its_reverse_are_right(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    there = check_robot_plan(robot_plan, column, cell)
    assert there.good, [str(problem) for problem in there.problems]
    assert there.largest_step <= 0.01
    assert there.largest_join <= 1e-5
    assert 0.1 < there.velocity_share <= 1.0
    assert 0.1 < there.acceleration_share <= 1.0
    back = check_robot_plan(robot_plan.reverse(), column, cell)
    assert back.good, [str(problem) for problem in back.problems]
    assert back.trajectories == there.trajectories


def test_kinematics_of_both_libraries_agree(column: Assembly, cell: Cell) -> None:
    """Pinocchio and our own kernel put the flange at the same place."""
    judge = PinocchioCollisionChecker(cell, place_parts(column, cell.placement), 0.0005)
    rng = np.random.default_rng(0)
    for robot, entry in enumerate(cell.robots):
        for _ in range(20):
            values = rng.uniform(entry.model.lower, entry.model.upper)
            own = flange_pose(entry.model, values, entry.base)
            np.testing.assert_allclose(judge.flange(robot, values), own, atol=1e-9)


def test_an_obstacle_in_the_way_is_found(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    """Put a block where the gripper of the first motion is halfway."""
    step = robot_plan.steps[0]
    first = step.trajectories[0]
    entry = cell.robots[step.robot]
    tip = flange_pose(entry.model, first.sample(np.array([first.seconds / 2]))[0], entry.base)[:3, 3]
    obstacle = Obstacle("pillar", (block(tip - 0.03, tip + 0.03),))
    blocked = replace(cell, obstacles=(obstacle,))
    report = check_robot_plan(replace(robot_plan, cell_identity=cell_identity(blocked)), column, blocked)
    assert not report.good
    problem = report.problems[0]
    assert problem.pair is not None
    assert "pillar" in problem.pair
    assert problem.configuration is not None
    assert problem.robot == entry.name
    assert "pillar" in str(problem)


def test_a_shortcut_through_the_structure_is_found(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    """A part that is carried may touch its neighbours on its way out only: then turning on the spot is a collision."""
    parts = len(robot_plan.plan.boundary)
    index = int(np.flatnonzero(robot_plan.actions >= parts)[0])
    line = robot_plan.steps[index].trajectories[0]
    wrist = line.positions[0].copy()
    wrist[5] += 0.5
    turned = Trajectory(
        "free", np.array([0.0, 2.0]), np.stack([line.positions[0], wrist]), np.zeros((2, 6)), part=line.part
    )
    broken = with_trajectory(robot_plan, index, 0, lambda _: turned)
    report = check_robot_plan(broken, column, cell)
    assert any("with part" in problem.what or "with floor" in problem.what for problem in report.problems)
    assert any("jumps" in problem.what for problem in report.problems)


def test_speed_and_acceleration_over_the_limits(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    report = check_robot_plan(with_trajectory(robot_plan, 0, 0, lambda t: faster(t, 2.0)), column, cell)
    texts = [problem.what for problem in report.problems]
    assert any(text.startswith("the acceleration of joint_") for text in texts)
    slow = replace(cell, speed=0.25)
    report = check_robot_plan(replace(robot_plan, cell_identity=cell_identity(slow)), column, slow)
    assert any("the speed of" in problem.what for problem in report.problems)


def test_a_motion_that_does_not_stop(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    def rolling(trajectory: Trajectory) -> Trajectory:
        velocities = trajectory.velocities.copy()
        velocities[-1] = 0.1
        return replace(trajectory, velocities=velocities)

    report = check_robot_plan(with_trajectory(robot_plan, 0, 0, rolling), column, cell)
    assert any("end at rest" in problem.what for problem in report.problems)


def test_joint_limits(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    def wide(trajectory: Trajectory) -> Trajectory:
        positions = trajectory.positions.copy()
        positions[len(positions) // 2, 1] = 3.0
        return replace(trajectory, positions=positions)

    report = check_robot_plan(with_trajectory(robot_plan, 0, 0, wide), column, cell)
    assert any(problem.what == "joint_2 is outside its limits" for problem in report.problems)


def test_held_parts_that_are_not_held(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    parts = len(robot_plan.plan.boundary)
    index = int(np.flatnonzero(robot_plan.actions < parts)[0]) + 1
    robot = robot_plan.steps[index - 1].robot
    frames = list(robot_plan.keyframes)
    configurations = list(frames[index].configurations)
    configurations[robot] = cell.robots[robot].home
    frames[index] = replace(frames[index], configurations=tuple(configurations))
    report = check_robot_plan(replace(robot_plan, keyframes=tuple(frames)), column, cell)
    assert any("mm away from" in problem.what for problem in report.problems)
    frames[index] = replace(robot_plan.keyframes[index], held=(None,) * len(cell.robots))
    report = check_robot_plan(replace(robot_plan, keyframes=tuple(frames)), column, cell)
    assert any("the state has" in problem.what for problem in report.problems)


def test_empty_hands_carry_nothing(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    parts = len(robot_plan.plan.boundary)
    index = int(np.flatnonzero(robot_plan.actions >= parts)[0])
    report = check_robot_plan(with_trajectory(robot_plan, index, 1, lambda t: replace(t, part=None)), column, cell)
    assert any("carries part None" in problem.what for problem in report.problems)
    report = check_robot_plan(with_trajectory(robot_plan, index, 1, lambda t: replace(t, touches=0)), column, cell)
    assert any("may not touch part 0" in problem.what for problem in report.problems)


def test_parts_that_overlap_in_the_model(make_boxes: Callable[..., Assembly], cell: Cell) -> None:
    """A part is shrunk by the tolerance, and by more for a neighbour only where the meshes overlap by more."""
    plain = make_boxes((-0.1, -0.1, 0.0), (0.1, -0.1, 0.0))
    judge = PinocchioCollisionChecker(cell, place_parts(plain, cell.placement), 0.0005)
    assert [len(others) for _, others in judge.loose(0)] == [2]
    assert judge.slack == 0.0005


def test_another_structure_or_cell_is_refused(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, cell_of: Callable[..., Cell]
) -> None:
    with pytest.raises(PlanError, match="for another boxes"):
        check_robot_plan(robot_plan, column.replace(friction=0.7), cell)
    with pytest.raises(PlanError, match="for another cell"):
        check_robot_plan(robot_plan, column, cell_of(2, 1.2))


def test_a_check_that_is_too_coarse(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    with pytest.raises(InputError, match="too coarse"):
        check_robot_plan(robot_plan, column, cell, step=1.0)


def test_one_check_has_motions_and_states(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    report = check(column, robot_plan, cell)
    assert report.good
    assert report.states is not None
    assert report.states.checked == len(robot_plan.plan) + 1
    strict = check(column, robot_plan, cell, demands=Demands(push=1e6))
    assert not strict.problems  # the motions are as good as before, the states have no such margin
    assert strict.states is not None
    assert not strict.states.good
    assert repr(strict) == f"<CheckReport: {strict.states.reason}>"
    assert repr(report).startswith("<CheckReport: no problem in ")
    assert not strict.good
    with pytest.raises(InputError, match="a robot plan is checked in a cell"):
        check(column, robot_plan, None)  # pyrefly: ignore
