"""Reordering of the steps of a plan so that robots that move at the same time wait less for each other.

Each robot keeps the order of its own steps. A schedule in which states may be reordered within limits gives the target
order; the plan is brought close to it by exchanging neighbouring steps, each time with a
verdict on the state between them. The motions are proven again in the new order, or replanned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.robots.kernels.rrt_connect import INTERVALS, edges_free
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.motion.collision_world import NO_CONTACT, CollisionQuery, Contact
from falsework.robots.motion.path_planner import plan_free, resolution_of
from falsework.robots.planning.keyframe_graph import KeyframeGraph
from falsework.robots.planning.keyframes import Edge, Node, PathSegment, state_after
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import event_times
from falsework.robots.schedule.conflicts import choices, fixed_precedences
from falsework.robots.schedule.itinerary import Itineraries
from falsework.robots.schedule.solver import ScheduleSettings, solve
from falsework.stability.oracle import Stability

Array = NDArray[np.float64]

SLACK = 6
"""Positions by which two steps may change their order."""
_SOLVER = ScheduleSettings(seconds=4.0)
_PINS = 12
"""Steps that are kept in place because their motions fail elsewhere, before the plan stays unchanged."""
_SAME_WAY = 1 - 1e-6
"""Cosine above which a line and an exit direction count as the same."""
_NODES = 1000


def reorder(graph: KeyframeGraph, oracle: Stability, root: Node, chain: Sequence[Edge], plan: RobotPlan) -> list[Edge]:
    """Return the edges of a plan in an order that allows a shorter schedule; unchanged if there is none.

    Args:
        graph: keyframes of the structure in the cell.
        oracle: decides stability.
        root: the first keyframe.
        chain: the edges.
        plan: the robot plan of these edges, timed.
    """
    rows = Itineraries(plan, graph.world, slack=SLACK)
    wanted = solve(rows.nodes, fixed_precedences(rows), choices(rows), graph.cell.robot_count, _SOLVER)
    rank = np.argsort(np.argsort(event_times(plan, wanted), kind="stable"))
    ways = [_way_out(graph, root if k == 0 else chain[k - 1].node, edge) for k, edge in enumerate(chain)]
    pinned: set[int] = set()
    while len(pinned) < _PINS:
        order, states = _towards(graph, oracle, root, chain, rank, ways, pinned)
        if order == list(range(len(chain))):
            break
        found = _follow(graph, root, [chain[k] for k in order])
        if isinstance(found, int):
            pinned.add(order[found])
            continue
        replayer = oracle.replayer
        if replayer is None or replayer.replay(states[::-1]).falls_at is None:
            return found
        break
    return list(chain)


def _way_out(graph: KeyframeGraph, before: Node, edge: Edge) -> Array | None:
    """Return the exit direction along which a part is withdrawn; None for a hold or a release."""
    if edge.action < graph.assembly.part_count:
        return None
    path = edge.segments[0].path
    ends = tool_pose(graph.cell.robots[edge.robot], path[[0, -1]])[:, :3, 3]
    return (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])


def _towards(
    graph: KeyframeGraph,
    oracle: Stability,
    root: Node,
    chain: Sequence[Edge],
    rank: NDArray[np.intp],
    ways: Sequence[Array | None],
    pinned: set[int],
) -> tuple[list[int], States]:
    """Exchange neighbouring steps of different robots while that brings the order closer to the target order."""
    order = list(range(len(chain)))
    states = [root.state, *(edge.node.state for edge in chain)]
    refused: set[tuple[int, int, bytes]] = set()
    moved = True
    while moved:
        moved = False
        for k in range(len(order) - 1):
            first, second = order[k], order[k + 1]
            if rank[first] < rank[second] or chain[first].robot == chain[second].robot or pinned & {first, second}:
                continue
            if chain[first].action == chain[second].action:
                continue  # one robot releases the part that the other holds next
            key = (first, second, states[k].tobytes())
            if key in refused:
                continue
            between = state_after(states[k], chain[second].action)
            if not _leaves(graph, states[k], chain[second].action, ways[second]) or not oracle.stable(between[None])[0]:
                refused.add(key)
                continue
            order[k], order[k + 1], states[k + 1] = second, first, between
            moved = True
    return order, np.array(states, dtype=np.uint8)


def _leaves(graph: KeyframeGraph, state: States, action: int, way: Array | None) -> bool:
    """Return whether no present part blocks the line on which a part is withdrawn."""
    if way is None:
        return True
    free = graph.exits.free(action - len(state), state)
    return bool(len(free) and (free @ way).max() >= _SAME_WAY)


def _follow(graph: KeyframeGraph, root: Node, edges: Sequence[Edge]) -> list[Edge] | int:
    """Return edges proven in their new order, or the index of the first that fails there."""
    node, found = root, []
    for k, edge in enumerate(edges):
        segments = []
        for segment, view in zip(edge.segments, _views(graph, node, edge), strict=True):
            path = _proven(segment, view, k)
            if path is None:
                return k
            same = path is segment.path
            segments.append(segment if same else replace(segment, path=path, view=view))
        node = node.after(edge.action, edge.robot, segments[-1].path[-1])
        found.append(replace(edge, segments=tuple(segments), node=node))
    return found


def _views(graph: KeyframeGraph, node: Node, edge: Edge) -> list[CollisionQuery]:
    """Return for each segment of an edge the collision queries of its scene, with the pairs that may touch."""
    parts, margins, robot = len(node.state), graph.cell.margins, edge.robot
    scene, part = node.scene, edge.action % parts
    contacts = [Contact(gripper=frozenset({part}))]
    if edge.action >= parts:
        here = node.configurations[robot]
        tool = tool_pose(graph.cell.robots[robot], here)
        scene = scene.with_configuration(robot, here).with_attached(robot, part, tool)
        around = frozenset(np.flatnonzero(scene.present).tolist())
        contacts = [Contact(carried=around, carried_floor=True), Contact(carried_floor=True)]
    found = []
    for segment in edge.segments:
        line = segment.kind == "line"
        contact = contacts.pop(0) if line else NO_CONTACT
        found.append(graph.cache.view(scene, robot, contact, margins.line if line else margins.free))
    return found


def _proven(segment: PathSegment, view: CollisionQuery, seed: int) -> Array | None:
    """Return the path of a segment if it is free, a new path if it may be replanned, or None."""
    path = np.ascontiguousarray(segment.path)
    arrays = (view.chain, view.bodies, view.obstacles, view.rules, view.work)
    if edges_free(path, resolution_of(view), *arrays, np.empty((2, INTERVALS), np.int64)) == len(path) - 1:
        return segment.path
    if segment.kind == "line":
        return None
    return plan_free(view, path[0], path[-1], seed=seed, nodes=_NODES).path
