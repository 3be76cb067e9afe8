"""Tangent stiffness of a state, its sparse block factor `L U`, and solves with it.

The matrix has the pattern of `elimination.py`. Where contact points slide it is not symmetric, so blocks above the
diagonal are kept too, transposed, in the places of their mirror images.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from falsework.stability.cpu.layout import FAST


@nb.njit(fastmath=True)
def _invert(block, b, work, inverse):
    """Inverse of a 6 x 6 block by elimination with row pivots; False if it is singular."""
    for i in range(6):
        for j in range(6):
            work[i, j] = block[b, i, j]
            inverse[i, j] = 1.0 if i == j else 0.0
    for k in range(6):
        best = k
        for i in range(k + 1, 6):
            if abs(work[i, k]) > abs(work[best, k]):
                best = i
        if not abs(work[best, k]) > 1e-300:
            return False
        if best != k:
            for j in range(6):
                work[k, j], work[best, j] = work[best, j], work[k, j]
                inverse[k, j], inverse[best, j] = inverse[best, j], inverse[k, j]
        scale = 1.0 / work[k, k]
        for j in range(6):
            work[k, j] *= scale
            inverse[k, j] *= scale
        for i in range(6):
            if i != k:
                share = work[i, k]
                for j in range(6):
                    work[i, j] -= share * work[k, j]
                    inverse[i, j] -= share * inverse[k, j]
    return True


# Products below run along rows of their right factor, so that the compiler keeps whole rows in vector registers;
# written as inner products of rows they take half as long again.


@nb.njit(inline="always", fastmath=True)
def _transpose(block, e, out):
    """`out = block[e]^T`."""
    for r in range(6):
        for c in range(6):
            out[c, r] = block[e, r, c]


@nb.njit(inline="always", fastmath=True)
def _subtract(left, e, right, out, t):
    """`out[t] -= left[e] right`."""
    for r in range(6):
        x0, x1, x2 = left[e, r, 0], left[e, r, 1], left[e, r, 2]
        x3, x4, x5 = left[e, r, 3], left[e, r, 4], left[e, r, 5]
        for c in range(6):
            out[t, r, c] -= (
                x0 * right[0, c]
                + x1 * right[1, c]
                + x2 * right[2, c]
                + x3 * right[3, c]
                + x4 * right[4, c]
                + x5 * right[5, c]
            )


@nb.njit(inline="always", fastmath=True)
def _product(left, e, right, out):
    """`out = left[e] right`."""
    for r in range(6):
        x0, x1, x2 = left[e, r, 0], left[e, r, 1], left[e, r, 2]
        x3, x4, x5 = left[e, r, 3], left[e, r, 4], left[e, r, 5]
        for c in range(6):
            out[r, c] = (
                x0 * right[0, c]
                + x1 * right[1, c]
                + x2 * right[2, c]
                + x3 * right[3, c]
                + x4 * right[4, c]
                + x5 * right[5, c]
            )


@nb.njit(fastmath=True, cache=True)
def factor_lu(elimination, free, diagonal, lower, upper, filled):
    """Replace a matrix by its block factor: `diagonal` by the inverse pivots, `lower` by `L`, `upper` by `U^T`.

    Args:
        elimination: the structure's pattern.
        free: which positions take part, shape (n,).
        diagonal: shape (n, 6, 6); overwritten.
        lower: blocks below the diagonal, shape (blocks, 6, 6); overwritten.
        upper: transposes of the mirrored blocks above it, shape (blocks, 6, 6); overwritten.
        filled: which blocks are not zero, shape (blocks,); fill is marked as it appears.

    Returns:
        False if a pivot block is singular.
    """
    column, row = elimination.column, elimination.row
    first_target, target = elimination.first_target, elimination.target
    copy, inverse = np.empty((6, 6)), np.empty((6, 6))
    lower_turned, upper_turned = np.empty((6, 6)), np.empty((6, 6))
    for j in range(len(free)):
        if not free[j]:
            continue
        if not _invert(diagonal, j, copy, inverse):
            return False
        for r in range(6):
            for c in range(6):
                diagonal[j, r, c] = inverse[r, c]
        for e in range(column[j], column[j + 1]):
            if filled[e]:
                _product(lower, e, inverse, copy)
                for r in range(6):
                    for c in range(6):
                        lower[e, r, c] = copy[r, c]
        for e2 in range(column[j], column[j + 1]):
            if not filled[e2]:
                continue
            _transpose(lower, e2, lower_turned)
            _transpose(upper, e2, upper_turned)
            _subtract(lower, e2, upper_turned, diagonal, row[e2])
            for e1 in range(e2 + 1, column[j + 1]):
                if filled[e1]:
                    t = target[first_target[e2] + e1 - e2 - 1]
                    filled[t] = True
                    _subtract(lower, e1, upper_turned, lower, t)
                    _subtract(upper, e1, lower_turned, upper, t)
    return True


@nb.njit(fastmath=True, cache=True)
def solve_lu(elimination, free, diagonal, lower, upper, filled, x):
    """Solve with the factor made by `factor_lu`, in place; `x` has shape (n, 6)."""
    column, row = elimination.column, elimination.row
    n = len(free)
    for j in range(n):
        if not free[j]:
            continue
        x0, x1, x2, x3, x4, x5 = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5]
        for e in range(column[j], column[j + 1]):
            if filled[e]:
                i = row[e]
                for r in range(6):
                    x[i, r] -= (
                        lower[e, r, 0] * x0
                        + lower[e, r, 1] * x1
                        + lower[e, r, 2] * x2
                        + lower[e, r, 3] * x3
                        + lower[e, r, 4] * x4
                        + lower[e, r, 5] * x5
                    )
    for j in range(n - 1, -1, -1):
        if not free[j]:
            continue
        for e in range(column[j], column[j + 1]):
            if filled[e]:
                i = row[e]
                x0, x1, x2, x3, x4, x5 = x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5]
                for c in range(6):
                    x[j, c] -= (
                        upper[e, 0, c] * x0
                        + upper[e, 1, c] * x1
                        + upper[e, 2, c] * x2
                        + upper[e, 3, c] * x3
                        + upper[e, 4, c] * x4
                        + upper[e, 5, c] * x5
                    )
        x0, x1, x2, x3, x4, x5 = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5]
        for r in range(6):
            x[j, r] = (
                diagonal[j, r, 0] * x0
                + diagonal[j, r, 1] * x1
                + diagonal[j, r, 2] * x2
                + diagonal[j, r, 3] * x3
                + diagonal[j, r, 4] * x4
                + diagonal[j, r, 5] * x5
            )


@nb.njit(inline="always", fastmath=FAST)
def _add_product(left, right, q, out, e):
    """`out[e] += left right[q]`."""
    for r in range(6):
        x0, x1, x2, x3, x4, x5 = left[r, 0], left[r, 1], left[r, 2], left[r, 3], left[r, 4], left[r, 5]
        for c in range(6):
            out[e, r, c] += (
                x0 * right[q, 0, c]
                + x1 * right[q, 1, c]
                + x2 * right[q, 2, c]
                + x3 * right[q, 3, c]
                + x4 * right[q, 4, c]
                + x5 * right[q, 5, c]
            )


@nb.njit(inline="always", fastmath=FAST)
def _cross(left, right, q, out):
    """`out = left right[q]`."""
    for r in range(6):
        x0, x1, x2, x3, x4, x5 = left[r, 0], left[r, 1], left[r, 2], left[r, 3], left[r, 4], left[r, 5]
        for c in range(6):
            out[r, c] = (
                x0 * right[q, 0, c]
                + x1 * right[q, 1, c]
                + x2 * right[q, 2, c]
                + x3 * right[q, 3, c]
                + x4 * right[q, 4, c]
                + x5 * right[q, 5, c]
            )


@nb.njit(fastmath=FAST, cache=True)
def add_pair(ta, tb, turned_a, turned_b, q, a, b, e, local, symmetric, diagonal, lower, upper, scratch):
    """Add the stiffness about the middle of a pair to the matrix.

    Args:
        ta, tb, turned_a, turned_b: `transfer_a` and `transfer_b` of the structure, and their transposes.
        q, a, b, e: the pair, the positions of its parts (-1 where one cannot move), and its block.
        local: the stiffness, shape (6, 6).
        symmetric: whether it is symmetric.
        diagonal, lower, upper: the matrix, as `factor_lu` takes it.
        scratch: three matrices, each of shape (6, 6).
    """
    left_a, left_b, cross = scratch
    if a >= 0:
        _product(ta, q, local, left_a)
        _add_product(left_a, turned_a, q, diagonal, a)
    if b >= 0:
        _product(tb, q, local, left_b)
        _add_product(left_b, turned_b, q, diagonal, b)
    if a < 0 or b < 0:
        return
    if b > a:
        _cross(left_b, turned_a, q, cross)
    else:
        _cross(left_a, turned_b, q, cross)
    for r in range(6):
        for c in range(6):
            lower[e, r, c] += cross[r, c]
    if symmetric:
        for r in range(6):
            for c in range(6):
                upper[e, r, c] += cross[r, c]
        return
    if b > a:
        _cross(left_a, turned_b, q, cross)
    else:
        _cross(left_b, turned_a, q, cross)
    for r in range(6):
        for c in range(6):
            upper[e, r, c] += cross[c, r]
