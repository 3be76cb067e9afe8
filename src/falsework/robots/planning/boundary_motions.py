"""Motions before and after a plan: away from where the robots are at the start, and to where an assembly goes on.

Plans are found as disassembly. One that continues an assembly ends where the robots are now: the grips of the parts
that they hold are given, a part that one carries leaves the structure last and is brought to where it is, and robots
that hold nothing go where they are. Reversed, all of that comes first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from falsework.assembly.state import HELD, States
from falsework.errors import InputError
from falsework.geometry.clearance.moves import ExitPath
from falsework.robots.grasping.grasp import Grasp
from falsework.robots.keyframes.grasp_configurations import GraspConfiguration
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import CarriedLoad, Edge, Node, PathSegment, accept_all, removed_by
from falsework.robots.keyframes.trajectory_assembly import STANDSTILL
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import Scene, withdrawal_contact
from falsework.robots.motion.near_pairs import nearest_pair
from falsework.robots.motion.path_planner import follow_line
from falsework.search.problem.task import Task

_SAME_WAY = 1e-4
"""Largest difference of joint values, directions and cosines between a line and one that ends where a robot is."""


def leading_insertions(node: Node | None) -> Iterator[tuple[int, ...]]:
    """Yield which robots insert the parts that they carry at a last keyframe, all of them first, none last."""
    loaded = [] if node is None else [robot for robot in range(len(node.held)) if node.load(robot) is not None]
    for count in range(len(loaded), -1, -1):
        yield from itertools.combinations(loaded, count)


class BoundaryMotions:
    """Motions at both ends of the plans of one search; at first there are none."""

    def __init__(self, graph: KeyframeGraph) -> None:
        self.graph = graph
        if graph.given:  # what was learned with these grips may be wrong with others
            graph.joint.forget()
        graph.given.clear()
        graph.accepts = accept_all
        self._first: tuple[Node, list[Edge]] | None = None
        self._last: Node | None = None
        self._insert: tuple[int, ...] = ()
        self._known: dict[bytes, list[Edge] | None] = {}
        self._blocked: tuple[int, str] = (0, "")
        """Robot whose motion was not free last, and why."""

    @property
    def fixed(self) -> bool:
        """Whether plans end at a given keyframe."""
        return self._last is not None

    def begin(self, node: Node) -> Node:
        """Return the keyframe from which to search, after motions away from the given one; InputError without any.

        Robots deliver what they carry, and leave parts that they are too near to for a free motion.
        """
        near = [k for k, part in enumerate(node.held) if part is None and self._line(node, k, node.configurations[k])]
        loaded = [k for k in range(len(node.held)) if node.load(k) is not None]
        waiting = sorted({*near, *loaded})
        for order in itertools.permutations(waiting):
            chain = self._away(node, order)
            if chain is not None:
                self._first = node, chain
                return chain[-1].node if chain else node
        robot, why = self._blocked
        raise InputError(f"{self.graph.cell.robots[robot].name} cannot begin: {why}; move it away first")

    def end_at(self, node: Node | None, insert: Sequence[int]) -> None:
        """End plans at a keyframe, None where their last action ends; InputError if a robot is too near to move.

        Some robots insert their part first when the assembly goes on; others bring theirs back.
        """
        graph, self._last, self._insert = self.graph, node, tuple(insert)
        if node is None:
            return
        grips = {part: (robot, node.configurations[robot]) for robot, part in enumerate(node.held) if part is not None}
        for robot in insert:
            load = node.load(robot)
            assert load is not None
            grips[load.part] = robot, load.gripped
        for part, (robot, values) in grips.items():
            tool = tool_pose(graph.cell.robots[robot], values)
            graph.given[part] = GraspConfiguration(robot, Grasp(tool, tool[:3, 2].copy(), 1.0), values)
        if grips:
            graph.joint.forget()
        graph.accepts = self.accepts
        for robot, part in enumerate(node.held):
            values = node.configurations[robot]
            clear = self.graph.cache.view(node.scene, robot)
            pair = clear.explain(values)
            arms = tuple(f"{entry.name} " for entry in graph.cell.robots)
            if (
                part is None
                and robot not in insert
                and pair
                and not pair[1].startswith(arms)
                and self._line(node, robot, values) is None
            ):
                name, near = graph.cell.robots[robot].name, nearest_pair(clear, values)
                assert near is not None
                raise InputError(f"bodies are too near for a motion: {near.words}; move {name} away first")

    def reached(self, task: Task) -> Task:
        """Return the task of the search: its target has the parts that are inserted first at their places."""
        return task if self._last is None else replace(task, target=self._target(task.target))

    def whole(self, task: Task) -> Task:
        """Return the task of the search with the end of the plan as its target."""
        return task if self._last is None else replace(task, target=self._last.state)

    def accepts(self, edge: Edge) -> bool:
        """Return whether an edge does not lead to the last state of the search, or the motions from there are free."""
        assert self._last is not None
        if not np.array_equal(edge.node.state, self._target(self._last.state)) or self._after(edge.node) is not None:
            return True
        removed = removed_by(edge.action, self.graph.assembly.part_count)
        self.graph.reasons.add("remove" if removed else "hold", removed[0] if removed else edge.action, *self._blocked)
        return False

    def around(self, root: Node, chain: list[Edge]) -> tuple[Node, list[Edge]]:
        """Return the first keyframe and the edges of a plan with the motions before and after it."""
        last = chain[-1].node if chain else root
        if self._last is not None:
            after = self._after(last)
            if after is None:  # only where nothing else is left to do: `accepts` has asked for other plans
                robot, why = self._blocked
                raise InputError(f"{self.graph.cell.robots[robot].name} cannot move: {why}; move it away first")
            chain = [*chain, *after]
        return (root, chain) if self._first is None else (self._first[0], [*self._first[1], *chain])

    def _target(self, state: States) -> States:
        """Return a state with the parts that are inserted first at their places, held."""
        assert self._last is not None
        found = state.copy()
        for robot in self._insert:
            load = self._last.load(robot)
            assert load is not None
            found[load.part] = HELD
        return found

    def _after(self, node: Node) -> list[Edge] | None:
        """Return the motions from the last keyframe of a search to the end; None if there are none."""
        last = self._last
        assert last is not None
        if node.key not in self._known:
            pairs = zip(node.configurations, last.configurations, strict=True)
            away = [np.abs(here - there).max() > STANDSTILL for here, there in pairs]
            waiting = [k for k, far in enumerate(away) if far or last.load(k) is not None]
            chains = (self._back(node, order) for order in itertools.permutations(waiting))
            self._known[node.key] = next((chain for chain in chains if chain is not None), None)
        return self._known[node.key]

    def _away(self, node: Node, order: Sequence[int]) -> list[Edge] | None:
        """Return motions of robots, in some order, that deliver what they carry or leave what they are too near to."""
        found: list[Edge] = []
        for robot in order:
            load, here = node.load(robot), node.configurations[robot]
            if load is None:
                line = self._line(node, robot, here)
                way = None if line is None else replace(line, path=line.path[::-1].copy())
            else:
                way = self.graph.withdrawal.delivery(load.part, robot, here, node.scene)
            if way is None:
                self._blocked = robot, "no way leads from where it is"
                return None
            node = node.moved(robot, way.path[-1], None)
            found.append(Edge(-1, robot, (way,), node, transit=True))
        return found

    def _back(self, node: Node, order: Sequence[int]) -> list[Edge] | None:
        """Return motions of robots, in some order, to where they are at the end."""
        last, found, parts = self._last, [], len(node.state)
        assert last is not None
        for robot in order:
            load, goal = last.load(robot), last.configurations[robot]
            if load is None:
                segments = self._approach(node, robot, node.configurations[robot], goal)
            elif robot in self._insert:
                segments = self._taken_out(node, robot, load, goal)
            else:
                segments = self._fetched(node, robot, load, goal)
            if segments is None:
                return None
            if robot in self._insert and load is not None:
                action = parts + load.part
                after = node.after(action, robot, goal).moved(robot, goal, load)
                found.append(Edge(action, robot, segments, after))
            else:
                after = node.moved(robot, goal, load)
                found.append(Edge(-1, robot, segments, after, transit=True))
            node = after
        return found

    def _approach(self, node: Node, robot: int, start: Array, goal: Array) -> tuple[PathSegment, ...] | None:
        """Return the motion of an empty gripper; on a line at its end if that is near a part."""
        line = self._line(node, robot, goal)
        free = self._free(node.scene, robot, start, goal if line is None else line.path[0])
        return None if free is None else (free,) if line is None else (free, line)

    def _taken_out(self, node: Node, robot: int, load: CarriedLoad, goal: Array) -> tuple[PathSegment, ...] | None:
        """Return the motions that withdraw a held part and bring it where it is at the end."""
        part, here = load.part, node.configurations[robot]
        ways = self.graph.exits.free(part, node.state)
        line = self._on_line(node, robot, load, goal, ways)
        if line is not None:
            return (line,)
        for _, paths, scene in self.graph.withdrawal.lines(node.scene, part, robot, here, ways, "way out"):
            free = self._free(scene, robot, paths[-1][-1], goal, part)
            if free is not None:
                return (*(PathSegment("line", path, part=part) for path in paths), free)
        return None

    def _on_line(
        self, node: Node, robot: int, load: CarriedLoad, goal: Array, ways: Sequence[ExitPath]
    ) -> PathSegment | None:
        """Return the line on which a held part leaves as far as where it is at the end, if it is on such a line."""
        part, entry, here = load.part, self.graph.cell.robots[robot], node.configurations[robot]
        tools = tool_pose(entry, np.array([here, goal]))
        far = tools[1, :3, 3] - tools[0, :3, 3]
        length = float(np.linalg.norm(far))
        turned = np.abs(tools[1, :3, :3] - tools[0, :3, :3]).max() > _SAME_WAY
        straight = np.array([way[0].direction for way in ways if len(way) == 1 and not way[0].turns]).reshape(-1, 3)
        if turned or length < _SAME_WAY or (straight @ far).max(initial=0.0) < (1 - _SAME_WAY) * length:
            return None
        scene = node.scene.with_attached(robot, part, tools[0])
        view = self.graph.cache.view(scene, robot, withdrawal_contact(scene))
        path = follow_line(view, here, far / length, length).path
        if path is None or np.abs(path[-1] - goal).max() > _SAME_WAY:
            return None
        return PathSegment("line", np.concatenate([path[:-1], goal[None]]), part=part)

    def _fetched(self, node: Node, robot: int, load: CarriedLoad, goal: Array) -> tuple[PathSegment, ...] | None:
        """Return the motions that fetch a part from a drop-off pose and bring it where it is at the end."""
        carried = node.moved(robot, goal, load).scene
        away = self.graph.withdrawal.delivery(load.part, robot, goal, carried)
        free = None if away is None else self._free(node.scene, robot, node.configurations[robot], away.path[-1])
        if away is None or free is None:
            return None
        return free, replace(away, path=away.path[::-1].copy())

    def _free(self, scene: Scene, robot: int, start: Array, goal: Array, part: int | None = None) -> PathSegment | None:
        free = self.graph.cache.motion(scene, robot, start, goal)
        if free.path is None:
            between = "" if free.pair is None else f" ({free.pair[0]} and {free.pair[1]})"
            self._blocked = robot, f"then to where the assembly goes on: {free.reason}{between}"
            return None
        view = self.graph.cache.view(scene, robot)
        return PathSegment("free", free.path, part=part, view=view)

    def _line(self, node: Node, robot: int, goal: Array) -> PathSegment | None:
        """Return the line to a configuration that is too near to a part for a free motion, if there is one."""
        scene, world = node.scene, self.graph.world
        if node.load(robot) is not None or not self.graph.cache.view(scene, robot).collides(goal)[0]:
            return None
        part = min(np.flatnonzero(node.present).tolist(), key=lambda part: world.grip_distance(robot, goal, part))
        turn = tool_pose(self.graph.cell.robots[robot], goal)[:3, :3]
        for way in (-turn[:, 2], np.array([0.0, 0.0, 1.0]), *turn[:, :2].T, *-turn[:, :2].T):
            path = self.graph.reaching.retreat("release", scene, part, robot, goal, way)
            if path is not None:
                return PathSegment("line", path[::-1].copy(), touches=part)
        return None
