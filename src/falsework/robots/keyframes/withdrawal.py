"""Withdrawal of held parts: straight lines until they are clear of all bodies, then free motions to drop-off poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.keyframes.grasp_configurations import GraspConfigurations
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.motion.collision_world import LIFT, NO_CONTACT, CollisionQuery, Scene, withdrawal_contact
from falsework.robots.motion.path_planner import MotionCache, follow_line
from falsework.utils.arrays import Array

_ROOM = 2.0
"""Margin at the end of such a line, in margins of free motions, below which a longer line is tried first: between other
bodies hardly any motion is free."""
_MAX_DIRECTIONS = 16
"""Exit directions that are tried for a part."""
_MAX_PLACES = 4
"""Number of free motions to a drop-off pose that are tried."""


class Withdrawal:
    """Withdrawals of parts that robots hold."""

    def __init__(
        self, cache: MotionCache, reasons: FailureLog, grips: GraspConfigurations, lengths: Sequence[float]
    ) -> None:
        """Withdraw parts in the scenes of `cache` on lines of some lengths, and log to `reasons` why one cannot leave.

        Lengths are in approach margins of the cell and are tried in turn until the part is clear.
        """
        self.cell, self.cache, self.reasons = cache.world.cell, cache, reasons
        self.grips, self.lengths = grips, lengths

    def lines(
        self, scene: Scene, part: int, robot: int, here: Array, directions: Array, what: str
    ) -> Iterator[tuple[tuple[Array, ...], Scene]]:
        """Yield withdrawal paths of a part from a configuration, each with the scene in which it is carried, on demand.

        `directions` are free exit directions in the world, shape (n, 3); `what` names the motion in logged reasons.
        """
        tool = tool_pose(self.cell.robots[robot], here)
        scene = scene.with_configuration(robot, here).with_attached(robot, part, tool)
        line = self.cache.view(scene, robot, withdrawal_contact(scene))
        free: CollisionQuery | None = None
        roomy: CollisionQuery | None = None
        for way in self._ordered(directions, tool):
            tight: Array | None = None
            for times in self.lengths:
                out = follow_line(line, here, way, times * self.cell.margins.approach)
                if not out:
                    if tight is None:
                        self.reasons.add("remove", part, robot, f"{what}: {out.reason}", out.pair, out.at)
                    break
                free = free or self.cache.view(scene, robot)
                roomy = roomy or self.cache.view(scene, robot, NO_CONTACT, _ROOM * self.cell.margins.free)
                path = out.path
                assert path is not None
                hit = int(free.hits(path[-1])[0])
                if hit < 0:
                    if not roomy.collides(path[-1])[0]:
                        tight = None
                        yield (path,), scene
                        break
                    if tight is None:
                        tight = path
                    continue
                if tight is not None:
                    break
                lift = self._lift(scene, robot, path[-1], free)
                if lift is not None:
                    yield (path, lift), scene
                    break
                self.reasons.add("remove", part, robot, f"{what}: not clear at its end", free.pair(hit), path[-1])
            if tight is not None:
                yield (tight,), scene

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

    def _lift(self, scene: Scene, robot: int, here: Array, free: CollisionQuery) -> Array | None:
        """Return the path on which a part that was withdrawn along the floor is lifted off it; None if blocked."""
        view = self.cache.view(scene, robot, LIFT)
        up = follow_line(view, here, (0.0, 0.0, 1.0), 0.3 * self.cell.margins.approach)
        if up.path is None or free.collides(up.path[-1])[0]:
            return None
        return up.path

    def _ordered(self, directions: Array, tool: Array) -> Array:
        """Return the exit directions to try, best first: away from the gripper's pointing direction, then upwards."""
        score = directions @ -tool[:3, 2] + 0.5 * directions[:, 2]
        return directions[np.argsort(-score, kind="stable")][:_MAX_DIRECTIONS]
