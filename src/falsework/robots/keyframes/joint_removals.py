"""Joint removals: held parts that leave at the same instant, each on its own way and carried by its own robot."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.geometry.clearance.locked import PartSet
from falsework.geometry.clearance.moves import PathMove
from falsework.robots.grasping.exit_ways import ExitWays
from falsework.robots.kernels.coordination import conflicts
from falsework.robots.keyframes.keyframes import CarriedLoad, Edge, Node, PathSegment, set_action
from falsework.robots.keyframes.withdrawal import Withdrawal
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import LONGEST_WITHDRAWAL
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import NO_CONTACT, Contact, Scene, withdrawal_contact
from falsework.robots.motion.path_planner import follow_move
from falsework.robots.plans.loads import Load
from falsework.robots.schedule.swept_bodies import SweptBodies

_MOST_WAYS = 8
"""Ways of a set that are tried."""
_MARGIN_SHARE = 0.5
"""Share of the margin of lines that arms which move at the same instant are proven to keep from each other."""
_PIECES = (1, 4, 16)
"""Pieces of an edge of their paths over which that is tried to be proven, in turn."""
_ROUNDS = 6
"""Rounds in which the paths of several arms get equal numbers of points."""

Paths = dict[int, Array]
"""Path of each robot, points at equal shares of a common motion, shape (points, joints)."""


@dataclass(frozen=True, eq=False)
class CommonMotions:
    """Common motions so far, one after the other."""

    scene: Scene
    """At their end."""
    paths: tuple[Paths, ...]
    length: float
    """Of the longest path of a part, in approach margins."""


class JointRemovals:
    """Removals of parts that leave together, by one clock, until each robot can carry on alone.

    Parts that leave along one direction still touch at its end: one after the other then leaves the rest of them, which
    stay where they are.
    """

    def __init__(self, exits: ExitWays, withdrawal: Withdrawal) -> None:
        """Move in the scenes, and on lines of the lengths, of `withdrawal`."""
        self.cell, self.cache, self.reasons = withdrawal.cell, withdrawal.cache, withdrawal.reasons
        self.exits, self.withdrawal, self._bodies = exits, withdrawal, SweptBodies(withdrawal.cache.world)

    def edges(self, node: Node, parts: PartSet) -> Iterator[Edge]:
        """Yield edges on which held parts leave at the same instant; after them the robots carry these."""
        holders = {part: node.held.index(part) for part in parts}
        scene = self.carrying(node, holders)
        for way in self.exits.motions(parts, node.state)[:_MOST_WAYS]:
            moves = [move for (move,) in way]
            yield from itertools.islice(self.removals(node, holders, scene, moves, withdrawal_contact(scene)), 1)

    def removals(
        self, node: Node, holders: dict[int, int], scene: Scene, moves: Sequence[PathMove], contact: Contact
    ) -> Iterator[Edge]:
        """Yield edges on which parts leave by one move each, in a scene in which their robots carry them."""
        for stage in self._stages(scene, node, holders, moves, contact):
            yield self._edge(node, holders, stage)

    def carrying(self, node: Node, holders: dict[int, int]) -> Scene:
        """Return the scene of a node in which robots carry parts, that they may hold in place so far."""
        scene = node.scene
        for part, robot in holders.items():
            if node.load(robot) is None:
                tool = tool_pose(self.cell.robots[robot], node.configurations[robot])
                scene = scene.with_attached(robot, part, tool)
        return scene

    def loads(self, node: Node, holders: dict[int, int], scene: Scene) -> dict[int, CarriedLoad]:
        """Return what robots carry in a scene, each with the configuration in which it held that in place."""
        found = {}
        for robot in holders.values():
            attached, load = scene.attached[robot], node.load(robot)
            assert attached is not None
            found[robot] = load or CarriedLoad(attached.part, attached.tool_from_part, node.configurations[robot])
        return found

    def deliveries(self, node: Node) -> Iterator[Edge]:
        """Yield edges on which one of the robots that carry parts away brings its own to a drop-off pose."""
        for robot in range(len(node.held)):
            load = node.load(robot)
            if load is None or node.state[load.part] != REMOVED:
                continue
            away = self.withdrawal.delivery(load.part, robot, node.configurations[robot], node.scene)
            if away is not None:
                yield Edge(-1, robot, (away,), node.moved(robot, away.path[-1], None), transit=True)

    def _edge(self, node: Node, holders: dict[int, int], stage: CommonMotions) -> Edge:
        parts = sorted(holders)
        segments = {
            robot: tuple(PathSegment("line", paths[robot], part=part) for paths in stage.paths)
            for part, robot in holders.items()
        }
        loads = self.loads(node, holders, stage.scene)
        lead, *others = (holders[part] for part in parts)
        return Edge(
            set_action(parts, len(node.state)),
            lead,
            segments[lead],
            node.carrying(loads, stage.scene.configurations),
            partners=tuple((robot, segments[robot]) for robot in others),
        )

    def _stages(
        self, scene: Scene, node: Node, holders: dict[int, int], moves: Sequence[PathMove], contact: Contact
    ) -> Iterator[CommonMotions]:
        """Yield common motions along a way, which begins in proportion to some moves, after which robots go alone."""
        parts = list(holders)
        apart = any(move.direction != moves[0].direction or move.distance != moves[0].distance for move in moves)
        for times in self.withdrawal.lengths:
            some = {
                holders[part]: move.until(times * self.cell.margins.approach)
                for part, move in zip(parts, moves, strict=True)
            }
            out = self.moved(CommonMotions(scene, (), 0.0), holders, some, contact, times)
            if out is None:
                return
            beside = frozenset() if apart else frozenset(holders.values())
            if not self._clear(out.scene, holders, beside):
                continue
            yield from (out,) if apart else self._separated(out, node, holders, parts)

    def _separated(
        self, stage: CommonMotions, node: Node, holders: dict[int, int], left: list[int]
    ) -> Iterator[CommonMotions]:
        """Yield common motions after which parts that have left along one direction no longer touch."""
        if len(left) == 1:
            yield from (stage,) if self._clear(stage.scene, holders, frozenset()) else ()
            return
        for part in left:
            rest = [other for other in left if other != part]
            there = np.full(len(node.state), REMOVED, dtype=np.uint8)
            there[left] = node.state[left]
            for way, times in itertools.product(self.exits.free(part, there)[:_MOST_WAYS], self.withdrawal.lengths):
                if len(way) > 1 or stage.length + times > LONGEST_WITHDRAWAL:
                    continue
                moves = {robot: replace(way[0], distance=0.0) for robot in holders.values()}
                moves[holders[part]] = replace(way[0], distance=times * self.cell.margins.approach)
                out = self.moved(stage, holders, moves, NO_CONTACT, times)
                done = None if out is None else next(self._separated(out, node, holders, rest), None)
                if done is not None:
                    yield done
                    return

    def moved(
        self,
        stage: CommonMotions,
        holders: dict[int, int],
        moves: dict[int, PathMove],
        contact: Contact,
        times: float,
        what: str = "way out with others",
    ) -> CommonMotions | None:
        """Return a common motion further; None if an arm cannot follow, or arms are not proven to keep apart."""
        paths, points = dict[int, Array](), 2
        for _ in range(_ROUNDS):
            for part, robot in holders.items():
                others = frozenset(holders.values()) - {robot}
                view = self.cache.view(replace(stage.scene, beside=others), robot, contact, self.cell.margins.line)
                here = stage.scene.configurations[robot]
                out = follow_move(view, here, moves[robot], points=points)
                if out.path is None:
                    why = f"{what}, line {len(stage.paths) + 1}: {out.reason}"
                    self.reasons.add("remove", part, robot, why, out.pair, out.at)
                    return None
                paths[robot] = out.path
            if len({len(path) for path in paths.values()}) == 1:
                break
            points = max(len(path) for path in paths.values())
        else:
            return None
        if not self._keep_apart(stage.scene, holders, paths):
            first = next(iter(holders))
            self.reasons.add("remove", first, holders[first], "arms that move at the same instant come too near")
            return None
        scene = stage.scene
        for robot, path in paths.items():
            scene = scene.with_configuration(robot, path[-1])
        return CommonMotions(scene, (*stage.paths, paths), stage.length + times)

    def _keep_apart(self, scene: Scene, holders: dict[int, int], paths: Paths) -> bool:
        """Return whether arms that move at the same instant are proven to keep apart, the parts aside.

        These are free of each other by the sweeps of their structure.
        """
        margin, robots = _MARGIN_SHARE * self.cell.margins.line, list(holders.items())
        grips = {robot: self._load(scene, part, robot) for part, robot in robots}
        for (_, one), (_, other) in itertools.combinations(robots, 2):
            for mine, theirs in ((grips[one], None), (None, grips[other])):
                for pieces in _PIECES:
                    first = self._bodies.along(one, paths[one], mine, pieces)
                    second = self._bodies.along(other, paths[other], theirs, pieces)
                    if not conflicts(first, second, margin).diagonal().any():
                        break
                else:
                    return False
        return True

    def _load(self, scene: Scene, part: int, robot: int) -> Load:
        """Return the load of a robot; where it is gripped is where the robot is, displaced by how far it has come."""
        attached, here = scene.attached[robot], scene.configurations[robot]
        assert attached is not None
        return Load(part, here, tool_pose(self.cell.robots[robot], here) @ attached.tool_from_part)

    def _clear(self, scene: Scene, holders: dict[int, int], beside: frozenset[int]) -> bool:
        """Return whether all robots that move, but for some beside each, are clear of everything."""
        for part, robot in holders.items():
            there = replace(scene, beside=beside - {robot})
            view, here = self.cache.view(there, robot), scene.configurations[robot]
            if near := view.explain(here):
                self.reasons.add("remove", part, robot, "way out with others: not clear", near, here)
                return False
        return True
