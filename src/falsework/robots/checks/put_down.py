"""Check of parts that are put down on the way: free and at rest on the floor, where their robots have them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from shapely import MultiPoint, Point, Polygon

from falsework.robots.checks.grips import GripChecker
from falsework.robots.model.shapes import inverse_pose, move
from falsework.robots.plans.loads import Load, lying_motions
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.problem.task import Direction
from falsework.utils.arrays import Array

_NEAR = 0.001
"""Largest distance of a part from the floor, and from where its robot has it, metres."""
_STEADY = 0.05
"""Least distance of a centre of mass from the edges of the face that a part stands on, in square roots of its area."""


def put_down_faults(
    plan: RobotPlan, index: int, grips: GripChecker, present: NDArray[np.bool_]
) -> Iterator[tuple[str, tuple[str, str] | None]]:
    """Yield why the part of a step does not lie free and at rest on the floor within reach, and which bodies collide.

    Robots beside it are checked with the motions meanwhile.
    """
    step, lying, judge = plan.steps[index], lying_motions(plan, index), grips.judge
    part, pose = int(plan.actions[index]) - len(plan.plan.boundary), step.put_down
    assert pose is not None
    robot, name, apart = step.robot, judge.parts.names[part], plan.direction is Direction.DISASSEMBLY
    ends = step.trajectories[lying.start].positions[0], step.trajectories[lying.stop - 1].positions[-1]
    for values in ends:
        if fault := grips.fault(robot, values, part, pose):
            yield f"{fault}, which lies on the floor", None
    # In the grip in which the part is in its place, it must come to lie there, or be lifted from there.
    there = judge.flange(robot, ends[0 if apart else 1])
    gripped = plan.keyframes[index if apart else index + 1].configurations[robot]
    carried = there @ inverse_pose(judge.flange(robot, gripped))
    corners = judge.parts.meshes[part].vertices
    far = float(np.linalg.norm(move(carried, corners) - move(pose, corners), axis=1).max())
    if far > _NEAR:
        yield f"{name} lies {1000 * far:.1f} mm away from where its robot has it", None
    other = judge.obstructs(Load(part, None, pose), present)
    if other is not None:
        yield f"{name} is put down in {other}", (f"part {name}", other)
    why = unrest(move(pose, corners), move(pose, judge.parts.center[part : part + 1])[0], grips.cell.floor)
    if why:
        yield f"{name} does not rest where it is put down: {why}", None


def unrest(corners: Array, center: Array, floor: float | None) -> str:
    """Return why a part would not rest on a floor at a height, which may be None; empty if it stands on a face."""
    if floor is None:
        return "the cell has no floor"
    gap = float(corners[:, 2].min()) - floor
    if abs(gap) > _NEAR:
        return f"it is {1000 * abs(gap):.1f} mm {'above' if gap > 0 else 'below'} the floor"
    base = MultiPoint(corners[corners[:, 2] < floor + _NEAR, :2]).convex_hull
    if not isinstance(base, Polygon) or base.area <= 0:
        return "it stands on an edge or a corner"
    inside = base.contains(Point(center[:2]))
    if not inside or base.exterior.distance(Point(center[:2])) < _STEADY * np.sqrt(base.area):
        return "its centre of mass is not well above the face that it stands on"
    return ""
