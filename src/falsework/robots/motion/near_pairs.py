"""Pairs of bodies that are too near at one configuration, with their distances, for messages and pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from falsework.robots.kernels.collision import distance_between
from falsework.robots.kinematics.forward import placed_bodies
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import CollisionQuery, CollisionWorld, Scene
from falsework.utils.quantity import format_quantity


@dataclass(frozen=True)
class NearPair:
    """Two bodies that are nearer than the cell allows."""

    first: str
    """Name of a body of the moving arm, such as `left link_4` or `left gripper`."""
    second: str
    """Name of the other body: of an arm, an obstacle, a part, or `floor`."""
    distance: float
    """Metres; negative: the depth by which they overlap."""
    wanted: float
    """Distance that they must keep, metres."""

    @property
    def collides(self) -> bool:
        """Whether the two bodies touch."""
        return self.distance <= 0

    @property
    def words(self) -> str:
        """Description such as `left gripper and floor, 12 mm into each other`."""
        distance = format_quantity(abs(self.distance), "length")
        if self.collides:
            return f"{self.first} and {self.second}, {distance} into each other"
        return f"{self.first} and {self.second}, {distance} apart instead of {format_quantity(self.wanted, 'length')}"


def near_pairs(query: CollisionQuery, configuration: ArrayLike) -> list[NearPair]:
    """Return all pairs of bodies that a query finds too near at one configuration, the deepest overlap first.

    Of two bodies with several pieces the nearest two pieces count.
    """
    _, bodies, obstacles, rules, _ = query.arrays
    placed = placed_bodies(query.arrays.chain, bodies, np.asarray(configuration, dtype=np.float64))
    fixed = query.obstacles
    found: dict[tuple[str, str], NearPair] = {}

    def add(first: str, second: str, distance: float, wanted: float) -> None:
        known = found.get((first, second))
        near = distance < wanted or distance <= 0
        if near and (known is None or distance < known.distance):
            found[first, second] = NearPair(first, second, distance, wanted)

    for body, pieces in enumerate(placed):
        name = query.body_names[body]
        if rules.on_floor[body]:
            add(name, "floor", float(pieces[:, 2].min()) - rules.floor, rules.margin)
        low, high = pieces.min(axis=0) - rules.margin, pieces.max(axis=0) + rules.margin
        near = (obstacles.low <= high).all(axis=1) & (obstacles.high >= low).all(axis=1) & rules.pair[body]
        for other in np.flatnonzero(near).tolist():
            add(name, query.obstacle_names[other], separation(pieces, fixed[other]), rules.margin)
    for a, b in rules.self_pairs.tolist():
        add(query.body_names[a], query.body_names[b], separation(placed[a], placed[b]), 0.0)
    return sorted(found.values(), key=lambda pair: pair.distance - pair.wanted)


def nearest_pair(query: CollisionQuery, configuration: ArrayLike) -> NearPair | None:
    """Return the bodies that overlap most, or are nearest, where a query finds a collision; None where it does not."""
    hit = query.explain(configuration)
    if hit is None:
        return None
    # Of bodies that only just touch, the compiled query may see one more than distances do.
    return next(iter(near_pairs(query, configuration)), NearPair(*hit, 0.0, query.margin))


def near_pairs_of(world: CollisionWorld, scene: Scene) -> list[NearPair]:
    """Return the pairs that are too near of all arms of a scene; two arms that are near each other count once."""
    found: dict[frozenset[str], NearPair] = {}
    for robot, configuration in enumerate(scene.configurations):
        for pair in near_pairs(world.view(scene, robot), configuration):
            found.setdefault(frozenset((pair.first, pair.second)), pair)
    return sorted(found.values(), key=lambda pair: pair.distance - pair.wanted)


def separation(a: Array, b: Array) -> float:
    """Return the distance of two convex pieces, metres; negative: how far one must move for them to touch only.

    The depth is the distance of the origin from the boundary of the Minkowski difference.
    """
    apart = distance_between(np.ascontiguousarray(a), np.ascontiguousarray(b))
    if apart > 0:
        return apart
    try:
        planes = ConvexHull((a[:, None] - b[None]).reshape(-1, 3)).equations
    except QhullError:  # of flat pieces
        return 0.0
    return min(0.0, float(planes[:, 3].max()))
