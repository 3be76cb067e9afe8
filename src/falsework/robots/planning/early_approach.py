"""Motions in two: up to where another robot is still in the way, and on when it has left.

A motion waits until all of it is free, since a robot never waits within one. Where it waits for long, it is cut at the
last place that is free before, and each half is a motion from rest to rest. The path stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.robots.keyframes.keyframes import Edge, PathSegment
from falsework.robots.keyframes.trajectory_assembly import timed_leg
from falsework.robots.model.cell import Cell
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.schedule.conflicts import choices, conflict_table, fixed_precedences
from falsework.robots.schedule.itinerary import Itineraries
from falsework.robots.schedule.solver import solve
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]

_LEAST_WAIT = 0.1
"""Shortest wait for which a motion is divided, seconds."""
_LEAST_SHARE = 0.2
"""Least share of a motion in its first half."""
_HALT = 0.2
"""Approximate time that a stop on the way costs, seconds."""
_INSIDE = 0.97
"""Share of the free beginning that is used: the robot slows down there."""


def approach_early(plan: RobotPlan, chain: Sequence[Edge], cell: Cell, world: CollisionWorld) -> RobotPlan:
    """Return a plan with a schedule, and with free motions in two if that makes it shorter.

    Args:
        plan: motions, one after the other, in the order of execution.
        chain: the edges that they are of, in the order of disassembly.
        cell: the robots.
        world: the robots and the parts.
    """
    rows = Itineraries(plan, world)
    graph = solve(rows.nodes, fixed_precedences(rows), choices(rows), cell.robot_count)
    steps, cut = list(plan.steps), False
    way = slice(None, None, 1 if plan.direction is Direction.DISASSEMBLY else -1)
    edges = chain[way]
    for node, second in _waiting(rows, graph):
        step, number = rows.nodes[node].step, rows.nodes[node].trajectory
        assert number is not None
        whole, robot = plan.steps[step].trajectories[number], steps[step].robot
        paths = [segment.path for segment in edges[step].segments]
        found = next(k for k, path in enumerate(paths) if np.allclose(path[way][[0, -1]], whole.positions[[0, -1]]))
        segment = replace(edges[step].segments[found], path=paths[found][way])
        halves = _halves(segment, whole.sample(np.array([second]))[0])
        legs = [timed_leg(cell.robots[robot].model, half, cell.speed) for half in halves]
        moves = list(steps[step].trajectories)
        moves[number : number + 1] = [leg for leg in legs if leg is not None]
        steps[step], cut = replace(steps[step], trajectories=tuple(moves)), True
    if cut:
        other = replace(plan, steps=tuple(steps))
        again = Itineraries(other, world, like=rows)
        shorter = solve(again.nodes, fixed_precedences(again), choices(again), cell.robot_count)
        if shorter.makespan < graph.makespan:
            return replace(other, schedule=shorter)
    return replace(plan, schedule=graph)


def _waiting(rows: Itineraries, graph: TemporalPlanGraph) -> Iterator[tuple[int, float]]:
    """Yield free motions without a part that wait for another robot, and up to which second of theirs they need not."""
    starts = graph.starts()
    for robot in range(graph.robots):
        tables = {other: conflict_table(rows, robot, other) for other in range(graph.robots) if other != robot}
        free_at = 0.0
        for node in graph.of_robot(robot):
            begin, number = float(starts[node]), rows.nodes[node].trajectory
            if number is not None and begin - free_at > _LEAST_WAIT:
                trajectory = rows.plan.steps[rows.nodes[node].step].trajectories[number]
                if trajectory.kind == "free" and trajectory.part is None:
                    seconds = min(
                        _free_until(rows, table, starts, node, other, free_at, begin) for other, table in tables.items()
                    )
                    if _LEAST_SHARE * trajectory.seconds < _INSIDE * seconds and seconds < trajectory.seconds:
                        yield node, _INSIDE * seconds
            free_at = begin + rows.nodes[node].seconds


def _free_until(
    rows: Itineraries, table: NDArray[np.bool_], starts: Array, node: int, other: int, begin: float, end: float
) -> float:
    """Return up to which second of its own a motion keeps clear of what another robot does in some time."""
    robot = rows.nodes[node].robot
    stretch = next(stretch for stretch in rows.rows[robot] if stretch.node == node)
    last = _cell_at(rows, starts, other, end) + 1
    for cell in reversed(range(stretch.cells)):
        since = max(begin, end - float(stretch.ends[cell]) - _HALT)
        columns = slice(_cell_at(rows, starts, other, since), last)
        if not table[stretch.first : stretch.first + cell + 1, columns].any():
            return float(stretch.ends[cell])
    return 0.0


def _cell_at(rows: Itineraries, starts: Array, robot: int, moment: float) -> int:
    """Return the cell in which a robot is at a moment of a schedule: of a motion, or of the rest after it."""
    cell = 0
    for stretch in rows.rows[robot]:
        if stretch.node is not None and starts[stretch.node] <= moment:
            cell = stretch.first + int(np.searchsorted(stretch.ends, moment - starts[stretch.node]))
    return cell


def _halves(segment: PathSegment, place: Array) -> tuple[PathSegment, PathSegment]:
    """Return a path cut at its point nearest to a configuration."""
    edges = np.diff(segment.path, axis=0)
    along = ((place - segment.path[:-1]) * edges).sum(axis=1) / np.maximum((edges**2).sum(axis=1), 1e-300)
    points = segment.path[:-1] + np.clip(along, 0.0, 1.0)[:, None] * edges
    k = int(np.argmin(((points - place) ** 2).sum(axis=1)))
    first = np.concatenate([segment.path[: k + 1], points[k : k + 1]])
    second = np.concatenate([points[k : k + 1], segment.path[k + 1 :]])
    return replace(segment, path=first), replace(segment, path=second)
