"""Steps of a plan in another order and by other robots, so that robots that move at the same time wait less.

The search for an order proves motions by cells; those of the result are proven once more in their new order as the
planner proves them, or planned again.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import replace

from falsework.assembly.state import States
from falsework.robots.interleaving.search import OrderSearch
from falsework.robots.interleaving.work import Work, loads_of
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.robots.motion.collision_world import (
    LIFT,
    NO_CONTACT,
    PUT_DOWN,
    CollisionQuery,
    Scene,
    grasp_contact,
    withdrawal_contact,
)
from falsework.robots.motion.path_planner import plan_free
from falsework.robots.plans.loads import Load
from falsework.robots.plans.trajectory import Trajectory
from falsework.stability.oracle import StabilityOracle


def reorder(
    graph: KeyframeGraph,
    oracle: StabilityOracle,
    root: Node,
    chain: Sequence[Edge],
    timed: dict[PathSegment, Trajectory | None],
    *,
    legal: Callable[[States], Sequence[int]],
    stop: Callable[[], bool],
    builds: bool = False,
) -> list[Edge]:
    """Return the edges of a plan in an order, and with the robots, that allow a shorter schedule.

    `legal` are actions that the rules allow in a state, releases aside; a plan that `builds` is executed backwards.
    """
    search = OrderSearch(Work(graph, dict(timed)), oracle, root, chain, legal=legal, stop=stop, builds=builds)
    while True:  # a step that fails is excluded in its state, so this ends
        search.run(graph.seed)
        if not search.changed:
            return list(chain)
        found = follow(graph, root, [step.edge for step in search.best[-1].steps], timed)
        if not isinstance(found, int):
            return found
        search.refuse(found)


def follow(graph: KeyframeGraph, root: Node, edges: Sequence[Edge], old: Container[PathSegment]) -> list[Edge] | int:
    """Return edges proven in their new order, or the index of the first that fails there.

    Free motions that are not old may still be shortened, so they get the scene that they are proven in here. Lines get
    none: a line is not checked against the parts that touch the withdrawn one, since it keeps to an exit direction.
    """
    node, found = root, []
    for k, edge in enumerate(edges):
        if not lies_free(graph, node, edge):
            return k
        segments = []
        for segment, view in zip(edge.segments, views(graph, node, edge), strict=True):
            path = _proven(segment, view, k)
            if path is None:
                return k
            same = path is segment.path and segment in old
            scene = None if segment.kind == "line" else view
            segments.append(segment if same else replace(segment, path=path, view=scene))
        node = node.after(edge.action, edge.robot, segments[-1].path[-1])
        found.append(replace(edge, segments=tuple(segments), node=node))
    return found


def views(graph: KeyframeGraph, node: Node, edge: Edge) -> list[CollisionQuery]:
    """Return for each segment of an edge the collision queries of its scene, with the pairs that may touch."""
    robot, part = edge.robot, edge.action % len(node.state)
    found: list[CollisionQuery] = []
    contacts = [LIFT]
    for segment, load in zip(edge.segments, loads_of(node, edge), strict=True):
        scene, line = _with_load(graph, node.scene, robot, load), segment.kind == "line"
        contact = NO_CONTACT
        if line and (load is None or load.lies):
            contact = grasp_contact(part)
        elif line:
            contact = withdrawal_contact(scene) if len(found) < max(len(edge.way), 1) else contacts.pop()
        else:
            contacts = [PUT_DOWN, PUT_DOWN]
        found.append(graph.cache.view(scene, robot, contact))
    return found


def _with_load(graph: KeyframeGraph, scene: Scene, robot: int, load: Load | None) -> Scene:
    if load is None:
        return scene
    if load.grip is None:
        return scene.with_put_down(robot, load.part, load.pose)
    tool = tool_pose(graph.cell.robots[robot], load.grip)
    return scene.with_attached(robot, load.part, inverse_pose(load.pose) @ tool)


def lies_free(graph: KeyframeGraph, node: Node, edge: Edge) -> bool:
    """Return whether the part of an edge, if it is put down on the way, lies free of all that is there."""
    if edge.put_down is None:
        return True
    carried = _with_load(graph, node.scene, edge.robot, loads_of(node, edge)[0])
    return graph.putting_down.lies_free(carried, edge.action - len(node.state), edge.robot, edge.put_down)


def _proven(segment: PathSegment, view: CollisionQuery, seed: int) -> Array | None:
    """Return the path of a segment if it is free, a new path if it may be replanned, or None."""
    if view.is_free(segment.path):
        return segment.path
    if segment.kind == "line":
        return None
    return plan_free(view, segment.path[0], segment.path[-1], seed=seed).path
