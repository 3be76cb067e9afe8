"""Contact law: normal springs without prestress that bear little or no tension, and non-associated Coulomb friction.

At a contact point with displacement `d = (d_n, d_t)` of part `b` relative to part `a` in the contact's frame,

    f_n = max(-p, o_n - k_n d_n),    t = o_t - k_t d_t,    f_t = t min(1, (mu (f_n + p) + s) / gauge(t)).

A dry contact point has `p = s = 0`. One with tensile strength bears the tension `p`, and by cohesion the tangential
force `s` there (`Strength`). Where the spring would exceed `p`, a ductile point keeps it and a brittle one breaks, see
`solve_statics`. The offset `o` is zero for a structure that is loaded from rest; a replay carries the history of the
point in it. `gauge` is the Euclidean norm (quadratic cone) or the norm whose unit ball is the octagon, so the force
lies in the friction cone of the settings by construction. Sliding causes no dilation: the law is non-associated.
"""

from __future__ import annotations

import math

from falsework.stability.cpu.cones import QUADRATIC
from falsework.utils.kernels import njit

_FACET = math.tan(math.pi / 8)


@njit(inline="always", fastmath=True)
def gauge(cone, x, y):
    """Return the size of a tangential force: at most `mu f_n` inside the cone."""
    if cone == QUADRATIC:
        return math.sqrt(x * x + y * y)
    u, v = max(abs(x), abs(y)), min(abs(x), abs(y))
    return u + v * _FACET


@njit(inline="always", fastmath=True)
def gauge_gradient(cone, x, y):
    """Return the gradient of `gauge` where it is not zero."""
    if cone == QUADRATIC:
        size = math.sqrt(x * x + y * y)
        return x / size, y / size
    u, v = (1.0, _FACET) if abs(x) >= abs(y) else (_FACET, 1.0)
    return math.copysign(u, x), math.copysign(v, y)


@njit(inline="always", fastmath=True)
def contact_force(cone, mu, pull, stick, n, x, y):
    """Return the force of a contact point whose elastic trial force is `(n, x, y)`."""
    n += pull
    if n <= 0.0:
        if stick <= 0.0:
            return -pull, 0.0, 0.0
        n = 0.0
    size, limit = gauge(cone, x, y), mu * n + stick
    if size <= limit:
        return n - pull, x, y
    share = limit / size
    return n - pull, share * x, share * y
