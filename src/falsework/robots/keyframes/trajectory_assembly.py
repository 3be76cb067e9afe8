"""Timed robot plan from the paths along a chain of keyframe edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.robots.kernels.speed_profile import thin
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment, route_along
from falsework.robots.model.cell import Cell, cell_identity
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.motion.timing import time_path
from falsework.robots.plans.robot_plan import Keyframe, RobotPlan, RobotStep, records_of
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.find import prove_route
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle
from falsework.utils.arrays import Array

STANDSTILL = 1e-7
"""Length below which a path takes no time, rad or m."""
_SPLINE_ERROR = 2e-5
"""Samples that the cubics between others approximate this closely are dropped, rad or m."""


def make_robot_plan(
    assembly: Assembly,
    cell: Cell,
    task: Task,
    oracle: StabilityOracle,
    root: Node,
    chain: Sequence[Edge],
    *,
    forces: bool = False,
    timed: dict[PathSegment, Trajectory | None] | None = None,
) -> RobotPlan:
    """Certify the states along a chain of edges and compute its trajectories, in the order of disassembly.

    `timed` caches trajectories. PlanError if a state cannot be proved stable.
    """
    abstract = prove_route(route_along(root, chain), assembly, task, oracle, forces=forces)
    timed = {} if timed is None else timed
    steps = []
    nodes = (root, *(edge.node for edge in chain))
    for before, edge in zip(nodes, chain, strict=False):
        model = cell.robots[edge.robot].model
        for segment in edge.segments:
            if segment not in timed:
                timed[segment] = timed_leg(model, segment, cell.speed)
        legs = (timed[segment] for segment in edge.segments)
        handed = edge.action if edge.hands_over else None
        made = tuple(leg for leg in legs if leg is not None)
        load = (before.load(edge.robot) or edge.node.load(edge.robot)) if edge.transit else None
        gripped = None if load is None else load.gripped
        steps.append(RobotStep(edge.robot, made, handed, edge.put_down, edge.transit, gripped))
    return RobotPlan(
        plan=abstract,
        keyframes=tuple(Keyframe(node.configurations, node.held, _loads(node)) for node in nodes),
        steps=tuple(steps),
        robots=records_of(cell),
        cell_name=cell.name,
        cell_identity=cell_identity(cell),
        direction=Direction.DISASSEMBLY,
    )


def _loads(node: Node) -> tuple[int | None, ...]:
    return tuple(None if load is None else load.attached.part for load in node.carried)


def timed_leg(model: RobotModel, segment: PathSegment, speed: float) -> Trajectory | None:
    """Return the time-optimal trajectory of a path at a share of the arm's limits; None for a path of zero length."""
    if np.abs(np.diff(segment.path, axis=0)).sum() < STANDSTILL:
        return None
    timed = time_path(model, segment.path, speed)
    knots = _enough(timed.times, timed.positions, timed.velocities, model.acceleration * speed**2)
    made = Trajectory(
        "line" if segment.kind == "line" else "free",
        timed.times[knots],
        timed.positions[knots],
        timed.velocities[knots],
        segment.part,
        segment.touches,
    )
    # Where the acceleration changes between two samples, the cubic between them needs more of it: slow down for that.
    fastest, strongest = made.peaks()
    over = max(
        float((fastest / (model.velocity * speed)).max()),
        float(np.sqrt((strongest / (model.acceleration * speed**2)).max())),
    )
    if over <= 1.0:
        return made
    stretch = over * (1 + 1e-6)
    return replace(made, times=made.times * stretch, velocities=made.velocities / stretch)


def _enough(times: Array, positions: Array, velocities: Array, acceleration: Array) -> NDArray[np.int64]:
    """Return indices of knots whose cubics stay within `_SPLINE_ERROR` of all samples and the acceleration limits."""
    kept = np.empty(len(times), np.int64)
    return kept[: thin(times, positions, velocities, acceleration, _SPLINE_ERROR, kept)]
