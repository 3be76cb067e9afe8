"""Loads that carried parts are for their arms, for programs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.robots.exports.controller import ToolLoad
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.shapes import inverse_pose, move
from falsework.robots.plans.loads import load_of
from falsework.robots.plans.robot_plan import RobotPlan

Array = NDArray[np.float64]

PartLoads = dict[tuple[int, int], ToolLoad]
"""Load of the part in the gripper, in the frame of the flange, by step of the plan and motion of the step."""


def part_loads(plan: RobotPlan, assembly: Assembly, cell: Cell) -> PartLoads:
    """Return the loads of all motions that carry a part.

    Args:
        plan: the robot plan.
        assembly: its structure.
        cell: its cell, which may scale the structure and change its density.
    """
    placement, own = cell.placement, assembly.mass
    ratio = 1.0 if placement.density is None else placement.density / assembly.density
    mass = own.mass * ratio * placement.scale**3
    inertia = own.inertia * (mass / own.mass * placement.scale**2)[:, None, None]
    center = move(placement.pose, placement.scale * own.center)
    found: PartLoads = {}
    for step, entry in enumerate(plan.steps):
        for motion in range(len(entry.trajectories)):
            load = load_of(plan, step, motion)
            if load is None or load.grip is None:
                continue
            robot, part = cell.robots[entry.robot], load.part
            to_flange = inverse_pose(flange_pose(robot.model, load.grip, robot.base)) @ load.pose
            turn = to_flange[:3, :3] @ placement.pose[:3, :3]
            place = move(to_flange, center[part][None])[0]
            found[step, motion] = ToolLoad(float(mass[part]), place, turn @ inertia[part] @ turn.T)
    return found


def in_tool(load: ToolLoad, tool: Array) -> ToolLoad:
    """Return a load in the frame of a tool, which is given in the frame of the flange, shape (4, 4)."""
    back = inverse_pose(tool)
    turn = back[:3, :3]
    return ToolLoad(load.mass, move(back, load.center[None])[0], turn @ load.inertia @ turn.T)


def together(first: ToolLoad, second: ToolLoad) -> ToolLoad:
    """Return the load of two bodies that move as one."""
    mass = first.mass + second.mass
    center = (first.mass * first.center + second.mass * second.center) / max(mass, 1e-12)
    inertia = np.zeros((3, 3))
    for load in (first, second):
        away = load.center - center
        inertia += load.inertia + load.mass * (away @ away * np.eye(3) - np.outer(away, away))
    return ToolLoad(mass, center, inertia)
