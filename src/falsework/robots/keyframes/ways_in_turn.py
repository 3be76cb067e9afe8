"""Removals on ways on which robots move one after the other: others than the parts that leave go aside, and back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from falsework.geometry.clearance.moves import ExitPath
from falsework.robots.keyframes.joint_removals import CommonMotions, JointRemovals, Paths
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment
from falsework.robots.keyframes.withdrawal import told
from falsework.robots.motion.collision_world import Contact, Scene, withdrawal_contact


class WaysInTurn:
    """Chains of edges, one for each move of a way: transits, the removal in the last move, and transits back.

    On its way a part may touch what robots have moved aside for it: the way is proven free of them.
    """

    def __init__(self, joint: JointRemovals) -> None:
        """Move as joint removals do, in their scenes."""
        self._joint, self._withdrawal, self._cache = joint, joint.withdrawal, joint.cache

    def edges(self, node: Node, way: ExitPath) -> Iterator[Edge]:
        """Yield the first edges of chains in which the parts of the last move leave; nodes name what follows."""
        chain, paths, of_way = list[Edge](), list[Paths](), {part for move in way for part in move.parts}
        for number in range(len(way) - 1):
            made = self._moved(node, way, number, of_way)
            if made is None:
                return
            edge, moved = made
            chain.append(edge)
            paths.append(moved)
            node = edge.node
        for removal in self._removed(node, way, of_way):
            back = self._back(removal[-1].node, way, paths, of_way)
            if back is not None:
                yield _linked([*chain, *removal, *back])

    def _moved(self, node: Node, way: ExitPath, number: int, of_way: set[int]) -> tuple[Edge, Paths] | None:
        """Return the edge of a move, and the paths of its robots; None if one cannot follow."""
        move, holders = way[number], {part: node.robot_with(part) for part in way[number].parts}
        scene = self._joint.carrying(node, holders)
        moves = dict.fromkeys(holders.values(), move)
        what = told(way, number, "way out")
        stage = self._joint.moved(CommonMotions(scene, (), 0.0), holders, moves, _contact(scene, of_way), 0.0, what)
        if stage is None:
            return None
        (paths,) = stage.paths
        after = node.carrying(self._joint.loads(node, holders, scene), stage.scene.configurations, stay=True)
        return _transit(holders, paths, after), paths

    def _removed(self, node: Node, way: ExitPath, of_way: set[int]) -> Iterator[list[Edge]]:
        """Yield the edges on which the parts of the last move leave, and are delivered."""
        leaving = way[-1].parts
        holders = {part: node.robot_with(part) for part in leaving}
        scene, what = self._joint.carrying(node, holders), told(way, len(way) - 1, "way out")
        contact = _contact(scene, of_way)
        if len(leaving) > 1:
            for edge in self._joint.removals(node, holders, scene, [way[-1]] * len(leaving), contact):
                delivered = self._delivered(edge.node, [*holders.values()])
                if delivered is not None:
                    yield [replace(edge, way=way), *delivered]
            return
        ((part, robot),) = holders.items()
        line, action = self._cache.view(scene, robot, contact), len(node.state) + part
        here = node.configurations[robot]
        for paths in self._withdrawal.until_clear(scene, line, part, robot, here, way[-1], what):
            away = self._withdrawal.delivery(part, robot, paths[-1][-1], scene)
            if away is not None:
                lines = tuple(PathSegment("line", path, part=part) for path in paths)
                end = away.path[-1]
                after = node.after(action, robot, end).moved(robot, end, None)
                yield [Edge(action, robot, (*lines, away), after, way=way)]

    def _delivered(self, node: Node, robots: list[int]) -> list[Edge] | None:
        """Return the edges on which robots deliver what they carry, in some order; None if they cannot."""
        if not robots:
            return []
        for edge in self._joint.deliveries(node):
            rest = self._delivered(edge.node, [robot for robot in robots if robot != edge.robot])
            if rest is not None:
                return [edge, *rest]
        return None

    def _back(self, node: Node, way: ExitPath, paths: list[Paths], of_way: set[int]) -> list[Edge] | None:
        """Return the edges on which others than the parts that have left go back as they came; None if one cannot."""
        found = []
        for number in reversed(range(len(way) - 1)):
            others = {part: node.robot_with(part) for part in way[number].parts if part not in way[-1].parts}
            if not others:
                continue
            home = {part for part in others if all(part not in move.parts for move in way[:number])}
            made, scene = {robot: paths[number][robot][::-1].copy() for robot in others.values()}, node.scene
            for part, robot in others.items():
                path, beside = made[robot], replace(scene, beside=frozenset(others.values()) - {robot})
                view = self._cache.view(beside, robot, _contact(scene, of_way), self._joint.cell.margins.line)
                if not view.is_free(path):
                    what = f"{told(way, number, 'way back')}: collision on the line"
                    self._joint.reasons.add("remove", part, robot, what, None, path[0])
                    return None
            node = node.back(others, {robot: path[-1] for robot, path in made.items()}, home)
            found.append(_transit(others, made, node))
        return found


def _contact(scene: Scene, of_way: set[int]) -> Contact:
    """Return the pairs that may touch on a move of a way: also the parts of it that robots carry."""
    carried = {load.part for load in scene.attached if load is not None}
    return withdrawal_contact(scene, carried & of_way)


def _transit(holders: dict[int, int], paths: Paths, after: Node) -> Edge:
    (lead, segments), *others = (
        (robot, (PathSegment("line", paths[robot], part=part),)) for part, robot in sorted(holders.items())
    )
    return Edge(-1, lead, segments, after, transit=True, partners=tuple(others))


def _linked(chain: list[Edge]) -> Edge:
    """Return the first edge of a chain, each of whose nodes has the edges that follow it."""
    following: tuple[Edge, ...] = ()
    for edge in reversed(chain):
        following = (replace(edge, node=replace(edge.node, following=following)), *following)
    return following[0]
