"""Lines and motions that begin or end at parts: of empty grippers, and of parts that are withdrawn.

A part is withdrawn along its way until it is clear of all bodies, then goes freely to a drop-off pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from falsework.geometry.clearance.moves import ExitPath, PathMove
from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.keyframes.grasp_configurations import GraspConfigurations
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import (
    LIFT,
    NO_CONTACT,
    CollisionQuery,
    Contact,
    Scene,
    grasp_contact,
    withdrawal_contact,
)
from falsework.robots.motion.path_planner import Motion, MotionCache, follow_line, follow_move

_ROOM = 2.0
"""Margin at the end of such a line, in margins of free motions, below which a longer line is tried first: between other
bodies hardly any motion is free."""
_MAX_WAYS = 16
"""Ways out that are tried for a part."""
_LIFT = 0.3
"""Length of the line on which a part that was withdrawn along the floor is lifted off it, in approach margins."""
_MAX_PLACES = 4
"""Number of free motions to a drop-off pose that are tried."""


class Reaching:
    """Motions of empty grippers to parts, and away from them."""

    def __init__(self, cache: MotionCache, reasons: FailureLog, lengths: Sequence[float]) -> None:
        """Move in the scenes of `cache` on lines of some lengths, in approach margins, and log to `reasons`."""
        self.cell, self.cache, self.reasons, self._lengths = cache.world.cell, cache, reasons, lengths

    def retreat(self, action: str, scene: Scene, part: int, robot: int, here: Array, way: Array) -> Array | None:
        """Return the line on which a gripper leaves a part until it is clear of everything; None if it is blocked."""
        view, clear = self.cache.view(scene, robot, grasp_contact(part)), self.cache.view(scene, robot)
        what = "approach" if action == "hold" else "retreat"
        for share in self._lengths:
            line = follow_line(view, here, way, share * self.cell.margins.approach)
            if line.path is None:
                self.reasons.add(action, part, robot, f"{what}: {line.reason}", line.pair, line.at)
                continue
            near = clear.explain(line.path[-1])
            if near is None:
                return line.path
            self.reasons.add(action, part, robot, f"{what}: too near", near, line.path[-1])
        return None

    def approach(self, scene: Scene, part: int, robot: int, retreat: Array) -> tuple[PathSegment, ...] | None:
        """Return the paths on which a robot comes to a part, with a line away from it, (points, joints), in reverse."""
        free = self.cache.motion(scene, robot, scene.configurations[robot], retreat[-1])
        if free.path is None:
            self.reasons.add("hold", part, robot, f"motion to the part: {free.reason}", free.pair, free.at)
            return None
        line = PathSegment("line", retreat[::-1].copy(), touches=part)
        return PathSegment("free", free.path, view=self.cache.view(scene, robot)), line

    def departures(self, scene: Scene, part: int, robot: int) -> Iterator[tuple[PathSegment, ...]]:
        """Yield the path on which a robot lets go of a part and stays beside it, then those on which it goes home."""
        here, entry = scene.configurations[robot], self.cell.robots[robot]
        path = self.retreat("release", scene, part, robot, here, -tool_pose(entry, here)[:3, 2])
        if path is None:
            return
        line = PathSegment("line", path, touches=part)
        yield (line,)
        home = self.cache.motion(scene, robot, path[-1], entry.home)
        if home.path is not None:
            yield line, PathSegment("free", home.path, view=self.cache.view(scene, robot))


class Withdrawal:
    """Withdrawals of parts that robots hold."""

    def __init__(self, grips: GraspConfigurations, lengths: Sequence[float]) -> None:
        """Withdraw parts, in the scenes of their grasps, on lines of some lengths.

        Lengths are in approach margins of the cell and are tried in turn until the part is clear.
        """
        self.cell, self.cache, self.reasons = grips.cell, grips.cache, grips.reasons
        self.grips, self.lengths = grips, lengths

    def lines(
        self, scene: Scene, part: int, robot: int, here: Array, ways: Sequence[ExitPath], what: str
    ) -> Iterator[tuple[ExitPath, tuple[Array, ...], Scene]]:
        """Yield ways on which a part can be withdrawn, the paths from a configuration, and the scene that carries it.

        Args:
            scene: with the part in place.
            robot: holds it.
            here: configuration of the robot, shape (joints,).
            ways: free ways of the part in the world; the last move of each is cut where the part is clear.
            what: name of the motion in logged reasons.
        """
        tool = tool_pose(self.cell.robots[robot], here)
        scene = scene.with_configuration(robot, here).with_attached(robot, part, tool)
        line = self.cache.view(scene, robot, withdrawal_contact(scene))
        for way in self._ordered(ways, tool):
            begun: list[Array] = []
            for number, move in enumerate(way[:-1]):
                if part not in move.parts:  # others move aside
                    continue
                out = follow_move(line, begun[-1][-1] if begun else here, move)
                if out.path is None:
                    self._refuse(part, robot, told(way, number, what), out)
                    break
                begun.append(out.path)
            else:
                last = told(way, len(way) - 1, what)
                for paths in self.until_clear(
                    scene, line, part, robot, begun[-1][-1] if begun else here, way[-1], last
                ):
                    yield way, (*begun, *paths), scene

    def until_clear(
        self, scene: Scene, line: CollisionQuery, part: int, robot: int, here: Array, move: PathMove, what: str
    ) -> Iterator[tuple[Array, ...]]:
        """Yield paths along the last move of a way until the part is clear, with room for free motions if possible."""
        tight: Array | None = None
        done: PathMove | None = None
        for times in self.lengths:
            some = shortened(move, times * self.cell.margins.approach, tool_pose(self.cell.robots[robot], here))
            out = None if some == done else follow_move(line, here, some)
            if out is None or out.path is None:
                if tight is None and out is not None:
                    self._refuse(part, robot, what, out)
                break
            path, done = out.path, some
            near = self.cache.view(scene, robot).explain(path[-1])
            if near is None:
                roomy = self.cache.view(scene, robot, NO_CONTACT, _ROOM * self.cell.margins.free)
                if not roomy.collides(path[-1])[0]:
                    yield (path,)
                    return
                tight = path if tight is None else tight
                continue
            if tight is not None:
                break
            lift = lifted(self.cache, scene, robot, path[-1], LIFT, _LIFT)
            if lift is not None:
                yield path, lift
                return
            self.reasons.add("remove", part, robot, f"{what}: not clear at its end", near, path[-1])
        if tight is not None:
            yield (tight,)

    def _refuse(self, part: int, robot: int, what: str, motion: Motion) -> None:
        self.reasons.add("remove", part, robot, f"{what}: {motion.reason}", motion.pair, motion.at)

    def delivery(self, part: int, robot: int, start: Array, scene: Scene) -> PathSegment | None:
        """Return the motion of a robot with a part to the nearest free drop-off configuration; None without one."""
        entry = self.cell.robots[robot]
        view = self.cache.view(scene, robot)
        places = self.grips.places(robot)
        if not len(places):
            self.reasons.add("remove", part, robot, "no drop-off pose is within reach")
            return None
        hits = view.hits(places)
        clear = places[hits < 0]
        if not len(clear):
            self.reasons.add("remove", part, robot, "every drop-off pose collides", view.pair(int(hits[0])), places[0])
        way = np.abs(clear - start).max(axis=1)
        for goal in clear[np.argsort(way, kind="stable")[:_MAX_PLACES]]:
            free = self.cache.motion(scene, robot, start, goal)
            if free.path is not None:
                return PathSegment("free", free.path, part=part, view=view)
            what = f"to {entry.name}'s drop-off: {free.reason}"
            self.reasons.add("remove", part, robot, what, free.pair, free.at)
        return None

    def _ordered(self, ways: Sequence[ExitPath], tool: Array) -> list[ExitPath]:
        """Return the ways to try, best first: away from the gripper's pointing direction, then upwards."""
        directions = np.array([way[0].direction for way in ways]).reshape(-1, 3)
        score = directions @ -tool[:3, 2] + 0.5 * directions[:, 2]
        return [ways[row] for row in np.argsort(-score, kind="stable")[:_MAX_WAYS]]


def lifted(cache: MotionCache, scene: Scene, robot: int, here: Array, contact: Contact, share: float) -> Array | None:
    """Return the line on which a part is lifted off the floor, a share of the approach margin; None if blocked."""
    up = follow_line(
        cache.view(scene, robot, contact), here, (0.0, 0.0, 1.0), share * cache.world.cell.margins.approach
    )
    return None if up.path is None or cache.view(scene, robot).collides(up.path[-1])[0] else up.path


def told(way: ExitPath, number: int, what: str) -> str:
    """Return the name of a move of a way: that of the way, and where it has several, which one it is."""
    if len(way) == 1:
        return what
    does = "turn" if way[number].turns else "line"
    return f"{what}, move {number + 1} of {len(way)} (a {does})"


def shortened(move: PathMove, length: float, tool: Array) -> PathMove:
    """Return the first part of a move, on which a tool at a pose, shape (4, 4), goes a length in metres at most."""
    if not move.turns:
        return replace(move, distance=min(length, move.distance))
    radius = np.linalg.norm(np.cross(tool[:3, 3] - np.array(move.point), move.direction))
    return move.until(min(1.0, length / float(np.hypot(move.distance, radius * move.angle))))
