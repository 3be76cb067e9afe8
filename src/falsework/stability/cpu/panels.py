"""Block `L U` factors in dense panels, supernode by supernode, and solves with them.

Left-looking (Ng and Peyton, 1993): a supernode takes up the updates of those that were eliminated before, then it is
factored itself, with 6 x 6 pivots. Updates are products of block rows that lie in a row in memory, which the compiler
keeps in vector registers. Where the matrix is symmetric, only one half is computed.
"""

from __future__ import annotations

import numpy as np

from falsework.utils.kernels import njit


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


@njit(fastmath=True)
def _subtract(left, place_left, width_left, right, place_right, width_right, depth, out, place, width_out, columns):
    """Subtract `left^T right` from a block row: six columns of `left`, `columns` of `right`, `depth` rows of both.

    Places in unsigned numbers, since numba would ask for each of the others whether it is negative.
    """
    for half in range(0, 6, 3):
        c0 = np.uint64(place + half * width_out)
        c1, c2 = c0 + np.uint64(width_out), c0 + np.uint64(2 * width_out)
        for k in range(0, depth, 6):
            p = np.uint64(place_left + k * width_left + half)
            one, two, w = np.uint64(1), np.uint64(2), np.uint64(width_left)
            a00, a10, a20 = left[p], left[p + one], left[p + two]
            p += w
            a01, a11, a21 = left[p], left[p + one], left[p + two]
            p += w
            a02, a12, a22 = left[p], left[p + one], left[p + two]
            p += w
            a03, a13, a23 = left[p], left[p + one], left[p + two]
            p += w
            a04, a14, a24 = left[p], left[p + one], left[p + two]
            p += w
            a05, a15, a25 = left[p], left[p + one], left[p + two]
            w = np.uint64(width_right)
            q0 = np.uint64(place_right + k * width_right)
            q1 = q0 + w
            q2 = q1 + w
            q3 = q2 + w
            q4 = q3 + w
            q5 = q4 + w
            for j in range(np.uint64(columns)):
                b0, b1, b2 = right[q0 + j], right[q1 + j], right[q2 + j]
                b3, b4, b5 = right[q3 + j], right[q4 + j], right[q5 + j]
                out[c0 + j] -= a00 * b0 + a01 * b1 + a02 * b2 + a03 * b3 + a04 * b4 + a05 * b5
                out[c1 + j] -= a10 * b0 + a11 * b1 + a12 * b2 + a13 * b3 + a14 * b4 + a15 * b5
                out[c2 + j] -= a20 * b0 + a21 * b1 + a22 * b2 + a23 * b3 + a24 * b4 + a25 * b5


@njit(fastmath=True)
def _scale(inverse, source, out, place, width, columns, strip):
    """Set a block row of `out` to the transposed inverse of its pivot times that of `source`, which may be the same."""
    w = np.uint64(width)
    p, q = np.uint64(place), np.uint64(0)
    for _ in range(6):
        for c in range(np.uint64(columns)):
            strip[q + c] = -source[p + c]
        for c in range(np.uint64(columns)):
            out[p + c] = 0.0
        p += w
        q += np.uint64(columns)
    _subtract(inverse, 0, 6, strip, 0, columns, 6, out, place, width, columns)


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


@njit(fastmath=True)
def _add_strip(strip, begin, columns, out, place, width, member, begin_member, places):
    """Add a block row in scratch to the columns of its members in another panel."""
    for m in range(columns):
        p, q = place + 6 * places[member[begin_member + m]], begin + 6 * m
        for _ in range(6):
            for c in range(6):
                out[p + c] += strip[q + c]
            p += width
            q += 6 * columns


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
    upper, lower, strip, place = panels.upper, panels.lower, panels.strip, panels.place
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
            begin_place, end_place = place[member[begin_b + first]], place[member[begin_b + members_b - 1]]
            whole = end_place - begin_place == members_b - 1 - first
            for i in range(first, last):
                source, columns, row = panel[before] + 6 * i, 6 * (members_b - i), place[member[begin_b + i]]
                if whole:
                    at = base + 6 * row * (wide + 1)
                    _subtract(lower, source, wide_b, upper, source, wide_b, depth, upper, at, wide, columns)
                    if not symmetric:
                        _subtract(upper, source, wide_b, lower, source, wide_b, depth, lower, at, wide, columns)
                    continue
                at = base + 6 * row * wide
                for e in range(12 * columns):
                    strip[e] = 0.0
                _subtract(lower, source, wide_b, upper, source, wide_b, depth, strip, 0, columns, columns)
                _add_strip(strip, 0, members_b - i, upper, at, wide, member, begin_b + i, place)
                if not symmetric:
                    _subtract(upper, source, wide_b, lower, source, wide_b, depth, strip, 6 * columns, columns, columns)
                    _add_strip(strip, 6 * columns, members_b - i, lower, at, wide, member, begin_b + i, place)
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
                _scale(inverse, upper, lower, at + 6, wide, columns - 6, strip)
            else:
                if not _invert(upper, at, wide, work, inverse):
                    return False
                _scale(inverse, lower, lower, at + 6, wide, columns - 6, strip)
            for r in range(6):
                for c in range(6):
                    upper[at + r * wide + c] = inverse[6 * r + c]
        if members > own[s]:
            used[s] = own[s]
            above = supernode[member[begin + own[s]]]
            following[s], head[above] = head[above], s
    return True


@njit(fastmath=True, cache=True)
def solve_panels(panels, x):
    """Solve with the factors made by `factor_panels`, in place; `x` has shape (n, 6)."""
    upper, lower, y = panels.upper, panels.lower, panels.strip
    panel, width, own = panels.panel, panels.width, panels.own
    member_start, member = panels.member_start, panels.member
    for s in range(len(own)):
        begin, members, wide = member_start[s], member_start[s + 1] - member_start[s], width[s]
        for m in range(members if own[s] else 0):
            for r in range(6):
                y[6 * m + r] = x[member[begin + m], r] if m < own[s] else 0.0
        for i in range(own[s]):
            _spread(lower, panel[s] + 6 * i * wide + 6 * (i + 1), wide, y, 6 * i, 6 * (members - i - 1))
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


@njit(fastmath=True)
def _spread(lower, place, width, y, i, columns):
    """Subtract a block row, transposed, times six entries of `y` from those that follow."""
    w, p0, below = np.uint64(width), np.uint64(place), np.uint64(i + 6)
    p1, p2, p3 = p0 + w, p0 + w + w, p0 + w + w + w
    p4, p5 = p3 + w, p3 + w + w
    y0, y1, y2, y3, y4, y5 = y[i], y[i + 1], y[i + 2], y[i + 3], y[i + 4], y[i + 5]
    for j in range(np.uint64(columns)):
        y[below + j] -= (
            lower[p0 + j] * y0
            + lower[p1 + j] * y1
            + lower[p2 + j] * y2
            + lower[p3 + j] * y3
            + lower[p4 + j] * y4
            + lower[p5 + j] * y5
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
