"""Straight moves out of a pose: which parts can begin to move where, alone or with others, and where they may stop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import PathMove, Poses, apply
from falsework.geometry.paths.cells import closed_sets
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.stops import face_normals, levels, slides

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Parts = tuple[int, ...]

_FIRST = 4.0
"""First stretch of a move, in tolerances; where it is not free, the part cannot move that way."""
_HOME = np.eye(4)


class StraightMoves:
    """Straight moves of some parts past others that rest.

    A move may end wherever corners of the parts that move become level with corners of others, since another way may
    open there, and where it touches another part.
    """

    def __init__(self, motions: PartMotions, movable: Parts, rest: Mask) -> None:
        """Take the parts that may move, and the others that are there, shape (parts,)."""
        self._motions, self._movable, self._rest = motions, movable, rest
        self._tolerance, self.first = motions.tolerance, _FIRST * motions.tolerance
        self._there = rest.copy()
        self._there[list(movable)] = True
        self._walls = [motions.meshes[part].triangles for part in np.flatnonzero(rest).tolist()]
        self._normals: dict[bytes, Array] = {}
        self._rest_levels: dict[bytes, tuple[Array, bool]] = {}
        self.walls = np.zeros_like(rest)
        """Parts at rest that a move has hit so far, shape (parts,)."""
        self.exact = True
        """Whether moves in all directions, with all stops that matter, were listed so far."""

    def directions(self, poses: Poses) -> Array:
        """Return unit vectors along which parts can slide on others, shape (directions, 3)."""
        key = b"".join(np.round(pose[:3, :3] * 1e6).astype(np.int64).tobytes() for _, pose in sorted(poses.items()))
        if key not in self._normals:
            turned = [apply(poses.get(part, _HOME), self._motions.meshes[part].triangles) for part in self._movable]
            normals, every = face_normals([*turned, *self._walls])
            self.exact &= every and len(normals) == 3 and bool(np.abs(normals @ normals.T - np.eye(3)).max() < 1e-9)
            self._normals[key] = slides(normals)
        return self._normals[key]

    def beginnings(self, poses: Poses, direction: Array) -> list[Parts]:
        """Return the sets of parts that can begin to move in a direction as one body, the smaller ones first."""
        blocked, pushed, alone = 0, list[int](), len(self._movable) == 1
        for place, part in enumerate(self._movable):
            hit = self._motions.blockers(self.move((part,), direction, self.first), self._there, poses, stop=alone)
            self.walls |= hit & self._rest
            blocked |= bool((hit & self._rest).any()) << place
            pushed.append(1 << place | sum(1 << k for k, other in enumerate(self._movable) if hit[other]))
        found = closed_sets(pushed, blocked)
        return [tuple(sorted(part for k, part in enumerate(self._movable) if some >> k & 1)) for some in found]

    def free(self, move: PathMove, poses: Poses) -> bool:
        """Return whether a move hits nothing."""
        hit = self._motions.blockers(move, self._there, poses, stop=True)
        self.walls |= hit & self._rest
        return not hit.any()

    def move(self, parts: Parts, direction: Array, distance: float) -> PathMove:
        """Return a straight move."""
        x, y, z = (direction + 0.0).tolist()
        return PathMove(parts, (x, y, z), float(distance))

    def distances(self, parts: Parts, poses: Poses, direction: Array, most: float) -> Array:
        """Return the distances, up to `most`, at which a move may end, ascending."""
        rest = self._levels_of_rest(direction)
        others = [part for part in self._movable if part not in parts]
        beside = [rest, *(self._levels_of([part], poses, direction) for part in others)]
        own = self._levels_of(parts, poses, direction)
        stops = np.unique((np.concatenate(beside)[:, None] - own).ravel())
        stops = stops[(stops > self.first) & (stops < most + self._tolerance)]
        stops = stops[np.diff(stops, prepend=0.0) > self._tolerance]
        low, high = 0, len(stops)  # the first `low` stops can be reached, those from `high` on cannot
        while low < high:
            middle = (low + high) // 2
            if self.free(self.move(parts, direction, stops[middle]), poses):
                low = middle + 1
            else:
                high = middle
        before = float(stops[low - 1]) if low else 0.0
        beyond = float(stops[low]) if low < len(stops) else most
        touch = self._touch(parts, poses, direction, before, beyond)
        return stops[:low] if touch is None else np.append(stops[:low], touch)

    def _levels_of_rest(self, direction: Array) -> Array:
        key = np.round(direction * 1e6).astype(np.int64).tobytes()
        if key not in self._rest_levels:
            nothing = np.zeros(0), True
            self._rest_levels[key] = levels(self._walls, direction, self._tolerance) if self._walls else nothing
        values, every = self._rest_levels[key]
        self.exact &= every
        return values

    def _levels_of(self, parts: Sequence[int], poses: Poses, direction: Array) -> Array:
        turned = [apply(poses.get(part, _HOME), self._motions.meshes[part].triangles) for part in parts]
        values, every = levels(turned, direction, self._tolerance)
        self.exact &= every
        return values

    def _touch(self, parts: Parts, poses: Poses, direction: Array, free: float, blocked: float) -> float | None:
        """Return the distance at which parts touch another between two stops; None where they do at the first."""
        if blocked - free <= self.first or not self.free(self.move(parts, direction, free + self.first), poses):
            return None
        while blocked - free > 0.5 * self._tolerance:
            middle = 0.5 * (free + blocked)
            if self.free(self.move(parts, direction, middle), poses):
                free = middle
            else:
                blocked = middle
        # Shrunken parts touch after the parts themselves do.
        return free - self._tolerance
