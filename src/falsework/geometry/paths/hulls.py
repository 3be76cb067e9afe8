"""Collisions of swept triangles with triangles at rest, by proven separation of convex hulls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.paths.gjk import INNER, OUTER, gap
from falsework.utils.kernels import njit

Array = NDArray[np.float64]

_BLOCK = 16
"""Triangles whose common box is compared first."""


def swept(frames: Array) -> Array:
    """Return the corners whose convex hulls hold triangles that move linearly from each frame to the next.

    Args:
        frames: corners of triangles at several times, shape (times, triangles, 3, 3).

    Returns:
        Shape (times - 1, triangles, 6, 3), earlier times first.
    """
    return np.concatenate([frames[:-1], frames[1:]], axis=2)


def near_order(triangles: Array) -> NDArray[np.int64]:
    """Return an order of triangles, shape (triangles, 3, 3), in which neighbours are near each other.

    That of the middles along a curve that visits octants one after the other (Morton, 1966).
    """
    middles = triangles.mean(axis=1)
    span = np.ptp(middles, axis=0).max() or 1.0
    cells = ((middles - middles.min(axis=0)) / span * 1023).astype(np.int64)
    key = np.zeros(len(cells), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


@njit(**INNER)
def _boxes(corners: Array, size: int, grow: float, boxes: Array) -> None:  # pragma: no cover - compiled
    """Write the boxes around every `size` rows of corners, lowest then highest, to `boxes`, shape (count, 6)."""
    for row in range(len(boxes)):
        for k in range(3):
            low = high = corners[size * row, k]
            for corner in range(size * row + 1, min(size * row + size, len(corners))):
                value = corners[corner, k]
                low, high = min(low, value), max(high, value)
            boxes[row, k], boxes[row, k + 3] = low - grow, high + grow


@njit(**INNER)
def _overlap(a: Array, i: int, b: Array, j: int) -> bool:  # pragma: no cover - compiled
    """Return whether two boxes have a point in common."""
    return (
        a[i, 0] <= b[j, 3]
        and a[i, 3] >= b[j, 0]
        and a[i, 1] <= b[j, 4]
        and a[i, 4] >= b[j, 1]
        and a[i, 2] <= b[j, 5]
        and a[i, 5] >= b[j, 2]
    )


@njit(**OUTER)
def first_hits(
    hulls: Array, steps: int, walls: Array, owner: NDArray[np.int64], near: float, found: NDArray[np.int64], stop: bool
) -> None:  # pragma: no cover - compiled
    """Write the first step in which each owner of triangles may come nearer than a distance to swept triangles.

    A pair counts as apart only if a plane between the two proves it. Boxes around `_BLOCK` of both are compared first.

    Args:
        hulls: corners of swept triangles, six each, step by step, shape (6 hulls, 3), metres.
        steps: number of steps, with equally many hulls.
        walls: corners of triangles at rest, shape (3 triangles, 3), metres.
        owner: of each of these, shape (triangles,).
        near: the distance, metres.
        found: for each owner `steps`, or a step after which it does not matter; the result, shape (owners,).
        stop: return after the first hit.
    """
    count, walls_count = len(hulls) // 6, len(owner)
    a_step = count // steps
    hull_boxes, wall_boxes = np.empty((count, 6)), np.empty((walls_count, 6))
    _boxes(hulls, 6, 0.0, hull_boxes)
    _boxes(walls, 3, near, wall_boxes)
    wall_blocks = np.empty(((walls_count + _BLOCK - 1) // _BLOCK, 6))
    _boxes(walls, 3 * _BLOCK, near, wall_blocks)
    block = np.empty((1, 6))
    axis, scratch = np.zeros(3), np.zeros((6, 3))
    for step in range(steps):
        for first in range(step * a_step, (step + 1) * a_step, _BLOCK):
            last = min(first + _BLOCK, (step + 1) * a_step)
            _boxes(hulls[6 * first : 6 * last], 6 * _BLOCK, 0.0, block)
            for part in range(len(wall_blocks)):
                if not _overlap(block, 0, wall_blocks, part):
                    continue
                for hull in range(first, last):
                    if not _overlap(hull_boxes, hull, wall_blocks, part):
                        continue
                    for wall in range(part * _BLOCK, min(part * _BLOCK + _BLOCK, walls_count)):
                        if found[owner[wall]] <= step or not _overlap(hull_boxes, hull, wall_boxes, wall):
                            continue
                        axis[:] = 0.0
                        a, b = 6 * hull, 3 * wall
                        if gap(hulls, a, a + 6, walls, b, b + 3, near, near, axis, scratch) <= near:
                            found[owner[wall]] = step
                            if stop:
                                return
