"""Proof by a triangulation of the sphere that no exit direction beats those found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import Rows
from falsework.geometry.clearance.cones import Cones
from falsework.utils.kernels import njit

Array = NDArray[np.float64]

DEEPEST = 20
"""Largest number of cuts of a triangle; the edges are then a ten thousandth of a degree."""
_TESTS = 4_000_000
"""Tests of a triangle against a cone after which one call gives up."""


@dataclass(frozen=True, eq=False)
class Triangles(Rows):
    """Triangles on the sphere of directions."""

    corners: Array
    """Unit vectors, shape (triangles, 3, 3)."""
    cut: NDArray[np.int64]
    """How often the sphere was cut to get each, shape (triangles,)."""

    def __len__(self) -> int:
        return len(self.cut)

    @classmethod
    def sphere(cls) -> Triangles:
        """Return eight triangles that make up the sphere, turned so that no usual direction is a corner."""
        turn, _ = np.linalg.qr(np.array([[0.61, 0.23, -0.42], [0.18, 0.71, 0.33], [-0.37, 0.29, 0.83]]))
        signs = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], dtype=float)
        return cls(signs[:, :, None] * turn[None], np.zeros(8, dtype=np.int64))

    @property
    def centres(self) -> Array:
        """Unit vectors, shape (triangles, 3)."""
        total = self.corners.sum(axis=1)
        return total / np.linalg.norm(total, axis=1, keepdims=True)

    def quartered(self) -> Triangles:
        """Return each one cut into four, at the middles of its edges."""
        a, b, c = self.corners[:, 0], self.corners[:, 1], self.corners[:, 2]
        ab, bc, ca = (middle / np.linalg.norm(middle, axis=1, keepdims=True) for middle in (a + b, b + c, c + a))
        pieces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(piece, axis=1) for piece in pieces])
        return Triangles(corners, np.tile(self.cut + 1, 4))


def uncovered(
    triangles: Triangles, cones: Cones, exits: NDArray[np.bool_], limit: int
) -> tuple[Triangles, NDArray[np.bool_]] | None:
    """Return triangles in which a direction may be better than the known exit directions.

    A triangle is settled if for some exit direction each of its blockers has a cone that contains the whole triangle:
    then every set of parts that leaves a direction in the triangle free leaves that exit free too. Others are
    subdivided until they are settled, or reach the limit, or until the cones do not settle even their centre.

    Args:
        triangles: triangles to be covered.
        cones: directions that parts block.
        exits: blockers of each known exit direction, shape (exits, parts), with at most 64 blockers in all.
        limit: how often the sphere may be cut.

    Returns:
        The triangles that are not settled, and which of them have a centre that is not, shape (triangles,); None
        if that is too much work.
    """
    named = np.flatnonzero(exits.any(axis=0))
    bit = np.zeros(exits.shape[1], dtype=np.uint64)
    bit[named] = np.uint64(1) << np.arange(len(named), dtype=np.uint64)
    masks = (exits * bit).sum(axis=1, dtype=np.uint64)
    corners, cut, doubtful, whole = _uncovered(
        triangles.corners, triangles.cut, cones.facets, cones.offset, cones.start, bit[cones.part], masks, limit
    )
    return (Triangles(corners, cut), doubtful) if whole else None


@njit(cache=True)
def _place(corners: Array, facets: Array, offset: Array) -> int:  # pragma: no cover - compiled
    """Return 1 if a triangle lies in a cone, -1 if outside of it, else 0."""
    inside = True
    for k in range(len(facets)):
        beyond = True
        for m in range(3):
            along = corners[m, 0] * facets[k, 0] + corners[m, 1] * facets[k, 1] + corners[m, 2] * facets[k, 2]
            if along > 0.0:
                beyond = False
            if along <= offset[k]:
                inside = False
        if beyond:
            return -1
    return 1 if inside else 0


@njit(cache=True)
def _explained(mask: np.uint64, exits: NDArray[np.uint64]) -> bool:  # pragma: no cover - compiled
    found = False
    for blockers in exits:
        found |= blockers & ~mask == np.uint64(0)
    return found


@njit(cache=True)
def _uncovered(
    roots: Array,
    cut: NDArray[np.int64],
    facets: Array,
    offset: Array,
    start: NDArray[np.int64],
    bits: NDArray[np.uint64],
    exits: NDArray[np.uint64],
    limit: int,
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_], bool]:  # pragma: no cover - compiled
    """Return corners and cuts of the rest, whether its centres are not settled, and whether the work was completed."""
    left, left_cut, doubtful = [np.zeros((3, 3))], [0], [False]
    count = len(bits)
    live = np.empty((DEEPEST + 2, count), dtype=np.int64)
    lives = np.zeros(DEEPEST + 2, dtype=np.int64)
    held = np.zeros(DEEPEST + 2, dtype=np.uint64)
    stack = np.empty((4 * (DEEPEST + 2), 3, 3))
    depths = np.empty(4 * (DEEPEST + 2), dtype=np.int64)
    tests, whole = 0, True
    for root in range(len(roots)):
        # Row `depth` is about the triangle that is being cut at this depth: cones that contain it wholly,
        # and those whose boundary may cross it.
        live[0] = np.arange(count)
        lives[0] = count
        held[0] = 0
        stack[0] = roots[root]
        depths[0] = 0
        top = 1
        while top > 0:
            top -= 1
            corners, depth = stack[top].copy(), depths[top]
            mask: Any = held[depth]
            kept = 0
            for k in range(lives[depth]):
                cone = live[depth, k]
                if bits[cone] & ~mask == np.uint64(0):
                    continue
                place = _place(corners, facets[start[cone] : start[cone + 1]], offset[start[cone] : start[cone + 1]])
                if place > 0:
                    mask |= bits[cone]
                elif place == 0:
                    live[depth + 1, kept] = cone
                    kept += 1
            tests += lives[depth]
            if _explained(mask, exits):
                continue
            lives[depth + 1], held[depth + 1] = kept, mask
            centre = corners[0] + corners[1] + corners[2]
            centre /= np.sqrt((centre**2).sum())
            for k in range(kept):
                cone = live[depth + 1, k]
                if bits[cone] & ~mask == np.uint64(0):
                    continue
                inside = True
                for facet in range(start[cone], start[cone + 1]):
                    if (facets[facet] * centre).sum() <= offset[facet]:
                        inside = False
                        break
                if inside:
                    mask |= bits[cone]
            settled = _explained(mask, exits)
            if not settled or cut[root] + depth >= limit:
                left.append(corners)
                left_cut.append(cut[root] + depth)
                doubtful.append(not settled)
                continue
            if tests > _TESTS:
                whole = False
                break
            middle = np.empty((3, 3))
            for m in range(3):
                middle[m] = corners[m] + corners[(m + 1) % 3]
                middle[m] /= np.sqrt((middle[m] ** 2).sum())
            for m in range(3):
                stack[top + m, 0] = corners[m]
                stack[top + m, 1] = middle[m]
                stack[top + m, 2] = middle[(m + 2) % 3]
            stack[top + 3] = middle
            depths[top : top + 4] = depth + 1
            top += 4
        if not whole:
            break
    corners = np.empty((len(left) - 1, 3, 3))
    for k in range(1, len(left)):
        corners[k - 1] = left[k]
    return corners, np.array(left_cut)[1:], np.array(doubtful)[1:], whole
