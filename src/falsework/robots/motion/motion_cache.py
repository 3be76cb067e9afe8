"""Cache of collision queries and free motions of one collision world."""

from __future__ import annotations

import zlib

import numpy as np

from falsework.robots.motion.collision_world import NO_CONTACT, CollisionQuery, CollisionWorld, Contact, Scene
from falsework.robots.motion.path_planner import Motion, plan_free
from falsework.utils.arrays import Array

_CACHED_SCENES = 128
"""Largest number of scenes whose query objects are cached; the oldest is evicted first."""


class MotionCache:
    """Cache of collision queries and free motions of one collision world."""

    def __init__(self, world: CollisionWorld, *, nodes: int, seed: int) -> None:
        """Create an empty cache; `nodes` limits those of the trees of one free motion."""
        self.world = world
        self.motions = self.motions_kept = self.views = 0
        self._nodes, self._seed = nodes, seed
        self._motions: dict[bytes, Motion] = {}
        self._views: dict[bytes, dict[str, CollisionQuery]] = {}

    def motion(self, scene: Scene, robot: int, start: Array, goal: Array) -> Motion:
        """Return a free motion of one robot between configurations, with a seed that depends only on the arguments."""
        key = scene_digest(scene, robot) + np.round([start, goal], 6).tobytes()
        if key not in self._motions:
            self.motions += 1
            view = self.view(scene, robot)
            seed = (zlib.crc32(key) + self._seed) % 2**31
            self._motions[key] = plan_free(view, start, goal, seed=seed, nodes=self._nodes)
        else:
            self.motions_kept += 1
        return self._motions[key]

    def view(
        self, scene: Scene, robot: int, contact: Contact = NO_CONTACT, margin: float | None = None
    ) -> CollisionQuery:
        """Return the collision queries of one robot in a scene, with pairs that may touch and a margin in metres.

        The margin is by default that of lines if there is a contact rule, else that of free motions.
        """
        if margin is None:
            margins = self.world.cell.margins
            margin = margins.free if contact is NO_CONTACT else margins.line
        place = scene_digest(scene, robot)
        rules = repr(
            (sorted(contact.gripper), sorted(contact.carried), contact.carried_floor, contact.carried_supports, margin)
        )
        views = self._views.get(place)
        if views is None:
            while len(self._views) > _CACHED_SCENES:
                del self._views[next(iter(self._views))]
            views = self._views[place] = {}
        if rules not in views:
            self.views += 1
            known = next(iter(views.values()), None)
            views[rules] = (
                self.world.view(scene, robot, contact=contact, margin=margin)
                if known is None
                else known.under(contact, margin)
            )
        return views[rules]


def scene_digest(scene: Scene, robot: int) -> bytes:
    """Return a key of all data of a scene that a motion of one robot depends on."""
    others = [np.round(values, 6) + 0.0 for other, values in enumerate(scene.configurations) if other != robot]
    pieces = [bytes([robot]), np.packbits(scene.present).tobytes(), *(values.tobytes() for values in others)]
    for owner, carried in enumerate(scene.attached):
        if carried is not None:
            who = np.array([owner, carried.part], dtype=np.int32)
            pieces.append(who.tobytes() + np.round(carried.tool_from_part, 7).tobytes())
    for part, pose in scene.elsewhere:
        pieces.append(np.array([part], dtype=np.int32).tobytes() + np.round(pose, 7).tobytes())
    return b"|".join(pieces)
