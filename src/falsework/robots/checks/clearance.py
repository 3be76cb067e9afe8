"""Clearance of arms over time: the nearest body that each may not touch, for plots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.state import REMOVED
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.motion.collision_world import Attached, CollisionWorld, Contact, Scene
from falsework.robots.motion.near_pairs import NearPair, near_pairs
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import ArmActivity, activities_at, event_times, schedule_of


def clearances(
    plan: RobotPlan, cell: Cell, parts: PartShapes, times: ArrayLike, *, within: float
) -> list[list[NearPair | None]]:
    """Return for each arm, at each time, the nearest body to its links and gripper; None where none is near.

    Parts that the arm takes, holds, carries or lets go of in its present step do not count, nor does the arm itself.

    Args:
        plan: the robot plan; its motions come one after the other where it has no schedule.
        parts: its structure in the cell.
        times: seconds from the beginning, shape (times,).
        within: largest distance that is looked at, metres.
    """
    graph, world = schedule_of(plan), CollisionWorld(cell, parts)
    starts, events = graph.starts(), event_times(plan, graph)
    found: list[list[NearPair | None]] = [[] for _ in cell.robots]
    for time in np.asarray(times, dtype=np.float64).tolist():
        arms = list(activities_at(plan, starts, time))
        row = int((events <= time).sum())
        scene = _scene(plan, cell, arms, row, time)
        for arm in arms:
            around = plan.keyframes[arm.step : arm.step + 2] + plan.keyframes[row : row + 1]
            own = {frame.held[arm.robot] for frame in around} | {_part_of(plan, arm)}
            gripped = frozenset(part for part in own if part is not None)
            contact = Contact(gripped, frozenset(range(parts.part_count)), carried_floor=True, carried_supports=True)
            view = world.view(scene, arm.robot, contact=contact, margin=within)
            name = f"{cell.robots[arm.robot].name} "
            near = near_pairs(view, scene.configurations[arm.robot])
            found[arm.robot].append(next((p for p in near if p.wanted > 0 and p.first.startswith(name)), None))
    return found


def _part_of(plan: RobotPlan, arm: ArmActivity) -> int | None:
    """Return the part that an arm carries, removes or inserts in its present step."""
    if arm.load is not None:
        return arm.load.part
    acts = arm.step < len(plan.steps) and arm.robot in plan.steps[arm.step].robots
    return plan.part_of(arm.step, arm.robot) if acts else None


def _scene(plan: RobotPlan, cell: Cell, arms: Sequence[ArmActivity], row: int, time: float) -> Scene:
    """Return where everything is at a time, at which so many steps are done."""
    present, attached, elsewhere = plan.states[row] != REMOVED, [], []
    for arm in arms:
        load, entry = arm.load, cell.robots[arm.robot]
        carried = None
        if load is not None:
            present[load.part] = False
            if load.grip is None:
                elsewhere.append((load.part, load.pose))
            else:
                carried = Attached(load.part, load.in_tool(entry))
        attached.append(carried)
    for part, pose in plan.keyframes[row].waits:
        if present[part]:
            present[part] = False
            elsewhere.append((part, pose))
    values = tuple(arm.at(np.array([time]))[0] for arm in arms)
    return Scene(values, present, tuple(attached), tuple(elsewhere))
