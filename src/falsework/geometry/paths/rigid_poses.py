"""Poses of rigid parts: which can begin to move where, alone or with others, and where they may stop."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import apply
from falsework.geometry.clearance.moves import PathMove, Poses, after
from falsework.geometry.paths.cells import closed_sets
from falsework.geometry.paths.departure import Departure, Parts
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.stops import face_normals, levels, slides
from falsework.geometry.paths.turning_moves import TurningMoves

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Begun = tuple[Array, Parts]
"""Unit vector along which parts can begin to move, and these."""

_FIRST = 4.0
"""First stretch of a move, in tolerances; where it is not free, the part cannot move that way."""
_HOME = np.eye(4)


class RigidPoses:
    """Poses of some parts past others that rest, with swept tests of the moves between them.

    A move may end wherever corners of the parts that move become level with corners of others, since another way may
    open there, and where it touches another part.
    """

    def __init__(self, motions: PartMotions, departure: Departure, *, turns: bool) -> None:
        """Take swept tests of parts, those that are to leave, and whether one that leaves alone may turn."""
        self._motions, self._departure, self._tolerance = motions, departure, motions.tolerance
        leaving, movable, rest = departure.leaving, departure.movable, departure.rest
        self._leaving, self._movable, self._rest = leaving, movable, rest
        self._first = _FIRST * motions.tolerance
        self._there = rest.copy()
        self._there[list(movable)] = True
        self._walls = [motions.meshes[part].triangles for part in np.flatnonzero(rest).tolist()]
        self._normals: dict[bytes, Array] = {}
        self._rest_levels: dict[bytes, tuple[Array, bool]] = {}
        self._corners = {one: _four_corners(motions.box(one)) for one in movable}
        self._turning = TurningMoves(motions, leaving[0], self._there) if turns and len(leaving) == 1 else None
        self.walls = np.zeros_like(rest)
        """Parts at rest that moves have hit so far, shape (parts,)."""
        self.exact = not turns
        """Whether all straight moves that matter were listed so far."""

    def key(self, at: Poses) -> bytes:
        """Return a name of poses: where they take the corners of the parts."""
        corners = [apply(at.get(part, _HOME), self._corners[part]) for part in self._movable]
        return np.round(np.array(corners) / (2 * self._tolerance)).astype(np.int64).tobytes()

    def begun(self, at: Poses, last: PathMove | None) -> Iterator[Begun]:
        """Yield what can begin to move, and where; parts that moved last do not go on, or back, along the same line."""
        for direction in self._directions(at):
            again = last is not None and not last.turns and abs(direction @ np.array(last.direction)) > 1.0 - 1e-9
            for parts in self._beginnings(at, direction):
                if (last is None or not (again and parts == last.parts)) and self._departure.can_carry(parts):
                    yield direction, parts

    def out(self, at: Poses, begun: Begun) -> PathMove | None:
        """Return the move by which parts that begin to move are out; None if others are to leave, or it is not free."""
        direction, parts = begun
        if not self._departure.leaves(parts):
            return None
        move = PathMove.straight(parts, direction, self._length(at, parts, direction))
        return move if self._free(move, at) else None

    def ends(self, at: Poses, begun: Begun) -> Iterator[tuple[Poses, PathMove, bool]]:
        """Yield poses at which parts that begin to move may stop, the moves there, and whether they go no farther."""
        direction, parts = begun
        distances = self._distances(parts, at, direction, self._length(at, parts, direction))
        for distance in distances:
            move = PathMove.straight(parts, direction, distance)
            yield after((move,), at), move, distance == distances[-1]

    def turned(self, at: Poses, last: PathMove | None) -> Iterator[tuple[Poses, PathMove, bool]]:
        """Yield poses after turns, these, and whether the part is out; none about the axis of the last move again."""
        if self._turning is None:
            return
        around = self._box_around(at, self._leaving)
        for move in self._turning.moves(at, around):
            if last is None or not (last.turns and abs(np.array(last.direction) @ move.direction) > 1.0 - 1e-9):
                then = after((move,), at)
                box = self._motions.box(move.parts[0], then[move.parts[0]])
                yield then, move, bool(((box[0] >= around[1]) | (box[1] <= around[0])).any())
        self.walls |= self._turning.walls

    def _length(self, at: Poses, parts: Parts, direction: Array) -> float:
        """Return how far parts move until one of them, or all that leave, are beside the box around others, m."""
        low, high = self._box_around(at, parts)
        sloped, lengths = np.abs(direction) > 1e-6, []
        for part in parts:
            box = self._motions.box(part, at.get(part, _HOME))
            gap = np.where(direction > 0, high - box[0], box[1] - low)
            lengths.append(float((gap[sloped] / np.abs(direction[sloped])).min()))
        return max(max(lengths) if self._departure.leaves(parts) else min(lengths), self._first)

    def _box_around(self, at: Poses, parts: Parts) -> Array:
        """Return the box around all parts but those that leave where only these move, shape (2, 3), m.

        It holds parts in place, there or not, and those that are aside where they are.
        """
        low, high = self._departure.beside if self._departure.leaves(parts) else self._departure.around
        for part, pose in at.items():
            if part not in parts:
                box = self._motions.box(part, pose)
                low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
        return np.stack([low, high])

    def _directions(self, at: Poses) -> Array:
        """Return unit vectors along which parts can slide on others, shape (directions, 3)."""
        key = b"".join(np.round(pose[:3, :3] * 1e6).astype(np.int64).tobytes() for _, pose in sorted(at.items()))
        if key not in self._normals:
            turned = [apply(at.get(part, _HOME), self._motions.meshes[part].triangles) for part in self._movable]
            normals, every = face_normals([*turned, *self._walls])
            self.exact &= every and len(normals) == 3 and bool(np.abs(normals @ normals.T - np.eye(3)).max() < 1e-9)
            self._normals[key] = slides(normals)
        return self._normals[key]

    def _beginnings(self, at: Poses, direction: Array) -> list[Parts]:
        """Return the sets of parts that can begin to move in a direction as one body, the smaller ones first."""
        blocked, pushed, alone = 0, list[int](), len(self._movable) == 1
        for place, part in enumerate(self._movable):
            hit = self._motions.blockers(
                PathMove.straight((part,), direction, self._first), self._there, at, stop=alone
            )
            self.walls |= hit & self._rest
            blocked |= bool((hit & self._rest).any()) << place
            pushed.append(1 << place | sum(1 << k for k, other in enumerate(self._movable) if hit[other]))
        found = closed_sets(pushed, blocked)
        return [tuple(sorted(part for k, part in enumerate(self._movable) if some >> k & 1)) for some in found]

    def _free(self, move: PathMove, at: Poses) -> bool:
        hit = self._motions.blockers(move, self._there, at, stop=True)
        self.walls |= hit & self._rest
        return not hit.any()

    def _distances(self, parts: Parts, at: Poses, direction: Array, most: float) -> Array:
        """Return the distances, up to `most`, at which a move may end, ascending."""
        others = [part for part in self._movable if part not in parts]
        beside = [self._levels_of_rest(direction), *(self._levels_of([part], at, direction) for part in others)]
        own = self._levels_of(parts, at, direction)
        stops = np.unique((np.concatenate(beside)[:, None] - own).ravel())
        stops = stops[(stops > self._first) & (stops < most + self._tolerance)]
        stops = stops[np.diff(stops, prepend=0.0) > self._tolerance]
        low, high = 0, len(stops)  # the first `low` stops can be reached, those from `high` on cannot
        while low < high:
            middle = (low + high) // 2
            if self._free(PathMove.straight(parts, direction, stops[middle]), at):
                low = middle + 1
            else:
                high = middle
        before = float(stops[low - 1]) if low else 0.0
        beyond = float(stops[low]) if low < len(stops) else most
        touch = self._touch(parts, at, direction, before, beyond)
        return stops[:low] if touch is None else np.append(stops[:low], touch)

    def _levels_of_rest(self, direction: Array) -> Array:
        key = np.round(direction * 1e6).astype(np.int64).tobytes()
        if key not in self._rest_levels:
            nothing = np.zeros(0), True
            self._rest_levels[key] = levels(self._walls, direction, self._tolerance) if self._walls else nothing
        values, every = self._rest_levels[key]
        self.exact &= every
        return values

    def _levels_of(self, parts: Sequence[int], at: Poses, direction: Array) -> Array:
        turned = [apply(at.get(part, _HOME), self._motions.meshes[part].triangles) for part in parts]
        values, every = levels(turned, direction, self._tolerance)
        self.exact &= every
        return values

    def _touch(self, parts: Parts, at: Poses, direction: Array, free: float, blocked: float) -> float | None:
        """Return the distance at which parts touch another between two stops; None where they do at the first."""
        if blocked - free <= self._first or not self._free(PathMove.straight(parts, direction, free + self._first), at):
            return None
        while blocked - free > 0.5 * self._tolerance:
            middle = 0.5 * (free + blocked)
            if self._free(PathMove.straight(parts, direction, middle), at):
                free = middle
            else:
                blocked = middle
        # Shrunken parts touch after the parts themselves do.
        return free - self._tolerance


def _four_corners(box: Array) -> Array:
    """Return four corners of a box that do not lie in one plane, shape (4, 3)."""
    return np.concatenate([box[:1], np.where(np.eye(3, dtype=bool), box[1], box[0])])
