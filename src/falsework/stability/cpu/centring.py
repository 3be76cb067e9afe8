"""Primal-dual steps that keep contact forces inside their friction cones.

Many forces balance a state. Those on the boundaries of their cones, where ADMM leaves them, cannot take up much when a
part is let go of, so that others far away have to change too. So forces are kept inside their cones, by primal-dual
steps for

    minimize  sum of normal forces / (force level)  -  sum of log(distance of a force from each facet of its cone)

subject to balance. The first term bounds forces where parts are wedged. Any forces in balance are a proof, so steps end
at the first ones, far from the minimum: they mostly follow the shortest change of forces, in the metric of the second
derivative, and go a small share of the way to the middle. Each contact goes as far along a step as its own cone allows.
A common length would be that of the worst contact, often a tenth; what contacts that stop leave out of balance is left
to the next step. Failure proves nothing.
"""

from __future__ import annotations

import math

import numpy as np

from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.interior_point import add_point_matrix, strains
from falsework.stability.cpu.layout import FAST, add_wrench, copy_rows, dot
from falsework.stability.cpu.panels import RIDGE, add_pair_matrix, clear_panels, factor_panels, solve_panels
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED, check_primal
from falsework.utils.kernels import njit

_X = np.array([math.cos((k + 0.5) * math.pi / 4) for k in range(8)])
_Y = np.array([math.sin((k + 0.5) * math.pi / 4) for k in range(8)])
_NEAR = math.cos(math.pi / 8)
"""Distance of the facets of the octagon from its axis; it lies inside the quadratic cone."""
_BACK_OFF, _CENTRING = 0.7, 0.01
"""Largest share of the way to the nearest facet in a step, and share of the way to the middle of the cones; checked on
recorded searches."""
_INSIDE, _LEAST = 0.5, 0.2
"""Largest tangential force at the start, as a share of what friction allows, and least normal force in force levels."""


@njit(fastmath=FAST, cache=True)
def _move_inside(structure, work, pairs, level):
    """Raise normal forces until all forces lie inside their cones; new contacts share what is not in balance."""
    z, mu, scale, start, slot_a, slot_b = work.z, work.friction, work.force_scale, work.start, work.slot_a, work.slot_b
    residual, new = work.residual, work.velocity
    new[:] = 0.0
    for p in range(pairs):
        a, b, fresh = slot_a[p], slot_b[p], 0.0
        for j in range(start[p], start[p + 1]):
            fresh += z[j, 0] == 0.0
        if a >= 0:
            new[a, 0] += fresh
        if b >= 0:
            new[b, 0] += fresh
    for j in range(len(new)):
        if new[j, 0] > 0.0:
            total = 0.0
            for i in range(6):
                total += residual[j, i] * residual[j, i]
            new[j, 1] = math.sqrt(total) / new[j, 0]
    for p in range(pairs):
        share = 0.0
        if slot_a[p] >= 0:
            share = max(share, new[slot_a[p], 1])
        if slot_b[p] >= 0:
            share = max(share, new[slot_b[p], 1])
        for j in range(start[p], start[p + 1]):
            least = max(_LEAST * level / scale[j], share if z[j, 0] == 0.0 else 0.0)
            side = math.sqrt(z[j, 1] * z[j, 1] + z[j, 2] * z[j, 2]) / (mu[j] * _NEAR)
            z[j, 0] = max(z[j, 0], least, side / _INSIDE)


@njit(fastmath=FAST, cache=True)
def _assemble(structure, work, pairs, level, first):
    """Write the Newton system: its matrix, and its right-hand side from `work.residual` to `work.rhs`.

    Multipliers of the facets are in `work.weights`; at the `first` step they are set. The inverse of the second
    derivative at each contact point goes to `work.weight_steps`, and minus its product with the first, times
    `_CENTRING`, to `work.slacks`. Unknown are velocities; forces change by the latter, less the former times the
    strains.
    """
    basis, start, z, mu, scale = work.basis, work.start, work.z, work.friction, work.force_scale
    rhs = work.rhs
    multiplier, metric, pull = work.weights, work.weight_steps, work.slacks
    points, total = start[pairs], 0.0
    for j in range(points):
        n, x, y = z[j, 0], z[j, 1], z[j, 2]
        m = mu[j] * _NEAR
        h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        g0, g1, g2 = scale[j] / level, 0.0, 0.0
        for k in range(8):
            e = 1.0 / (m * n - _X[k] * x - _Y[k] * y)
            if first:
                multiplier[j, k] = e
            a0, a1, a2 = m * e, -_X[k] * e, -_Y[k] * e
            g0 -= a0
            g1 -= a1
            g2 -= a2
            s = multiplier[j, k]
            h00 += s * m * a0
            h01 += s * m * a1
            h02 += s * m * a2
            h11 -= s * _X[k] * a1
            h12 -= s * _X[k] * a2
            h22 -= s * _Y[k] * a2
        c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
        inverse = 1.0 / (h00 * c00 + h01 * c01 + h02 * c02)
        w00, w01, w02 = c00 * inverse, c01 * inverse, c02 * inverse
        w11 = (h00 * h22 - h02 * h02) * inverse
        w12 = (h01 * h02 - h00 * h12) * inverse
        w22 = (h00 * h11 - h01 * h01) * inverse
        metric[j, 0], metric[j, 1], metric[j, 2] = w00, w01, w02
        metric[j, 3], metric[j, 4], metric[j, 5] = w11, w12, w22
        g0, g1, g2 = _CENTRING * g0, _CENTRING * g1, _CENTRING * g2
        pull[j, 0] = -(w00 * g0 + w01 * g1 + w02 * g2)
        pull[j, 1] = -(w01 * g0 + w11 * g1 + w12 * g2)
        pull[j, 2] = -(w02 * g0 + w12 * g1 + w22 * g2)
        total += w00 + w11 + w22
    clear_panels(work.panels, RIDGE * total / points, points > 0)
    copy_rows(work.free, work.residual, rhs)
    local, left = np.empty((6, 6)), np.empty((6, 6))
    for p in range(pairs):
        local[:] = 0.0
        for j in range(start[p], start[p + 1]):
            w00, w01, w02 = metric[j, 0], metric[j, 1], metric[j, 2]
            w11, w12, w22 = metric[j, 3], metric[j, 4], metric[j, 5]
            add_point_matrix(basis, j, w00, w01, w02, w11, w12, w22, local)
        add_wrench(structure, work, p, pull, rhs)
        add_pair_matrix(structure, work, p, local, left)


@njit(fastmath=FAST, cache=True)
def _advance(structure, work, pairs):
    """Step forces in `work.z` along the velocities in `work.rhs`, and multipliers; each contact as far as it may go."""
    z, v, mu, multiplier = work.z, work.v, work.friction, work.weights
    metric, pull, step = work.weight_steps, work.slacks, np.empty(8)
    strains(structure, work, pairs, work.rhs)
    for j in range(work.start[pairs]):
        w00, w01, w02 = metric[j, 0], metric[j, 1], metric[j, 2]
        w11, w12, w22 = metric[j, 3], metric[j, 4], metric[j, 5]
        d0 = pull[j, 0] - w00 * v[j, 0] - w01 * v[j, 1] - w02 * v[j, 2]
        d1 = pull[j, 1] - w01 * v[j, 0] - w11 * v[j, 1] - w12 * v[j, 2]
        d2 = pull[j, 2] - w02 * v[j, 0] - w12 * v[j, 1] - w22 * v[j, 2]
        m, reach, dual_reach = mu[j] * _NEAR, 1.0 / _BACK_OFF, 1.0 / _BACK_OFF
        for k in range(8):
            distance = m * z[j, 0] - _X[k] * z[j, 1] - _Y[k] * z[j, 2]
            fall = _X[k] * d1 + _Y[k] * d2 - m * d0
            s = multiplier[j, k]
            step[k] = (_CENTRING * (1.0 - s * distance) + s * fall) / distance
            if fall > 0.0:
                reach = min(reach, distance / fall)
            if step[k] < 0.0:
                dual_reach = min(dual_reach, -s / step[k])
        for k in range(8):
            multiplier[j, k] += _BACK_OFF * dual_reach * step[k]
        share = _BACK_OFF * reach
        z[j, 0] += share * d0
        z[j, 1] += share * d1
        z[j, 2] += share * d2


@njit(fastmath=FAST, cache=True)
def run_centring(structure, work, pairs, options, level, patient):
    """Balance the forces in `work.z` by primal-dual steps inside their cones.

    Where forces can balance a region of a few parts, the residual is mostly less after any three steps than before
    them. Among thousands of parts it rises first: the new load has to find its way.

    Args:
        structure, work, pairs, options: as for `run_admm`.
        level: force in N that contacts without need of it take up, about.
        patient: whether to go on where three steps did not reduce the residual, as long as there are steps.

    Returns:
        Verdict and steps taken.
    """
    lay_out_panels(structure, work.free, work.panels)
    check_primal(structure, work, pairs, work.z, options, work.residual)
    _move_inside(structure, work, pairs, level)
    symmetric = pairs >= 0  # no literal, which numba would compile separately
    check_primal(structure, work, pairs, work.z, options, work.residual)
    one, two, three = np.inf, np.inf, np.inf  # residuals so many steps ago
    for step in range(1, options.interior_steps + 1):
        _assemble(structure, work, pairs, level, step == 1)
        if not factor_panels(structure.elimination.supernode, work.panels, symmetric):
            return UNDECIDED, step
        solve_panels(work.panels, work.rhs, symmetric)
        if not dot(work, work.rhs, work.rhs) < np.inf:
            return UNDECIDED, step
        _advance(structure, work, pairs)
        residual = check_primal(structure, work, pairs, work.z, options, work.residual)
        if residual < (1.0 - MARGIN) * options.resolution:
            return STABLE, step
        if residual >= three and not patient:
            return UNDECIDED, step
        one, two, three = residual, one, two
    return UNDECIDED, options.interior_steps
