"""Block `L U` factors in dense panels, supernode by supernode, and solves with them.

Left-looking (Ng and Peyton, 1993): a supernode takes up the updates of those that were eliminated before, then it is
factored itself, with 6 x 6 pivots. Updates are products of block rows, which lie in a row in memory. Where the
matrix is symmetric, only one half is computed.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.layout import FAST
from falsework.stability.cpu.products import product
from falsework.utils.kernels import njit

_subtract_product, _set_product = product(-1), product(1, adds=False)

RIDGE = 1e-14
"""Least share of the mean that is added to a diagonal that may be singular; what it leaves out of balance grows with
it, and stays below the resolution of verdicts."""


@njit(fastmath=True, cache=True)
def clear_panels(panels, shift, symmetric):
    """Set a matrix to `shift` times the identity; of a symmetric one the lower panels stay as they are."""
    upper, lower, diagonal, width = panels.upper, panels.lower, panels.diagonal, panels.width
    panel, own, member_start, member = panels.panel, panels.own, panels.member_start, panels.member
    for e in range(panel[len(own)]):
        upper[e] = 0.0
    for e in range(0 if symmetric else panel[len(own)]):
        lower[e] = 0.0
    for s in range(len(own)):
        for m in range(member_start[s], member_start[s] + own[s]):
            for r in range(6):
                upper[diagonal[member[m]] + r * (width[s] + 1)] = shift


@njit(inline="always", fastmath=True)
def add_block(block, q, out, place, width):
    """Add the 6 x 6 block `block[q]` to a panel."""
    p = np.uint64(place)
    for r in range(6):
        for c in range(6):
            out[p + np.uint64(c)] += block[q, r, c]
        p += np.uint64(width)


@njit(inline="always", fastmath=FAST)
def add_pair_matrix(structure, work, p, local, left):
    """Add the matrix of a pair to the panels.

    Args:
        structure, work: as for `run_admm`.
        p: the pair.
        local: sum over its points, of which the lower triangle is given. Shape (6, 6).
        left: scratch, shape (6, 6).
    """
    ta, tb, supernode = structure.transfer_a, structure.transfer_b, structure.elimination.supernode
    panels, q, a, b = work.panels, work.pair[p], work.slot_a[p], work.slot_b[p]
    upper, diagonal, block, width = panels.upper, panels.diagonal, panels.block, panels.width
    for i in range(6):
        for k in range(i):
            local[k, i] = local[i, k]
    if a >= 0:
        _multiply(ta, q, local, left)
        _add_product(left, ta, q, upper, diagonal[a], width[supernode[a]])
        if a < b:
            _add_product(left, tb, q, upper, block[q], width[supernode[a]])
    if b >= 0:
        _multiply(tb, q, local, left)
        _add_product(left, tb, q, upper, diagonal[b], width[supernode[b]])
        if b < a:
            _add_product(left, ta, q, upper, block[q], width[supernode[b]])


@njit(inline="always", fastmath=FAST)
def _multiply(left, q, right, out):
    """Write `out = left[q] right`."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += left[q, i, k] * right[k, j]
            out[i, j] = total


@njit(inline="always", fastmath=FAST)
def _add_product(left, right, q, out, place, width):
    """Add `left right[q]^T` to a block of a panel."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += left[i, k] * right[q, j, k]
            out[place + i * width + j] += total


@njit(fastmath=True)
def _subtract(left, place_left, width_left, right, place_right, width_right, depth, out, place, width_out, columns):
    """Subtract `left^T right` from a block row: six columns of `left`, `columns` of `right`, `depth` rows of both."""
    _subtract_product(
        left, place_left, width_left, right, place_right, width_right, out, place, width_out, depth // 6, columns
    )


@njit(fastmath=True)
def _scale(inverse, source, out, place, width, columns):
    """Set a block row of `out` to the transposed inverse of its pivot times that of `source`, which may be the same."""
    _set_product(inverse, 0, 6, source, place, width, out, place, width, 1, columns)


@njit(fastmath=True)
def _invert(block, place, width, work, inverse):
    """Return the inverse of a 6 x 6 block by elimination with row pivots; False if it is singular."""
    for i in range(6):
        for j in range(6):
            work[i, j] = block[place + i * width + j]
            inverse[6 * i + j] = 1.0 if i == j else 0.0
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
                inverse[6 * k + j], inverse[6 * best + j] = inverse[6 * best + j], inverse[6 * k + j]
        scale = 1.0 / work[k, k]
        for j in range(6):
            work[k, j] *= scale
            inverse[6 * k + j] *= scale
        for i in range(6):
            if i != k:
                share = work[i, k]
                for j in range(6):
                    work[i, j] -= share * work[k, j]
                    inverse[6 * i + j] -= share * inverse[6 * k + j]
    return True


@njit(fastmath=True)
def _invert_symmetric(block, place, width, work, inverse):
    """Return the inverse of a symmetric 6 x 6 block by its Cholesky factor; False if it is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            total = block[place + j * width + i]
            for k in range(j):
                total -= work[i, k] * work[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                work[i, i] = np.sqrt(total)
            else:
                work[i, j] = total / work[j, j]
    # Invert the lower triangle in place, then form L^-T L^-1.
    for j in range(6):
        work[j, j] = 1.0 / work[j, j]
        for i in range(j + 1, 6):
            total = 0.0
            for k in range(j, i):
                total -= work[i, k] * work[k, j]
            work[i, j] = total / work[i, i]
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, 6):
                total += work[k, i] * work[k, j]
            inverse[6 * i + j] = total
            inverse[6 * j + i] = total
    return True


@njit(fastmath=True, cache=True)
def factor_panels(supernode, panels, symmetric):
    """Replace a matrix by its factors.

    Args:
        supernode: of each position, as in `Elimination`.
        panels: the matrix as `Panels` has it, overwritten; of a symmetric one the lower panels are not read.
        symmetric: whether the matrix is, and positive definite.

    Returns:
        False if a pivot block is singular, or not positive definite where it has to be.
    """
    upper, lower, place = panels.upper, panels.lower, panels.place
    panel, width, own, used = panels.panel, panels.width, panels.own, panels.used
    member_start, member, head, following = panels.member_start, panels.member, panels.head, panels.following
    work, inverse = np.empty((6, 6)), np.empty(36)
    head[:] = -1
    for s in range(len(own)):
        if own[s] == 0:
            continue
        begin, members, wide, base = member_start[s], member_start[s + 1] - member_start[s], width[s], panel[s]
        for m in range(members):
            place[member[begin + m]] = m
        before = head[s]
        while before >= 0:
            after = following[before]
            begin_b, members_b = member_start[before], member_start[before + 1] - member_start[before]
            first, depth, wide_b = used[before], 6 * own[before], width[before]
            last = first
            while last < members_b and supernode[member[begin_b + last]] == s:
                last += 1
            for i in range(first, last):
                source, row = panel[before] + 6 * i, base + 6 * wide * place[member[begin_b + i]]
                m = i
                while m < members_b:  # members that follow one another here do so there in most cases
                    at, end = place[member[begin_b + m]], m + 1
                    while end < members_b and place[member[begin_b + end]] - at == end - m:
                        end += 1
                    beside, columns = source + 6 * (m - i), 6 * (end - m)
                    _subtract(lower, source, wide_b, upper, beside, wide_b, depth, upper, row + 6 * at, wide, columns)
                    if not symmetric:
                        _subtract(
                            upper, source, wide_b, lower, beside, wide_b, depth, lower, row + 6 * at, wide, columns
                        )
                    m = end
            if last < members_b:
                used[before] = last
                above = supernode[member[begin_b + last]]
                following[before], head[above] = head[above], before
            before = after
        for i in range(own[s]):
            source, at, columns = base + 6 * i, base + 6 * i * (wide + 1), 6 * (members - i)
            if i > 0:
                _subtract(lower, source, wide, upper, source, wide, 6 * i, upper, at, wide, columns)
                if not symmetric:
                    _subtract(upper, source, wide, lower, source, wide, 6 * i, lower, at, wide, columns)
            if symmetric:
                if not _invert_symmetric(upper, at, wide, work, inverse):
                    return False
                _scale(inverse, upper, lower, at + 6, wide, columns - 6)
            else:
                if not _invert(upper, at, wide, work, inverse):
                    return False
                _scale(inverse, lower, lower, at + 6, wide, columns - 6)
            for r in range(6):
                for c in range(6):
                    upper[at + r * wide + c] = inverse[6 * r + c]
        if members > own[s]:
            used[s] = own[s]
            above = supernode[member[begin + own[s]]]
            following[s], head[above] = head[above], s
    return True


@njit(fastmath=True, cache=True)
def solve_panels(panels, x, symmetric):
    """Solve with the factors made by `factor_panels`, in place; `x` has shape (n, 6).

    Of a symmetric matrix only the upper panels are read, half of the memory.
    """
    upper, lower, y = panels.upper, panels.lower, panels.strip
    panel, width, own = panels.panel, panels.width, panels.own
    member_start, member = panels.member_start, panels.member
    for s in range(len(own)):
        begin, members, wide = member_start[s], member_start[s + 1] - member_start[s], width[s]
        for m in range(members if own[s] else 0):
            for r in range(6):
                y[6 * m + r] = x[member[begin + m], r] if m < own[s] else 0.0
        for i in range(own[s]):
            k, at, columns = 6 * i, panel[s] + 6 * i * (wide + 1), 6 * (members - i - 1)
            rows, t0, t1, t2, t3, t4, t5 = lower, y[k], y[k + 1], y[k + 2], y[k + 3], y[k + 4], y[k + 5]
            if symmetric:
                rows = upper
                t0, t1, t2, t3, t4, t5 = _pivot_product(upper, at, wide, y, k)
            _subtract_rows(rows, at + 6, wide, t0, t1, t2, t3, t4, t5, y, k + 6, columns)
        for m in range(members if own[s] else 0):
            for r in range(6):
                if m < own[s]:
                    x[member[begin + m], r] = y[6 * m + r]
                else:
                    x[member[begin + m], r] += y[6 * m + r]
    for s in range(len(own) - 1, -1, -1):
        begin, members, wide = member_start[s], member_start[s + 1] - member_start[s], width[s]
        for m in range(members if own[s] else 0):
            for r in range(6):
                y[6 * m + r] = x[member[begin + m], r]
        for i in range(own[s] - 1, -1, -1):
            at = panel[s] + 6 * i * (wide + 1)
            _gather(upper, at, wide, y, 6 * i, 6 * (members - i - 1))
            for r in range(6):
                x[member[begin + i], r] = y[6 * i + r]


@njit(inline="always", fastmath=True)
def _pivot_product(upper, place, width, y, i):
    """Return an inverted pivot times six entries of `y`; the pivot is symmetric."""
    w, p0 = np.uint64(width), np.uint64(place)
    t0, t1, t2, t3, t4, t5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(np.uint64(6)):
        v, p = y[np.uint64(i) + r], p0 + r * w
        t0 += upper[p] * v
        t1 += upper[p + np.uint64(1)] * v
        t2 += upper[p + np.uint64(2)] * v
        t3 += upper[p + np.uint64(3)] * v
        t4 += upper[p + np.uint64(4)] * v
        t5 += upper[p + np.uint64(5)] * v
    return t0, t1, t2, t3, t4, t5


@njit(inline="always", fastmath=True)
def _subtract_rows(panel, place, width, y0, y1, y2, y3, y4, y5, y, start, columns):
    """Subtract six rows of a panel, each times a number, from entries of `y` from `start` on."""
    w, p0, below = np.uint64(width), np.uint64(place), np.uint64(start)
    p1, p2, p3 = p0 + w, p0 + w + w, p0 + w + w + w
    p4, p5 = p3 + w, p3 + w + w
    for j in range(np.uint64(columns)):
        y[below + j] -= (
            panel[p0 + j] * y0
            + panel[p1 + j] * y1
            + panel[p2 + j] * y2
            + panel[p3 + j] * y3
            + panel[p4 + j] * y4
            + panel[p5 + j] * y5
        )


@njit(fastmath=True)
def _gather(upper, place, width, y, i, columns):
    """Solve for six entries of `y`: the rest of their block row is known, and its pivot inverted."""
    w, p0, right = np.uint64(width), np.uint64(place + 6), np.uint64(i + 6)
    p1, p2, p3 = p0 + w, p0 + w + w, p0 + w + w + w
    p4, p5 = p3 + w, p3 + w + w
    y0, y1, y2, y3, y4, y5 = y[i], y[i + 1], y[i + 2], y[i + 3], y[i + 4], y[i + 5]
    for j in range(np.uint64(columns)):
        v = y[right + j]
        y0 -= upper[p0 + j] * v
        y1 -= upper[p1 + j] * v
        y2 -= upper[p2 + j] * v
        y3 -= upper[p3 + j] * v
        y4 -= upper[p4 + j] * v
        y5 -= upper[p5 + j] * v
    for r in range(6):
        p = place + r * width
        y[i + r] = (
            upper[p] * y0
            + upper[p + 1] * y1
            + upper[p + 2] * y2
            + upper[p + 3] * y3
            + upper[p + 4] * y4
            + upper[p + 5] * y5
        )
