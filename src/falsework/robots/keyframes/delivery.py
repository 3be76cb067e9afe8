"""Free motions that carry a withdrawn part to a drop-off pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.keyframes.grasp_configurations import GraspConfigurations
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.motion.collision_world import NO_CONTACT, Scene
from falsework.robots.motion.motion_cache import MotionCache

Array = NDArray[np.float64]

_MAX_PLACES = 4
"""Number of free motions to a drop-off pose that are tried."""


class Delivery:
    """Deliveries of withdrawn parts."""

    def __init__(self, cache: MotionCache, reasons: FailureLog, grips: GraspConfigurations) -> None:
        """Deliver parts to the drop-off configurations of `grips` in the scenes of `cache`, and log failures."""
        self.cache, self.reasons, self._grips = cache, reasons, grips

    def path(self, part: int, robot: int, start: Array, scene: Scene) -> PathSegment | None:
        """Return the motion to the nearest drop-off configuration that is free; None if there is none.

        Args:
            part: the part.
            robot: the robot that carries it.
            start: its configuration, shape (joints,).
            scene: the scene in which the part is carried.
        """
        entry = self.cache.world.cell.robots[robot]
        view = self.cache.view(scene, robot, NO_CONTACT, self.cache.world.cell.margins.free)
        places = self._grips.places(robot)
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
