"""Compiled distance between two convex pieces: the Gilbert-Johnson-Keerthi algorithm with proofs of separation.

The algorithm descends over the Minkowski difference A - B towards the origin. Its current point v gives an upper bound
|v| on the distance; the plane through the support point w of -v gives a lower bound v.w / |v|, which is a proof:
no point of A is closer to B. A pair counts as separated only with such a proof, so early termination (a flat
simplex, no progress, the iteration limit) can only make the result conservative.
"""

from __future__ import annotations

import math
from typing import Any

from falsework.utils.kernels import njit

FAST = {"contract", "reassoc", "nsz", "arcp", "nnan", "ninf"}
"""Rounding may differ in the last digits; the bounds are compared at 1e-9 and above."""

INNER: dict[str, Any] = {"cache": True, "fastmath": FAST, "error_model": "numpy", "no_cpython_wrapper": True}
"""Options of functions that only compiled functions call: no division checks and no wrappers."""
OUTER: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
"""Options of functions that Python calls."""

ITERATIONS = 40
"""Steps after which the best bound so far is returned."""


@njit(inline="always", **INNER)
def _farthest(vertices, start, stop, x, y, z):
    """Return the vertex farthest along a direction."""
    best = start
    most = vertices[start, 0] * x + vertices[start, 1] * y + vertices[start, 2] * z
    for i in range(start + 1, stop):
        level = vertices[i, 0] * x + vertices[i, 1] * y + vertices[i, 2] * z
        if level > most:
            most = level
            best = i
    return best


@njit(**INNER)
def _segment(s, i, j, out):
    """Return the closest point of segment i, j of a simplex to the origin, and a bit mask of its vertices."""
    ex, ey, ez = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    length = ex * ex + ey * ey + ez * ez
    along = -(s[i, 0] * ex + s[i, 1] * ey + s[i, 2] * ez)
    if along <= 0.0 or length <= 0.0:
        out[0], out[1], out[2] = s[i, 0], s[i, 1], s[i, 2]
        return 1 << i
    if along >= length:
        out[0], out[1], out[2] = s[j, 0], s[j, 1], s[j, 2]
        return 1 << j
    t = along / length
    out[0], out[1], out[2] = s[i, 0] + t * ex, s[i, 1] + t * ey, s[i, 2] + t * ez
    return (1 << i) | (1 << j)


@njit(**INNER)
def _triangle(s, i, j, k, out):
    """Return the closest point of triangle i, j, k of a simplex to the origin, and a bit mask of its vertices."""
    ux, uy, uz = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    wx, wy, wz = s[k, 0] - s[i, 0], s[k, 1] - s[i, 1], s[k, 2] - s[i, 2]
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    area = nx * nx + ny * ny + nz * nz
    # Barycentric weights of the projection of the origin, times `area`: triple products with the normal.
    ax, ay, az = s[i, 0], s[i, 1], s[i, 2]
    bx, by, bz = s[j, 0], s[j, 1], s[j, 2]
    cx, cy, cz = s[k, 0], s[k, 1], s[k, 2]
    wi = nx * (by * cz - bz * cy) + ny * (bz * cx - bx * cz) + nz * (bx * cy - by * cx)
    wj = nx * (cy * az - cz * ay) + ny * (cz * ax - cx * az) + nz * (cx * ay - cy * ax)
    wk = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
    if area > 0.0 and wi > 0.0 and wj > 0.0 and wk > 0.0:
        height = (nx * ax + ny * ay + nz * az) / area
        out[0], out[1], out[2] = height * nx, height * ny, height * nz
        return (1 << i) | (1 << j) | (1 << k)
    # The closest point lies on the boundary: on an edge whose weight is not positive, else on any.
    best, kept = 1e300, 0
    px, py, pz = 0.0, 0.0, 0.0
    for edge in range(3):
        if edge == 0:
            weight, p, q = wk, i, j
        elif edge == 1:
            weight, p, q = wi, j, k
        else:
            weight, p, q = wj, i, k
        if weight <= 0.0 or area <= 0.0:
            bits = _segment(s, p, q, out)
            far = out[0] * out[0] + out[1] * out[1] + out[2] * out[2]
            if far < best:
                best, kept = far, bits
                px, py, pz = out[0], out[1], out[2]
    out[0], out[1], out[2] = px, py, pz
    return kept


@njit(**INNER)
def _tetrahedron(s, out, spare):
    """Return the closest point of a tetrahedron to the origin, and a bit mask of its vertices; 15 if it is inside."""
    best, kept = 1e300, 15
    for face in range(4):
        if face == 0:
            i, j, k, o = 0, 1, 2, 3
        elif face == 1:
            i, j, k, o = 0, 1, 3, 2
        elif face == 2:
            i, j, k, o = 0, 2, 3, 1
        else:
            i, j, k, o = 1, 2, 3, 0
        ux, uy, uz = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
        wx, wy, wz = s[k, 0] - s[i, 0], s[k, 1] - s[i, 1], s[k, 2] - s[i, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        origin = -(nx * s[i, 0] + ny * s[i, 1] + nz * s[i, 2])
        inner = nx * (s[o, 0] - s[i, 0]) + ny * (s[o, 1] - s[i, 1]) + nz * (s[o, 2] - s[i, 2])
        if origin * inner < 0.0 or inner == 0.0:  # beyond this face, or the tetrahedron is flat
            bits = _triangle(s, i, j, k, spare)
            far = spare[0] * spare[0] + spare[1] * spare[1] + spare[2] * spare[2]
            if far < best:
                best, kept = far, bits
                out[0], out[1], out[2] = spare[0], spare[1], spare[2]
    return kept


@njit(**INNER)
def gap(a, a_start, a_stop, b, b_start, b_stop, enough, near, axis, scratch):
    """Return a proven lower bound on the distance between two convex pieces, metres; 0 where they may touch.

    Args:
        a, b: vertices, shape (vertices, 3); piece A has the rows `a_start:a_stop`, B likewise.
        enough: stop as soon as the bound is above this.
        near: stop as soon as the distance is proven to be at most this.
        axis: in and out: a direction from B to A that separated the pair last time, or zero. Shape (3,).
        scratch: shape (6, 3), overwritten.

    Returns:
        The best bound found; without early termination the distance, to 1e-6 of itself.
    """
    s, v, spare = scratch[:4], scratch[4], scratch[5]
    vx, vy, vz = axis[0], axis[1], axis[2]
    if vx == 0.0 and vy == 0.0 and vz == 0.0:
        vx, vy, vz = a[a_start, 0] - b[b_start, 0], a[a_start, 1] - b[b_start, 1], a[a_start, 2] - b[b_start, 2]
    bound, size, last = 0.0, 0, 1e300
    for _ in range(ITERATIONS):
        square = vx * vx + vy * vy + vz * vz
        if square < 1e-24:
            return bound
        length = math.sqrt(square)
        i = _farthest(a, a_start, a_stop, -vx, -vy, -vz)
        j = _farthest(b, b_start, b_stop, vx, vy, vz)
        wx, wy, wz = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
        level = (vx * wx + vy * wy + vz * wz) / length
        if level > bound:
            bound = level
            if bound > enough:
                axis[0], axis[1], axis[2] = vx / length, vy / length, vz / length
                return bound
        if size > 0:  # before that, v is a guess and not a point of the difference
            if length <= near or length - bound <= 1e-6 * length or square >= last:
                return bound
            last = square
        s[size, 0], s[size, 1], s[size, 2] = wx, wy, wz
        size += 1
        if size == 1:
            vx, vy, vz = wx, wy, wz
            continue
        if size == 2:
            bits = _segment(s, 0, 1, v)
        elif size == 3:
            bits = _triangle(s, 0, 1, 2, v)
        else:
            bits = _tetrahedron(s, v, spare)
            if bits == 15:
                return bound
        kept = 0
        for k in range(size):
            if bits >> k & 1:
                if k != kept:
                    s[kept, 0], s[kept, 1], s[kept, 2] = s[k, 0], s[k, 1], s[k, 2]
                kept += 1
        size = kept
        vx, vy, vz = v[0], v[1], v[2]
    return bound
