"""Tangent stiffness of a state, its sparse block factor `L U`, and solves with it.

The matrix has the pattern of `elimination.py`. Where contact points slide it is not symmetric, so blocks above the
diagonal are kept too, transposed, in the places of their mirror images.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from falsework.stability.structure import FAST


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


@nb.njit(inline="always", fastmath=True)
def _subtract(left, e, right, f, out, t):
    """`out[t] -= left[e] right[f]^T`."""
    for r in range(6):
        for c in range(6):
            total = 0.0
            for k in range(6):
                total += left[e, r, k] * right[f, c, k]
            out[t, r, c] -= total


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
                for r in range(6):
                    for c in range(6):
                        total = 0.0
                        for k in range(6):
                            total += lower[e, r, k] * inverse[k, c]
                        copy[r, c] = total
                for r in range(6):
                    for c in range(6):
                        lower[e, r, c] = copy[r, c]
        for e2 in range(column[j], column[j + 1]):
            if not filled[e2]:
                continue
            _subtract(lower, e2, upper, e2, diagonal, row[e2])
            for e1 in range(e2 + 1, column[j + 1]):
                if filled[e1]:
                    t = target[first_target[e2] + e1 - e2 - 1]
                    filled[t] = True
                    _subtract(lower, e1, upper, e2, lower, t)
                    _subtract(upper, e1, lower, e2, upper, t)
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
def _multiply(left, q, right, out):
    """`out = left[q] right`."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += left[q, i, k] * right[k, j]
            out[i, j] = total


@nb.njit(inline="always", fastmath=FAST)
def _add_product(left, right, q, out, e):
    """`out[e] += left right[q]^T`."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += left[i, k] * right[q, j, k]
            out[e, i, j] += total


@nb.njit(inline="always", fastmath=FAST)
def _add_transposed(left, right, q, out, e):
    """`out[e] += (left right[q]^T)^T`."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += left[i, k] * right[q, j, k]
            out[e, j, i] += total


@nb.njit(fastmath=FAST, cache=True)
def add_pair(structure, work, p, local, upper):
    """Add the stiffness `local` (6 x 6, about the middle of acting pair `p`) to the matrix."""
    ta, tb, block = structure.transfer_a, structure.transfer_b, structure.elimination.pair_block
    q, a, b = work.pair[p], work.slot_a[p], work.slot_b[p]
    diagonal, lower, filled = work.diagonal, work.lower, work.filled
    left = np.empty((6, 6))
    if a >= 0:
        _multiply(ta, q, local, left)
        _add_product(left, ta, q, diagonal, a)
        if b >= 0:
            e = block[q]
            filled[e] = True
            if b < a:
                _add_product(left, tb, q, lower, e)
            else:
                _add_transposed(left, tb, q, upper, e)
    if b >= 0:
        _multiply(tb, q, local, left)
        _add_product(left, tb, q, diagonal, b)
        if a >= 0:
            e = block[q]
            if b > a:
                _add_product(left, ta, q, lower, e)
            else:
                _add_transposed(left, ta, q, upper, e)
