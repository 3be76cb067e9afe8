"""Compiled projection onto friction cones, and their support functions.

A cone is an integer here, `OCTAGON` or `QUADRATIC`; both have their axis along the normal (first
coordinate) and slope `mu`. The octagon is the paper's cone (one normal and eight tangential variables,
`sum lambda_t <= mu lambda_n`) written in three dimensions: its corners lie at multiples of 45 degrees.
Folding the tangent into one sector of 45 degrees leaves four cases: inside, facet, edge, apex.
"""

from __future__ import annotations

import math

from falsework.utils.kernels import njit

OCTAGON, QUADRATIC = 0, 1
CONES = {"octagon": OCTAGON, "quadratic": QUADRATIC}

_C = math.cos(math.pi / 8)
_S = math.sin(math.pi / 8)
_DIAGONAL = math.sqrt(0.5)
NEGLIGIBLE = 1e-9
"""Negligible value beside 1, whose inverse is without limit: friction up to which a cone is a cylinder or a
ray; shifts of the diagonal of a matrix, with entries near 1, that leave forces in balance up to rounding; friction with
which contacts stick, and a stiffness as good as rigid. Chosen; tested on frictionless, bonded and locked parts."""


@njit(inline="always", fastmath=True)
def project(cone, n, x, y, mu):
    """Return the nearest point of the cone to `(n, x, y)`."""
    if cone == QUADRATIC:
        t = math.sqrt(x * x + y * y)
        if n >= 0.0 and t <= mu * n:
            return n, x, y
        s = (n + mu * t) / (1.0 + mu * mu)
        if s <= 0.0:
            return 0.0, 0.0, 0.0
        f = mu * s / t
        return s, f * x, f * y
    ax, ay = abs(x), abs(y)
    u, v = max(ax, ay), min(ax, ay)
    p = u * _C + v * _S  # along the normal of the facet
    q = v * _C - u * _S  # along the facet, within +- mu n sin 22.5
    k = mu * _C
    if n >= 0.0 and p <= k * n:
        return n, x, y
    t = (n + k * p) / (1.0 + k * k)
    half = mu * _S * t
    if t > 0.0 and abs(q) <= half:
        p = k * t
    else:
        t = (n + k * p + mu * _S * abs(q)) / (1.0 + mu * mu)
        if t <= 0.0:
            return 0.0, 0.0, 0.0
        p = k * t
        q = math.copysign(mu * _S * t, q)
    u, v = p * _C - q * _S, p * _S + q * _C
    if ay > ax:
        u, v = v, u
    return t, math.copysign(u, x), math.copysign(v, y)


@njit(inline="always", fastmath=True)
def project_joint(cone, n, x, y, mu, stick):
    """Return the nearest point of the cone truncated at `n = 0`, where its radius is `stick`.

    Where the projection on the whole cone lies beyond the truncation, the nearest point lies on its face.
    """
    if stick <= 0.0:
        return project(cone, n, x, y, mu)
    if mu > NEGLIGIBLE:
        tip = stick / mu
        a, b, c = project(cone, n + tip, x, y, mu)
        if a >= tip:
            return a - tip, b, c
    n = max(n, 0.0)
    if cone == QUADRATIC:
        t = math.sqrt(x * x + y * y)
        f = 1.0 if t <= stick else stick / t
        return n, f * x, f * y
    ax, ay = abs(x), abs(y)
    u, v = max(ax, ay), min(ax, ay)
    p, q = u * _C + v * _S, v * _C - u * _S
    if p <= stick * _C:
        return n, x, y
    p, q = stick * _C, math.copysign(min(abs(q), stick * _S), q)
    u, v = p * _C - q * _S, p * _S + q * _C
    if ay > ax:
        u, v = v, u
    return n, math.copysign(u, x), math.copysign(v, y)


@njit(inline="always", fastmath=True)
def support(cone, n, x, y, mu):
    """Return the largest value of `n f_n + x f_x + y f_y` over forces of the cone with `f_n = 1`."""
    if cone == QUADRATIC:
        return n + mu * math.sqrt(x * x + y * y)
    ax, ay = abs(x), abs(y)
    return n + mu * max(max(ax, ay), _DIAGONAL * (ax + ay))
