"""Timed robot plan from the paths along a chain of keyframe edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED
from falsework.robots.kernels.speed_profile import thin
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment, route_along
from falsework.robots.model.cell import Cell, cell_identity
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.motion.timing import time_path
from falsework.robots.plans.robot_plan import Keyframe, Partner, RobotPlan, RobotStep, records_of
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle

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
        robots = (edge.robot, *(robot for robot, _ in edge.partners))
        models = [cell.robots[robot].model for robot in robots]
        for together in zip(edge.segments, *(segments for _, segments in edge.partners), strict=True):
            if any(segment not in timed for segment in together):
                timed.update(zip(together, timed_legs(models, together, cell.speed), strict=True))
        handed = edge.action if edge.hands_over else None
        made, *others = (
            tuple(leg for segment in segments if (leg := timed[segment]) is not None)
            for segments in (edge.segments, *(segments for _, segments in edge.partners))
        )
        partners = tuple(Partner(robot, legs) for robot, legs in zip(robots[1:], others, strict=True))
        load = (before.load(edge.robot) or edge.node.load(edge.robot)) if edge.transit else None
        away = load is not None and edge.node.state[load.part] == REMOVED
        gripped = load.gripped if load is not None and away else None
        steps.append(RobotStep(edge.robot, made, handed, edge.put_down, edge.transit, gripped, partners))
    return RobotPlan(
        plan=abstract,
        keyframes=tuple(Keyframe(node.configurations, node.held, _loads(node), node.waits) for node in nodes),
        steps=tuple(steps),
        robots=records_of(cell),
        cell_name=cell.name,
        cell_identity=cell_identity(cell),
        direction=Direction.DISASSEMBLY,
    )


def _loads(node: Node) -> tuple[int | None, ...]:
    return tuple(None if load is None else load.part for load in node.carried)


def timed_legs(
    models: Sequence[RobotModel], segments: Sequence[PathSegment], speed: float
) -> tuple[Trajectory | None, ...]:
    """Return the time-optimal trajectories, by one clock, of arms on paths with equal numbers of points.

    They keep to a share of the arms' limits; None for paths of zero length.
    """
    path = np.concatenate([segment.path for segment in segments], axis=1)
    if np.abs(np.diff(path, axis=0)).sum() < STANDSTILL:
        return (None,) * len(segments)
    names = "velocity", "acceleration", "lower", "upper", "prismatic", "joint_names"
    joined: dict[str, Any] = {name: np.concatenate([getattr(model, name) for model in models]) for name in names}
    whole = replace(max(models, key=lambda model: model.reach), **joined) if len(models) > 1 else models[0]
    timed = time_path(whole, path, speed)
    # Knots whose cubics stay near all samples, and within the limits of acceleration.
    kept = np.empty(len(timed.times), np.int64)
    push = whole.acceleration * speed**2
    knots = kept[: thin(timed.times, timed.positions, timed.velocities, push, _SPLINE_ERROR, kept)]
    ends = np.cumsum([model.joints for model in models])[:-1]
    positions, velocities = (np.split(values[knots], ends, axis=1) for values in (timed.positions, timed.velocities))
    made = [
        Trajectory(
            "line" if segment.kind == "line" else "free",
            timed.times[knots],
            positions[k].copy(),
            velocities[k].copy(),
            segment.part,
            segment.touches,
        )
        for k, segment in enumerate(segments)
    ]
    # Where the acceleration changes between two samples, the cubic between them needs more of it: slow down for that.
    over = 1.0
    for model, leg in zip(models, made, strict=True):
        fastest, strongest = leg.peaks()
        over = max(
            over,
            float((fastest / (model.velocity * speed)).max()),
            float(np.sqrt((strongest / (model.acceleration * speed**2)).max())),
        )
    stretch = over * (1 + 1e-6) if over > 1.0 else 1.0
    return tuple(replace(leg, times=leg.times * stretch, velocities=leg.velocities / stretch) for leg in made)
