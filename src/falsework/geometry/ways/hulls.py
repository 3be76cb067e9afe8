"""Collisions of swept triangles with triangles at rest, by proven separation of convex hulls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.ways.gjk import OUTER, gap
from falsework.utils.kernels import njit

Array = NDArray[np.float64]


def swept(frames: Array) -> Array:
    """Return the corners whose convex hulls hold triangles that move linearly from each frame to the next.

    Args:
        frames: corners of triangles at several times, shape (times, triangles, 3, 3).

    Returns:
        Shape (times - 1, triangles, 6, 3), earlier times first.
    """
    return np.concatenate([frames[:-1], frames[1:]], axis=2)


@njit(**OUTER)
def first_hits(
    hulls: Array, steps: int, walls: Array, owner: NDArray[np.int64], near: float, found: NDArray[np.int64], stop: bool
) -> None:  # pragma: no cover - compiled
    """Write the first step in which each owner of triangles may come nearer than a distance to swept triangles.

    A pair counts as apart only if a plane between the two proves it.

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
    low, high = np.empty((walls_count, 3)), np.empty((walls_count, 3))
    for wall in range(walls_count):
        for k in range(3):
            a, b, c = walls[3 * wall, k], walls[3 * wall + 1, k], walls[3 * wall + 2, k]
            low[wall, k], high[wall, k] = min(a, b, c) - near, max(a, b, c) + near
    axis, scratch = np.zeros(3), np.zeros((6, 3))
    box_low, box_high = np.empty(3), np.empty(3)
    for hull in range(count):
        step = hull // a_step
        for k in range(3):
            box_low[k] = box_high[k] = hulls[6 * hull, k]
            for corner in range(1, 6):
                value = hulls[6 * hull + corner, k]
                box_low[k], box_high[k] = min(box_low[k], value), max(box_high[k], value)
        for wall in range(walls_count):
            if (
                low[wall, 0] > box_high[0]
                or high[wall, 0] < box_low[0]
                or low[wall, 1] > box_high[1]
                or high[wall, 1] < box_low[1]
                or low[wall, 2] > box_high[2]
                or high[wall, 2] < box_low[2]
                or found[owner[wall]] <= step
            ):
                continue
            axis[:] = 0.0
            if gap(hulls, 6 * hull, 6 * hull + 6, walls, 3 * wall, 3 * wall + 3, near, near, axis, scratch) <= near:
                found[owner[wall]] = step
                if stop:
                    return
