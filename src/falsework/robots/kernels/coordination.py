"""Compiled test of which segments of two arms' motions may coincide in time.

A motion is divided into cells. Every body of the arm is enclosed in an offset of its pose at the middle of a cell:
none of its points moves farther than a known bound within the cell. Two cells of two arms are compatible if each pair
of bodies keeps the margin plus both bounds; then the arms cannot collide at any point of these cells. Incompatible
cells are divided into `SPLIT` finer ones each and count as compatible if all pairs of these are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.paths.gjk import INNER, OUTER, gap
from falsework.robots.kernels.collision import Bodies, Chain, place_frames
from falsework.robots.kernels.kernel_arrays import bounds_of
from falsework.utils.kernels import njit

Array = NDArray[np.float64]

SPLIT = 4
"""Finer cells per cell."""


class Swept(NamedTuple):
    """Swept bodies of one arm over the cells of one motion."""

    start: NDArray[np.int64]
    """Rows of `vertices[cell]` of body b are `start[b]:start[b + 1]`."""
    vertices: Array
    """World coordinates at the middle of each cell, shape (cells, vertices, 3)."""
    center: Array
    """Centres of bounding spheres of the bodies, shape (cells, bodies, 3)."""
    radius: Array
    """Radii of these spheres, shape (bodies,)."""
    swept: Array
    """Bound on the distance of any point of a body from its place at the middle of the cell, shape (cells, bodies)."""
    low: Array
    """Lower corner of a box around all bodies, bounds included, shape (cells, 3)."""
    high: Array


@njit(**OUTER)
def _place(values, spread, chain, bodies, first, vertices, center, swept, low, high):
    """Fill the arrays of `Swept` for bodies from `first` on."""
    frames = np.empty((len(chain.origin) + 1, 3, 4))
    offset = bodies.start[first]
    for cell in range(len(values)):
        place_frames(values[cell], chain, frames)
        for r in range(3):
            low[cell, r], high[cell, r] = 1e300, -1e300
        for b in range(first, len(bodies.frame)):
            pose = frames[bodies.frame[b]]
            far = 0.0
            for j in range(values.shape[1]):
                far += bodies.sweep[b, j] * spread[cell, j]
            swept[cell, b - first] = far
            for r in range(3):
                center[cell, b - first, r] = (
                    pose[r, 0] * bodies.center[b, 0]
                    + pose[r, 1] * bodies.center[b, 1]
                    + pose[r, 2] * bodies.center[b, 2]
                    + pose[r, 3]
                )
            for i in range(bodies.start[b], bodies.start[b + 1]):
                for r in range(3):
                    value = (
                        pose[r, 0] * bodies.vertices[i, 0]
                        + pose[r, 1] * bodies.vertices[i, 1]
                        + pose[r, 2] * bodies.vertices[i, 2]
                        + pose[r, 3]
                    )
                    vertices[cell, i - offset, r] = value
                    low[cell, r] = min(low[cell, r], value - far)
                    high[cell, r] = max(high[cell, r], value + far)


def sweep(values: Array, spread: Array, chain: Chain, bodies: Bodies) -> Swept:
    """Return the swept bodies of an arm over some cells, without its base, which does not move.

    Args:
        values: joint values at the middle of each cell, shape (cells, joints).
        spread: largest deviation of each joint from there within the cell, shape (cells, joints).
        chain: kinematics of the arm.
        bodies: its pieces, those of the base first.
    """
    first = int(np.searchsorted(bodies.frame, 1))
    count, cells = len(bodies.frame) - first, len(values)
    made = Swept(
        bodies.start[first:] - bodies.start[first],
        np.empty((cells, int(bodies.start[-1] - bodies.start[first]), 3)),
        np.empty((cells, count, 3)),
        np.array(bodies.radius[first:]),
        np.empty((cells, count)),
        np.empty((cells, 3)),
        np.empty((cells, 3)),
    )
    _place(
        np.ascontiguousarray(values),
        np.ascontiguousarray(spread),
        chain,
        bodies,
        first,
        made.vertices,
        made.center,
        made.swept,
        made.low,
        made.high,
    )
    return made


def still(pieces: tuple[Array, ...]) -> Swept:
    """Return fixed bodies, such as a part in place, as a single cell."""
    start, vertices, center, radius = bounds_of(pieces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return Swept(start, vertices[None], center[None], radius, np.zeros((1, len(pieces))), low[None], high[None])


@njit(**INNER)
def _meet(one, i, other, j, margin, axis, scratch):
    """Return whether two cells are not proven to keep the margin."""
    for r in range(3):
        if one.low[i, r] - margin > other.high[j, r] or one.high[i, r] + margin < other.low[j, r]:
            return False
    for back in range(len(one.radius)):
        a = len(one.radius) - 1 - back  # load and gripper are the likeliest to collide
        for b in range(len(other.radius)):
            keep = margin + one.swept[i, a] + other.swept[j, b]
            reach = keep + one.radius[a] + other.radius[b]
            dx = one.center[i, a, 0] - other.center[j, b, 0]
            dy = one.center[i, a, 1] - other.center[j, b, 1]
            dz = one.center[i, a, 2] - other.center[j, b, 2]
            if dx * dx + dy * dy + dz * dz > reach * reach:
                continue
            found = gap(
                one.vertices[i],
                one.start[a],
                one.start[a + 1],
                other.vertices[j],
                other.start[b],
                other.start[b + 1],
                keep,
                keep,
                axis[a, b],
                scratch,
            )
            if found <= keep:
                return True
    return False


@njit(**OUTER)
def _conflicts(one, one_fine, other, other_fine, margin, axis, scratch, found):
    for i in range(len(one.low)):
        for j in range(len(other.low)):
            met = _meet(one, i, other, j, margin, axis, scratch)
            if met:
                met = False
                lots, many = len(one_fine.low) // len(one.low), len(other_fine.low) // len(other.low)
                for k in range(lots):
                    for m in range(many):
                        if not met and _meet(one_fine, i * lots + k, other_fine, j * many + m, margin, axis, scratch):
                            met = True
            found[i, j] = met


def conflicts(one: tuple[Swept, Swept], other: tuple[Swept, Swept], margin: float) -> NDArray[np.bool_]:
    """Return which cells of two motions are not proven to keep a distance.

    Args:
        one, other: a motion in cells and in finer cells, a fixed number of them per cell.
        margin: the distance, metres.

    Returns:
        Shape (cells of one, cells of the other).
    """
    found = np.zeros((len(one[0].low), len(other[0].low)), np.bool_)
    axis = np.zeros((len(one[0].radius), len(other[0].radius), 3))
    _conflicts(*one, *other, margin, axis, np.empty((6, 3)), found)
    return found
