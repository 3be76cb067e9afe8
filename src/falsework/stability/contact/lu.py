"""Sparse block `L U` factors of the tangent stiffness of a state, and solves with them.

The matrix has the pattern of `elimination.py`. Where contact points slide it is not symmetric, so blocks above the
diagonal are kept too, transposed, in the places of their mirror images.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.elimination import apply_block, eliminate_below, substitute_back
from falsework.stability.cpu.layout import FAST
from falsework.utils.kernels import njit


@njit(fastmath=True)
def _invert(block, b, work, inverse):
    """Return the inverse of a 6 x 6 block by elimination with row pivots; False if it is singular."""
    for i in range(6):
        for j in range(6):
            work[0, i, j] = block[b, i, j]
            inverse[0, i, j] = 1.0 if i == j else 0.0
    for k in range(6):
        best = k
        for i in range(k + 1, 6):
            if abs(work[0, i, k]) > abs(work[0, best, k]):
                best = i
        if not abs(work[0, best, k]) > 1e-300:
            return False
        if best != k:
            for j in range(6):
                work[0, k, j], work[0, best, j] = work[0, best, j], work[0, k, j]
                inverse[0, k, j], inverse[0, best, j] = inverse[0, best, j], inverse[0, k, j]
        scale = 1.0 / work[0, k, k]
        for j in range(6):
            work[0, k, j] *= scale
            inverse[0, k, j] *= scale
        for i in range(6):
            if i != k:
                share = work[0, i, k]
                for j in range(6):
                    work[0, i, j] -= share * work[0, k, j]
                    inverse[0, i, j] -= share * inverse[0, k, j]
    return True


# Products below run along rows of their right factor, so that the compiler keeps whole rows in vector registers;
# written as inner products of rows they take half as long again.


@njit(inline="always", fastmath=True)
def _transpose(block, e, out):
    """`out[0] = block[e]^T`."""
    for r in range(6):
        for c in range(6):
            out[0, c, r] = block[e, r, c]


@njit(inline="always", fastmath=True)
def _multiply(left, e, right, q, out, t):
    """`out[t] = left[e] right[q]`."""
    for r in range(6):
        x0, x1, x2 = left[e, r, 0], left[e, r, 1], left[e, r, 2]
        x3, x4, x5 = left[e, r, 3], left[e, r, 4], left[e, r, 5]
        for c in range(6):
            out[t, r, c] = (
                x0 * right[q, 0, c]
                + x1 * right[q, 1, c]
                + x2 * right[q, 2, c]
                + x3 * right[q, 3, c]
                + x4 * right[q, 4, c]
                + x5 * right[q, 5, c]
            )


@njit(inline="always", fastmath=True)
def _multiply_add(sign, left, e, right, q, out, t):
    """`out[t] += sign left[e] right[q]`."""
    for r in range(6):
        x0, x1, x2 = sign * left[e, r, 0], sign * left[e, r, 1], sign * left[e, r, 2]
        x3, x4, x5 = sign * left[e, r, 3], sign * left[e, r, 4], sign * left[e, r, 5]
        for c in range(6):
            out[t, r, c] += (
                x0 * right[q, 0, c]
                + x1 * right[q, 1, c]
                + x2 * right[q, 2, c]
                + x3 * right[q, 3, c]
                + x4 * right[q, 4, c]
                + x5 * right[q, 5, c]
            )


@njit(fastmath=True, cache=True)
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
    copy, inverse = np.empty((1, 6, 6)), np.empty((1, 6, 6))
    lower_turned, upper_turned = np.empty((1, 6, 6)), np.empty((1, 6, 6))
    for j in range(len(free)):
        if not free[j]:
            continue
        if not _invert(diagonal, j, copy, inverse):
            return False
        for r in range(6):
            for c in range(6):
                diagonal[j, r, c] = inverse[0, r, c]
        for e in range(column[j], column[j + 1]):
            if filled[e]:
                _multiply(lower, e, inverse, 0, copy, 0)
                for r in range(6):
                    for c in range(6):
                        lower[e, r, c] = copy[0, r, c]
        for e2 in range(column[j], column[j + 1]):
            if not filled[e2]:
                continue
            _transpose(lower, e2, lower_turned)
            _transpose(upper, e2, upper_turned)
            _multiply_add(-1.0, lower, e2, upper_turned, 0, diagonal, row[e2])
            for e1 in range(e2 + 1, column[j + 1]):
                if filled[e1]:
                    t = target[first_target[e2] + e1 - e2 - 1]
                    filled[t] = True
                    _multiply_add(-1.0, lower, e1, upper_turned, 0, lower, t)
                    _multiply_add(-1.0, upper, e1, lower_turned, 0, upper, t)
    return True


@njit(fastmath=True, cache=True)
def solve_lu(elimination, free, diagonal, lower, upper, filled, x):
    """Solve with the factor made by `factor_lu`, in place; `x` has shape (n, 6)."""
    column, row = elimination.column, elimination.row
    n = len(free)
    for j in range(n):
        if free[j]:
            eliminate_below(column, row, lower, filled, x, j)
    for j in range(n - 1, -1, -1):
        if free[j]:
            substitute_back(column, row, upper, filled, x, j)
            apply_block(diagonal, x, j)


@njit(fastmath=FAST, cache=True)
def add_pair(ta, tb, turned_a, turned_b, q, a, b, e, local, symmetric, diagonal, lower, upper, scratch):
    """Add the stiffness about the middle of a pair to the matrix.

    Args:
        ta, tb, turned_a, turned_b: `transfer_a` and `transfer_b` of the structure, and their transposes.
        q, a, b, e: the pair, the positions of its parts (-1 where one cannot move), and its block.
        local: the stiffness, shape (1, 6, 6).
        symmetric: whether it is symmetric.
        diagonal, lower, upper: the matrix, as `factor_lu` takes it.
        scratch: products of `local`, shape (3, 6, 6): from the left by `ta`, by `tb`, and the block of the pair.
    """
    if a >= 0:
        _multiply(ta, q, local, 0, scratch, 0)
        _multiply_add(1.0, scratch, 0, turned_a, q, diagonal, a)
    if b >= 0:
        _multiply(tb, q, local, 0, scratch, 1)
        _multiply_add(1.0, scratch, 1, turned_b, q, diagonal, b)
    if a < 0 or b < 0:
        return
    if b > a:
        _multiply(scratch, 1, turned_a, q, scratch, 2)
    else:
        _multiply(scratch, 0, turned_b, q, scratch, 2)
    for r in range(6):
        for c in range(6):
            lower[e, r, c] += scratch[2, r, c]
    if symmetric:
        for r in range(6):
            for c in range(6):
                upper[e, r, c] += scratch[2, r, c]
        return
    if b > a:
        _multiply(scratch, 0, turned_b, q, scratch, 2)
    else:
        _multiply(scratch, 1, turned_a, q, scratch, 2)
    for r in range(6):
        for c in range(6):
            upper[e, r, c] += scratch[2, c, r]
