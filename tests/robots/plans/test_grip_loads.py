"""Forces and moments on grippers that hold parts in place, against statics and the limits in the cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly
from falsework.robots import Cell, Placement, RobotPlan
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.robot_forces import grip_loads, heaviest, overloads

GRAVITY = 9.81


def test_a_cube_on_its_own_weighs_on_the_gripper(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    """Held parts are fixed, so a robot bears all of a cube with nothing on it, at the distance from its cup."""
    loads = grip_loads(robot_plan, column, cell)
    holds = [
        (number, robot)
        for number, frame in enumerate(robot_plan.keyframes)
        for robot, part in enumerate(frame.held)
        if part is not None
    ]
    assert [(load.keyframe, load.robot) for load in loads] == holds
    parts = place_parts(column, cell.placement)
    for load in loads:
        above = robot_plan.states[load.keyframe][1] if load.part == 0 else 0
        if above:
            continue
        weight = parts.mass[load.part] * GRAVITY
        np.testing.assert_allclose(load.force, [0, 0, weight], atol=1e-3 * weight)
        tool = tool_pose(cell.robots[load.robot], robot_plan.keyframes[load.keyframe].configurations[load.robot])[:3, 3]
        arm = np.linalg.norm((parts.center[load.part] - tool)[:2])
        assert load.moment_nm == pytest.approx(weight * arm, abs=2e-3 * weight)
    assert sum(load.part == 0 and robot_plan.states[load.keyframe][1] == 0 for load in loads) > 0


def test_forces_grow_with_the_cube_of_the_scale(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    turned = replace(cell, placement=Placement(yaw=1.0, scale=2.0, density=500.0))
    plan = replace(robot_plan, cell_identity=cell_identity(turned))
    for plain, grown in zip(grip_loads(robot_plan, column, cell), grip_loads(plan, column, turned), strict=True):
        np.testing.assert_allclose(grown.force_n, 2**3 * 2 * plain.force_n, rtol=1e-3)


def test_forces_are_those_under_the_gravity_of_the_plan(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    claim = replace(robot_plan.plan.claim, gravity=1.62)
    plan = replace(robot_plan, plan=replace(robot_plan.plan, claim=claim))
    for plain, light in zip(grip_loads(robot_plan, column, cell), grip_loads(plan, column, cell), strict=True):
        np.testing.assert_allclose(light.force_n, 1.62 / GRAVITY * plain.force_n, rtol=1e-3)


def test_a_gripper_that_is_too_weak_is_named(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    loads = grip_loads(robot_plan, column, cell)
    found = heaviest(loads, loads[0].robot)
    assert found is not None
    force, moment = found[0].force_n, found[1].moment_nm
    assert moment > 0.5  # the cup does not sit below or above the middle

    def limited(force: float = np.inf, moment: float = np.inf) -> list[str]:
        weak = [replace(robot.gripper, force=force, moment=moment) for robot in cell.robots]
        robots = tuple(replace(robot, gripper=gripper) for robot, gripper in zip(cell.robots, weak, strict=True))
        return [str(problem) for problem in overloads(loads, robot_plan, replace(cell, robots=robots))]

    assert limited() == []
    assert limited(force=2 * force, moment=10.0 + 2 * moment) == []
    assert "takes a force of" in limited(force=0.5 * force)[0]
    assert any("takes a moment of" in text for text in limited(moment=0.5 * moment))


def test_limits_are_part_of_the_cell_only_if_they_are_given(cell: Cell, cell_of: Callable[..., Cell]) -> None:
    """Digests of cells from before stay valid."""
    first, *others = cell.robots
    strong = replace(first, gripper=replace(first.gripper, force=50.0))
    assert cell_identity(replace(cell, robots=(strong, *others))) != cell_identity(cell) == cell_identity(cell_of())
