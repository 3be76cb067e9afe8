"""Sets of parts that lock each other: candidates for parts that can leave together only.

Where a set moves along a direction, a part blocks another if that would run into it while the others stay. A set that
can leave, and no smaller part of it before, is strongly connected in that blocking graph (Wilson and Latombe, Geometric
Reasoning about Mechanical Assembly, 1994). So sets that are strongly connected along no direction are left out here;
for the rest, sweeps decide.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.clearance.directions import sphere_directions
from falsework.utils.interruption import check_interruption

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
PartSet = tuple[int, ...]
"""Numbers of parts, ascending."""

_PLANES = 1000
"""Directions, besides the normals of contacts, along which planes are tried that separate parts."""
_SEPARATORS = 4
"""Separating planes of a pair that does not touch at most."""
_CIRCLES = 48
"""Separating planes of a set up to which directions are examined; sets with more are kept."""
LARGEST = 8
"""Parts of a set at most; all subsets of a set are examined."""
MOST_SETS = 20_000
"""Sets that are examined at most."""


class LockedSets:
    """Candidates for sets that leave together only, from the planes that separate parts."""

    def __init__(self, low: Array, high: Array, normals: Array) -> None:
        """Take what parts span.

        Args:
            low, high: where each part begins and ends along the normals, m, shape (parts, normals).
            normals: unit vectors, those of contacts first, shape (normals, 3).
        """
        self._low, self._high, self._normals = low, high, normals

    @staticmethod
    def directions(contact_normals: Array) -> Array:
        """Return normals of planes to try: those of contacts, each once, then a covering of the sphere."""
        own = np.unique(np.round(unsigned(contact_normals), 9) + 0.0, axis=0)
        return np.concatenate([own, sphere_directions(_PLANES)])

    def find(self, movable: NDArray[np.integer], largest: int, most: int = MOST_SETS) -> tuple[PartSet, ...]:
        """Return the candidates of two parts and more.

        Args:
            movable: parts that can be among them.
            largest: parts of a set at most.
            most: sets that are examined.

        Raises:
            InputError: so many sets that they cannot be examined.
        """
        found: list[PartSet] = []
        seen: set[PartSet] = {(part,) for part in movable.tolist()}
        stack = sorted(seen, reverse=True)
        while stack:
            check_interruption()
            parts = stack.pop()
            joined, near = self.neighbours(parts, movable)
            if len(parts) > 1 and joined and self._cycles(parts):
                found.append(parts)
            for part in near.tolist() if len(parts) < largest else ():
                more = tuple(sorted((*parts, part)))
                if more not in seen:
                    seen.add(more)
                    stack.append(more)
            if len(seen) > most:
                raise InputError(
                    f"more than {most} sets of up to {largest} parts may lock each other, too many to examine; allow "
                    "fewer parts at once"
                )
        return tuple(sorted(found, key=lambda parts: (len(parts), parts)))

    def may_lock(self, parts: PartSet) -> bool:
        """Return whether a set of two parts and more is a candidate."""
        return self.neighbours(parts, np.array(parts))[0] and self._cycles(parts)

    def neighbours(self, parts: PartSet, movable: NDArray[np.integer]) -> tuple[bool, NDArray[np.integer]]:
        """Return whether no plane splits a set, and parts one of which every larger set without a split has.

        A plane splits a set if the set spans no interval along its normal. Then one part must fill the gap beside the
        first part, and if there is no gap yet, one must at least touch.
        """
        rows = np.array(parts)
        low, high = self._low[rows], self._high[rows]
        touch = (low[:, None] < high[None]) & (low[None] < high[:, None])  # (parts, parts, normals)
        reached = touch[0]
        for _ in range(len(parts) - 2):
            reached = (reached[:, None] & touch).any(axis=0)
        joined = bool(reached.all())
        others = movable[~np.isin(movable, rows)]
        begins = np.where(reached, low, np.inf).min(axis=0)
        ends = np.where(reached, high, -np.inf).max(axis=0)
        beside = (self._low[others] < ends) & (self._high[others] > begins)  # (others, normals)
        count = beside.sum(axis=0)
        if not joined:
            count = np.where(reached.all(axis=0), len(others) + 1, count)
        return joined, others[beside[:, int(count.argmin())]]

    def _cycles(self, parts: PartSet) -> bool:
        """Return whether a set may be strongly connected along a direction."""
        pairs = combinations(range(len(parts)), 2)
        separators = {(a, b): self._separators(parts[a], parts[b]) for a, b in pairs}
        circles = np.concatenate(list(separators.values()))
        if not len(circles) or len(circles) > _CIRCLES:
            return True
        directions = one_in_each_cell(circles)
        blocks = np.ones((len(directions), len(parts), len(parts)), dtype=bool)
        for (a, b), normals in separators.items():
            along = directions @ normals.T
            blocks[:, a, b], blocks[:, b, a] = (along > 0).all(axis=1), (along < 0).all(axis=1)
        for middle in range(len(parts)):
            blocks |= blocks[:, :, middle, None] & blocks[:, middle, None, :]
        return bool(blocks.all(axis=(1, 2)).any())

    def _separators(self, a: int, b: int) -> Array:
        """Return normals from one part to another of planes between them, shape (planes, 3)."""
        gaps = np.stack([self._low[b] - self._high[a], self._low[a] - self._high[b]])
        side, gap = gaps.argmax(axis=0), gaps.max(axis=0)
        own = len(self._normals) - _PLANES
        chosen = np.flatnonzero(gap >= 0)
        if (chosen < own).any():
            chosen = chosen[chosen < own]
        chosen = chosen[np.argsort(-gap[chosen], kind="stable")[:_SEPARATORS]]
        return np.where(side[chosen], -1.0, 1.0)[:, None] * self._normals[chosen]


def unsigned(normals: Array) -> Array:
    """Return normals turned such that those of opposite sense are equal, shape (normals, 3)."""
    return np.where(normals @ (1.0, 0.1, 0.01) < 0, -1.0, 1.0)[:, None] * normals


def one_in_each_cell(normals: Array) -> Array:
    """Return a direction in each region into which great circles with some normals cut the sphere.

    Each region has a corner, where circles cross, unless all circles are one. So directions beside all corners are
    enough, one in each sector.
    """
    normals = np.unique(np.round(unsigned(normals), 9), axis=0)
    if len(normals) == 1:
        return np.concatenate([normals, -normals])
    first, second = np.triu_indices(len(normals), 1)
    corners = np.cross(normals[first], normals[second])
    corners /= np.linalg.norm(corners, axis=1)[:, None]
    corners = np.unique(np.round(np.concatenate([corners, -corners]), 9) + 0.0, axis=0)
    found = []
    for corner in corners:
        off = np.abs(normals @ corner)
        through = normals[off < 1e-7]
        beside = 0.5 * min(1e-3, off[off >= 1e-7].min(initial=1.0))
        one = np.cross(through[0], corner)
        other = np.cross(corner, one)
        lines = np.cross(through, corner)
        turn = np.arctan2(lines @ other, lines @ one)
        turn = np.sort(np.concatenate([turn, turn + np.pi]) % (2 * np.pi))
        middle = 0.5 * (turn + np.append(turn[1:], turn[0] + 2 * np.pi))
        found.append(corner + beside * (np.cos(middle)[:, None] * one + np.sin(middle)[:, None] * other))
    return np.concatenate(found)
