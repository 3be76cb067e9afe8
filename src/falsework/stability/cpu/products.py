"""Products of small dense matrices in vector registers, for kernels.

numba keeps sums over a small matrix in memory, since it cannot tell that its arrays do not overlap. Here sums are
vectors of up to eight numbers, which stay in registers. Arrays are contiguous, whatever their shape; a matrix in one is
the place of its first entry and the distance of its rows.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

from falsework.utils.kernels import Kernel, njit

LANES = 8
"""Columns that are computed at once; what is left of an even number of columns takes half as many, and a quarter."""


class Operation:
    """Operation of `vectors.py` on so many numbers, called by name."""

    def __init__(self, name: str, width: int) -> None:
        self.name, self.width = name, width

    def __call__(self, *arguments: Any) -> Any:
        """Refuse to run outside of a kernel."""
        raise TypeError(f"{self.name} is part of kernels; call a kernel that uses it")

    @cached_property
    def _numba_type_(self) -> Any:
        from falsework.utils.vectors import function_type

        return function_type(self.name, self.width)


def _columns(sign: int, width: int, *, adds: bool) -> Kernel:
    """Return the product for so many columns."""
    load, spread, store = Operation("load", width), Operation("spread", width), Operation("store", width)
    zeros, fused = Operation("zeros", width), Operation("add" if sign > 0 else "subtract", width)

    @njit(fastmath=True, forceinline=True)
    def columns(left, place, wide, right, place_right, wide_right, out, place_out, wide_out, sixes):
        o0, o1 = place_out, place_out + wide_out
        o2, o3, o4, o5 = o1 + wide_out, o1 + 2 * wide_out, o1 + 3 * wide_out, o1 + 4 * wide_out
        if adds:
            s0, s1, s2 = load(out, o0), load(out, o1), load(out, o2)
            s3, s4, s5 = load(out, o3), load(out, o4), load(out, o5)
        else:
            s0 = zeros()
            s1, s2, s3, s4, s5 = s0, s0, s0, s0, s0
        for _ in range(6 * sixes):
            row = load(right, place_right)
            s0 = fused(s0, spread(left, place), row)
            s1 = fused(s1, spread(left, place + 1), row)
            s2 = fused(s2, spread(left, place + 2), row)
            s3 = fused(s3, spread(left, place + 3), row)
            s4 = fused(s4, spread(left, place + 4), row)
            s5 = fused(s5, spread(left, place + 5), row)
            place, place_right = place + wide, place_right + wide_right
        store(s0, out, o0)
        store(s1, out, o1)
        store(s2, out, o2)
        store(s3, out, o3)
        store(s4, out, o4)
        store(s5, out, o5)

    return columns


def product(sign: int, *, adds: bool = True) -> Kernel:
    """Return a kernel for `out + sign left^T right`, or without the first term, written to the six rows of `out`.

    Its arguments are `left`, `right` and `out`, each as an array, the place of its first entry and the distance of its
    rows; then the rows of `left` and `right` in sixes, and the number of columns of `right` and `out`, which is even.
    `left` has six columns. Without the first term `out` may be `right`, if that has six rows.
    """
    eight, four, two = (_columns(sign, width, adds=adds) for width in (LANES, LANES // 2, LANES // 4))

    @njit(fastmath=True, forceinline=True)
    def run(left, place, wide, right, place_right, wide_right, out, place_out, wide_out, sixes, columns):
        first = columns & -LANES
        for c in range(0, first, LANES):
            eight(left, place, wide, right, place_right + c, wide_right, out, place_out + c, wide_out, sixes)
        if columns & 4:
            four(left, place, wide, right, place_right + first, wide_right, out, place_out + first, wide_out, sixes)
            first += 4
        if columns & 2:
            two(left, place, wide, right, place_right + first, wide_right, out, place_out + first, wide_out, sixes)

    return run


def square_product(*, adds: bool = True) -> Kernel:
    """Return a kernel for the sum of the same and eight columns, six rows of `left`: without the last two arguments."""
    eight = _columns(1, LANES, adds=adds)

    @njit(fastmath=True, forceinline=True)
    def run(left, place, wide, right, place_right, wide_right, out, place_out, wide_out):
        eight(left, place, wide, right, place_right, wide_right, out, place_out, wide_out, 1)

    return run


_load, _spread, _store = Operation("load", LANES), Operation("spread", LANES), Operation("store", LANES)
_zeros, _add = Operation("zeros", LANES), Operation("add", LANES)


@njit(fastmath=True, forceinline=True)
def congruence(rows, point, matrices, points, out):
    """Set `out`, six rows of eight numbers, to the sum of `B k^T B^T` over points, `B` of shape (6, 3).

    Args:
        rows: three rows of `B^T` for each point, in eight numbers each, of which the first six count.
        point: the first point in `rows`.
        matrices: `k` in nine numbers for each point, from the first one on.
        points: how many.
        out: the sum.
    """
    s0 = _zeros()
    s1, s2, s3, s4, s5 = s0, s0, s0, s0, s0
    for p in range(points):
        b, k = 3 * LANES * (point + p), 9 * p
        axis0, axis1, axis2 = _load(rows, b), _load(rows, b + LANES), _load(rows, b + 2 * LANES)
        for i in range(3):  # column `i` of the matrix: the transposed one acts
            image = _add(_zeros(), _spread(matrices, k + i), axis0)
            image = _add(image, _spread(matrices, k + 3 + i), axis1)
            image = _add(image, _spread(matrices, k + 6 + i), axis2)
            at = b + LANES * i
            s0 = _add(s0, _spread(rows, at), image)
            s1 = _add(s1, _spread(rows, at + 1), image)
            s2 = _add(s2, _spread(rows, at + 2), image)
            s3 = _add(s3, _spread(rows, at + 3), image)
            s4 = _add(s4, _spread(rows, at + 4), image)
            s5 = _add(s5, _spread(rows, at + 5), image)
    _store(s0, out, 0)
    _store(s1, out, LANES)
    _store(s2, out, 2 * LANES)
    _store(s3, out, 3 * LANES)
    _store(s4, out, 4 * LANES)
    _store(s5, out, 5 * LANES)
