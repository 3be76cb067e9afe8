"""Search for a way out of one part in several moves, past others that rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.motions import PartMotions
from falsework.geometry.clearance.moves import Move, Way, apply
from falsework.geometry.clearance.stops import face_normals, levels, slides

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FIRST = 4.0
"""First stretch of a move, in tolerances; where it is not free, the part cannot move that way."""
_POSES = 4096
"""Poses from which moves are tried, at most."""


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search for a way out."""

    way: Way | None
    """Moves that take the part out, the fewest that were found; None if none did."""
    walls: Mask
    """Without a way, parts that suffice to close every one that was tried, shape (parts,)."""
    exact: bool
    """Without a way, whether it is proven that no straight moves, however many, take the part out past these."""


@dataclass(frozen=True, eq=False)
class _Node:
    """Pose that is reached by moves."""

    pose: Array
    way: Way


class WaySearch:
    """Search in breadth over the poses of a part at which it touches others, or is level with them.

    A move goes on until the part hits another, or is out of the box around all others, there or not. It may end there, and wherever a
    corner of the part becomes level with one of the others, since another way may open there.
    """

    def __init__(self, motions: PartMotions, part: int, others: Mask) -> None:
        """Take a part and those that it must pass, shape (parts,)."""
        self._motions, self._part, self._others = motions, part, others
        self._tolerance = motions.tolerance
        self._triangles = motions.meshes[part].triangles
        self._walls = [motions.meshes[other].triangles for other in np.flatnonzero(others)]
        self._box = motions.bounds(np.arange(len(others)) != part)
        normals, every = face_normals([self._triangles, *self._walls])
        self._directions = slides(normals)
        self._exact = every and len(normals) == 3 and bool(np.abs(normals @ normals.T - np.eye(3)).max() < 1e-9)
        self._rest_levels = [levels(self._walls, direction, self._tolerance) for direction in self._directions]
        self._closed = np.zeros_like(others)

    def run(self, moves: int) -> Found:
        """Search for a way out in up to some number of moves."""
        self._closed[:] = False
        front = [_Node(np.eye(4), ())]
        seen, tried = {self._key(front[0].pose)}, 0
        for number in range(moves):
            reached: list[_Node] = []
            for node in front:
                tried += 1
                if tried > _POSES:
                    return Found(None, self._closed, False)
                way = self._out(node)
                if way is not None:
                    return Found(way, self._closed, False)
                for pose, longer in self._further(node) if number + 1 < moves else ():
                    key = self._key(pose)
                    if key not in seen:
                        seen.add(key)
                        reached.append(_Node(pose, longer))
            front = reached
            if not front:  # more moves would not lead farther
                return Found(None, self._closed, self._exact and number + 1 < moves)
        return Found(None, self._closed, False)

    def _key(self, pose: Array) -> bytes:
        return np.round(pose[:3, 3] / (2 * self._tolerance)).astype(np.int64).tobytes()

    def _out(self, node: _Node) -> Way | None:
        """Return the way on which a straight move from a pose leads out."""
        for direction in self._begun(node):
            move = self._move(direction, self._length_out(node.pose, direction))
            if self._free(node, move):
                return (*node.way, move)
        return None

    def _further(self, node: _Node) -> list[tuple[Array, Way]]:
        """Return the poses that straight moves from a pose lead to."""
        found = []
        for direction in self._begun(node):
            for distance in self._distances(node, direction):
                move = self._move(direction, distance)
                found.append((move.displacement() @ node.pose, (*node.way, move)))
        return found

    def _begun(self, node: _Node) -> list[Array]:
        """Return the directions in which the part can begin to move, the last one and its reverse excepted."""
        last = np.array(node.way[-1].direction) if node.way else np.zeros(3)
        first = _FIRST * self._tolerance
        some = [direction for direction in self._directions if abs(direction @ last) < 1.0 - 1e-9]
        return [direction for direction in some if self._free(node, self._move(direction, first))]

    def _move(self, direction: Array, distance: float) -> Move:
        x, y, z = direction.tolist()
        return Move((self._part,), (x, y, z), float(distance))

    def _free(self, node: _Node, move: Move) -> bool:
        hit = self._motions.blockers(move, self._others, {self._part: node.pose}, stop=True)
        self._closed |= hit
        return not hit.any()

    def _length_out(self, pose: Array, direction: Array) -> float:
        """Return how far the part moves until it is beside the box around the others, m."""
        low, high = self._motions.box(self._part, pose)
        gap = np.where(direction > 0, self._box[1] - low, high - self._box[0])
        sloped = np.abs(direction) > 1e-6
        return max(float((gap[sloped] / np.abs(direction[sloped])).min()), _FIRST * self._tolerance)

    def _distances(self, node: _Node, direction: Array) -> Array:
        """Return the distances at which a move may end: where corners are level, and where the part hits another."""
        which = int(np.argmax(self._directions @ direction))
        rest, every = self._rest_levels[which]
        own, all_own = levels([apply(node.pose, self._triangles)], direction, self._tolerance)
        self._exact = self._exact and every and all_own
        stops = np.unique(np.round((rest[:, None] - own).ravel() / self._tolerance).astype(np.int64)) * self._tolerance
        exact = (rest[:, None] - own).ravel()
        # The exact distances, each once: multiples of the tolerance would drift from move to move.
        stops = exact[np.abs(exact[None] - stops[:, None]).argmin(axis=1)]
        least, most = _FIRST * self._tolerance, self._length_out(node.pose, direction)
        stops = stops[(stops > least) & (stops < most)]
        low, high = 0, len(stops)  # the first `low` stops can be reached, those from `high` on cannot
        while low < high:
            middle = (low + high) // 2
            if self._free(node, self._move(direction, stops[middle])):
                low = middle + 1
            else:
                high = middle
        before = float(stops[low - 1]) if low else 0.0
        beyond = float(stops[low]) if low < len(stops) else most
        touch = self._touch(node, direction, before, beyond)
        return np.append(stops[:low], touch) if touch is not None else stops[:low]

    def _touch(self, node: _Node, direction: Array, free: float, blocked: float) -> float | None:
        """Return the distance at which the part touches another between two stops; None where it is at the first."""
        least = _FIRST * self._tolerance
        if blocked - free <= least or not self._free(node, self._move(direction, free + least)):
            return None
        while blocked - free > 0.5 * self._tolerance:
            middle = 0.5 * (free + blocked)
            if self._free(node, self._move(direction, middle)):
                free = middle
            else:
                blocked = middle
        # Shrunken parts touch after the parts themselves do.
        return free - self._tolerance
