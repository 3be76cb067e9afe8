"""Removals on ways on which robots move one after the other: others than the parts that leave go aside, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np

from falsework.assembly.state import HELD, REMOVED, States
from falsework.geometry.clearance.moves import ExitPath, after, way_back
from falsework.geometry.paths.waiting import hands_free, lets_go
from falsework.robots.keyframes.grasp_configurations import GraspConfigurations
from falsework.robots.keyframes.joint_removals import CommonMotions, JointRemovals, Paths
from falsework.robots.keyframes.keyframes import CarriedLoad, Edge, Node, PathSegment
from falsework.robots.keyframes.withdrawal import Reaching, told
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.robots.motion.collision_world import Contact, Scene, grasp_contact, withdrawal_contact

_MOST_CHAINS = 8
"""Ways with other grasps, or other robots, that are tried."""
_MOST_GRASPS = 6
"""Grasps in which a robot takes a part that stands or waits."""
_MOST_CHANGES = 200
"""Motions of empty grippers to parts, and from them, that are tried for a way."""

_Changes = Callable[[Node], Iterator[Edge]]


@dataclass(eq=False)
class _Course:
    """Way and what belongs to it."""

    way: ExitPath
    state: States
    """In which its parts leave."""
    spare: int
    """Robots whose grippers are empty then."""
    left: int = _MOST_CHANGES
    """Motions of empty grippers that may still be tried."""

    def __post_init__(self) -> None:
        self.moves = (*self.way, *way_back(self.way))
        self.last, self.leaving = len(self.way) - 1, self.way[-1].parts
        self.of_way = {part for move in self.way for part in move.parts}
        back = reversed([k for k in range(self.last) if {*self.way[k].parts} - {*self.leaving}])
        self.out = (*range(len(self.way)), *back)
        """Move out of which each move is the way back; of one out itself."""

    def pose(self, part: int, number: int) -> Array:
        """Return where a part is before a move: its displacement from its place, shape (4, 4)."""
        moves = [move for k, move in enumerate(self.moves[:number]) if k != self.last]
        return after(moves).get(part, np.eye(4))

    def loose(self, number: int) -> list[int]:
        """Return the parts of a move that no robot holds in the state, but for those that leave."""
        if not 0 <= number < len(self.moves):
            return []
        parts = self.moves[number].parts
        return [part for part in parts if self.state[part] != HELD and part not in self.leaving]


class WaysInTurn:
    """Chains of edges, some for each move of a way: transits, the removal in the last move, and transits back.

    On its way a part may touch what robots have moved aside for it: the way is proven free of them. What no robot holds
    in the state one takes before its move, and lets go of after it. Where no robot is free for that, that of the part
    which leaves lets go of it meanwhile.
    """

    def __init__(self, joint: JointRemovals, reaching: Reaching, grips: GraspConfigurations) -> None:
        """Move as joint removals do, in their scenes; take parts in some of all grasps."""
        self._joint, self._withdrawal, self._cache = joint, joint.withdrawal, joint.cache
        self._reaching, self._grips = reaching, grips

    def edges(self, node: Node, way: ExitPath) -> Iterator[Edge]:
        """Yield the first edges of chains in which the parts of the last move leave; nodes name what follows."""
        robots, immovable = self._joint.cell.robot_count, self._grips.assembly.immovable
        course = _Course(way, node.state, hands_free(node.state, way[-1].parts, robots, immovable))
        yield from map(_linked, islice(self._chains(course, node, 0, []), _MOST_CHAINS))

    def _chains(self, course: _Course, node: Node, number: int, paths: list[Paths]) -> Iterator[list[Edge]]:
        """Yield the edges from a move on; the paths are those of the moves before."""
        if number == len(course.moves):
            yield []
            return
        for taken in self._in_turn(node, self._takings(course, node, number)):
            there = taken[-1].node if taken else node
            for moved, gone in self._moves(course, there, number, paths):
                drops = self._drops(course, number)
                for left in self._in_turn(moved[-1].node, drops):
                    done = [*taken, *moved, *left]
                    for rest in self._chains(course, done[-1].node, number + 1, [*paths, gone]):
                        yield [*done, *rest]

    def _in_turn(self, node: Node, changes: Sequence[_Changes]) -> Iterator[list[Edge]]:
        """Yield the edges of changes of hands, one after the other."""
        if not changes:
            yield []
            return
        for edge in changes[0](node):
            for rest in self._in_turn(edge.node, changes[1:]):
                yield [edge, *rest]

    def _takings(self, course: _Course, node: Node, number: int) -> list[_Changes]:
        """Return the changes of hands before a move."""
        wanted, changes = [*course.moves[number].parts], list[_Changes]()
        go = lets_go(course.moves[number].parts, course.state, course.leaving, course.spare)
        for part in course.leaving if number < course.last else ():
            if go and part in node.hands:
                changes.append(partial(self._leaves, course, part, course.pose(part, number)))
            elif not go and part not in wanted:
                wanted.append(part)
        missing = [part for part in wanted if part not in node.hands]
        return changes + [partial(self._takes, course, part, course.pose(part, number)) for part in missing]

    def _drops(self, course: _Course, number: int) -> list[_Changes]:
        """Return the changes of hands after a move: parts are let go of that do not move on."""
        parts = [part for part in course.loose(number) if part not in course.loose(number + 1)]
        return [partial(self._leaves, course, part, course.pose(part, number + 1)) for part in parts]

    def _takes(self, course: _Course, part: int, pose: Array, node: Node) -> Iterator[Edge]:
        """Yield edges on which a robot whose gripper is empty takes a part at a pose."""
        present, entries = node.present.copy(), self._joint.cell.robots
        present[part], away = True, pose if any(other == part for other, _ in node.waits) else None
        center = self._grips.parts.center[part]
        free = [robot for robot, hand in enumerate(node.hands) if hand is None]
        for robot in sorted(free, key=lambda robot: float(np.linalg.norm(entries[robot].base[:3, 3] - center))):
            grips = self._grips.get(robot, part, np.where(present, HELD, REMOVED).astype(np.uint8), away)
            view = self._cache.view(node.scene, robot, grasp_contact(part))
            values = np.array([grip.configuration for grip in grips]).reshape(len(grips), -1)
            grips = [grips[row] for row in np.flatnonzero(view.hits(values) < 0)] if grips else []
            for grip in self._grips.best(grips, robot, node.scene, node.held, _MOST_GRASPS):
                course.left -= 1
                if course.left < 0:
                    return
                here = grip.configuration
                tool = tool_pose(entries[robot], here)
                retreat = self._reaching.retreat("hold", node.scene, part, robot, here, -tool[:3, 2])
                segments = None if retreat is None else self._reaching.approach(node.scene, part, robot, retreat)
                if segments is not None:
                    load = CarriedLoad(part, inverse_pose(tool) @ pose, here)
                    yield Edge(-1, robot, segments, node.taken(robot, here, load), transit=True)

    def _leaves(self, course: _Course, part: int, pose: Array, node: Node) -> Iterator[Edge]:
        """Yield edges on which a robot lets go of a part at a pose."""
        robot, lying = node.hands.index(part), node.left(part, pose)
        for segments in self._reaching.departures(lying.scene, part, robot):
            course.left -= 1
            if course.left < 0:
                return
            yield Edge(-1, robot, segments, lying.moved(robot, segments[-1].path[-1], None), transit=True)

    def _moves(
        self, course: _Course, node: Node, number: int, paths: list[Paths]
    ) -> Iterator[tuple[list[Edge], Paths]]:
        """Yield the edges of a move, and the paths of its robots."""
        if number == course.last:
            for removal in self._removed(node, course):
                yield removal, {}
            return
        made = self._back(node, course, number, paths) if number > course.last else self._moved(node, course, number)
        if made is not None:
            yield [made[0]], made[1]

    def _moved(self, node: Node, course: _Course, number: int) -> tuple[Edge, Paths] | None:
        """Return the edge of a move, and the paths of its robots; None if one cannot follow."""
        holders = {part: node.hands.index(part) for part in course.moves[number].parts}
        scene = self._joint.carrying(node, holders)
        paths = self._followed(scene, course, number, holders)
        if paths is None:
            return None
        ends = (paths[robot][-1] if robot in paths else here for robot, here in enumerate(node.configurations))
        after = node.carrying(self._joint.loads(node, holders, scene), tuple(ends), stay=True)
        return _transit(holders, paths, after), paths

    def _followed(self, scene: Scene, course: _Course, number: int, holders: dict[int, int]) -> Paths | None:
        """Return the paths of robots that carry parts on a move; None if one cannot follow."""
        moves, contact = dict.fromkeys(holders.values(), course.moves[number]), _contact(scene, course.of_way)
        begun = CommonMotions(scene, (), 0.0)
        stage = self._joint.moved(begun, holders, moves, contact, 0.0, _told(course, number))
        return None if stage is None else stage.paths[0]

    def _removed(self, node: Node, course: _Course) -> Iterator[list[Edge]]:
        """Yield the edges on which the parts of the last move leave, and are delivered."""
        way, leaving = course.way, course.leaving
        holders = {part: node.hands.index(part) for part in leaving}
        scene, what = self._joint.carrying(node, holders), _told(course, course.last)
        contact = _contact(scene, course.of_way)
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

    def _back(self, node: Node, course: _Course, number: int, paths: list[Paths]) -> tuple[Edge, Paths] | None:
        """Return the edge on which others than the parts that have left go back, and the paths; None if one cannot.

        Robots that have held their parts all along go back as they came.
        """
        out, scene, loose = course.out[number], node.scene, course.loose(number)
        holders = {part: node.hands.index(part) for part in course.moves[number].parts}
        home = {part for part in holders if all(part not in move.parts for move in course.way[:out])} - {*loose}
        made = self._followed(scene, course, number, holders) if loose else None
        if loose and made is None:
            return None
        made = made or {robot: paths[out][robot][::-1].copy() for robot in holders.values()}
        for part, robot in () if loose else holders.items():
            path, beside = made[robot], replace(scene, beside=frozenset(holders.values()) - {robot})
            view = self._cache.view(beside, robot, _contact(scene, course.of_way), self._joint.cell.margins.line)
            if not view.is_free(path):
                what = f"{_told(course, number)}: collision on the line"
                self._joint.reasons.add("remove", part, robot, what, None, path[0])
                return None
        after = node.back(holders, {robot: path[-1] for robot, path in made.items()}, home)
        return _transit(holders, made, after), made


def _told(course: _Course, number: int) -> str:
    """Return the name of a move of a way, or of the way back."""
    return told(course.way, course.out[number], "way out" if number <= course.last else "way back")


def _contact(scene: Scene, of_way: set[int]) -> Contact:
    """Return the pairs that may touch on a move of a way: also the parts of it that robots carry, or that wait."""
    carried = {load.part for load in scene.attached if load is not None} & of_way
    return withdrawal_contact(scene, carried | {part for part, _ in scene.elsewhere})


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
