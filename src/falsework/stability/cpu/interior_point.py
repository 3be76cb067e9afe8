"""Primal-dual interior point method on one state, for states that ADMM leaves undecided.

It solves `min 1/2 |r|^2 - g.r` over velocities `r` with `G^T r` in the dual cone (the least residual's own
dual; its multipliers are the contact forces) and converges in some ten steps however degenerate the
structure is. A Newton step reads, with `y = G^T r` and a weight `W` and a target force `b` per contact point,

    (I + G W G^T) dr = g - r + G (b - W y)

where for the octagon `W = sum_k (l_k / s_k) ray_k ray_k^T` over the multipliers `l` and slacks `s` of its
eight rays, and for the quadratic cone `W` is the square of the Nesterov-Todd scaling. The matrix has
the pattern of `S`, so the same elimination factors it. Predictor and corrector are those of Mehrotra (1992).

Cohesion beyond the cone (`stick`) is left to ADMM and to the exact solver: the cone lies inside the admissible set, so
forces found here prove as much, and `termination.judge` accounts for it in the test of a velocity.
"""

from __future__ import annotations

import math

import numpy as np

from falsework.stability.cpu.cones import NEGLIGIBLE, OCTAGON
from falsework.stability.cpu.layout import (
    FAST,
    add_force,
    add_pair_wrench,
    add_wrenches,
    copy_rows,
    dot,
    pair_velocity,
    point_velocity,
)
from falsework.stability.cpu.panels import add_pair_matrix, clear_panels, factor_panels, solve_panels
from falsework.stability.cpu.termination import MARGIN, UNDECIDED, UNSTABLE, judge
from falsework.utils.kernels import njit

_RAY_X = np.array([math.cos(k * math.pi / 4) for k in range(8)])
_RAY_Y = np.array([math.sin(k * math.pi / 4) for k in range(8)])
_BACK_OFF = 0.99
"""Share of the way to the boundary of the cones in a step, as is common for such methods."""


@njit(inline="always", fastmath=FAST)
def _scaling(x, s, j):
    """Return the scaling of Nesterov and Todd: a unit vector and a factor; and the determinant of the slack."""
    det_x = x[j, 0] * x[j, 0] - x[j, 1] * x[j, 1] - x[j, 2] * x[j, 2]
    det_s = s[j, 0] * s[j, 0] - s[j, 1] * s[j, 1] - s[j, 2] * s[j, 2]
    fx, fs = 1.0 / math.sqrt(det_x), 1.0 / math.sqrt(det_s)
    both = fx * fs * (x[j, 0] * s[j, 0] + x[j, 1] * s[j, 1] + x[j, 2] * s[j, 2])
    f = 1.0 / math.sqrt(2.0 * (1.0 + both))
    v0, v1, v2 = f * (fx * x[j, 0] + fs * s[j, 0]), f * (fx * x[j, 1] - fs * s[j, 1]), f * (fx * x[j, 2] - fs * s[j, 2])
    return v0, v1, v2, math.sqrt(det_x / det_s), det_s


@njit(inline="always", fastmath=FAST)
def _system(octagon, mu, x, s, j, target, products, w, b):
    """Write weight and target force of one contact point.

    `x` and `s` are multipliers and slacks (octagon: one per ray; quadratic: force and slack in coordinates in
    which the cone is its own dual); `products` are those of their predicted steps.
    """
    if octagon:
        w00, w01, w02, w11, w12, w22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        b0, b1, b2 = 0.0, 0.0, 0.0
        for k in range(8):
            inverse = 1.0 / s[j, k]
            ratio = x[j, k] * inverse
            rx, ry = mu * _RAY_X[k], mu * _RAY_Y[k]
            w00 += ratio
            w01 += ratio * rx
            w02 += ratio * ry
            w11 += ratio * rx * rx
            w12 += ratio * rx * ry
            w22 += ratio * ry * ry
            force = x[j, k] + (target - products[j, k]) * inverse
            b0 += force
            b1 += force * rx
            b2 += force * ry
        w[0], w[1], w[2], w[3], w[4], w[5] = w00, w01, w02, w11, w12, w22
        b[0], b[1], b[2] = b0, b1, b2
        return
    v0, v1, v2, scale, det_s = _scaling(x, s, j)
    # Back from self-dual coordinates: the normal was multiplied by mu.
    w[0] = scale * (2.0 * v0 * v0 - 1.0) / (mu * mu)
    w[1] = scale * 2.0 * v0 * v1 / mu
    w[2] = scale * 2.0 * v0 * v2 / mu
    w[3] = scale * (2.0 * v1 * v1 + 1.0)
    w[4] = scale * 2.0 * v1 * v2
    w[5] = scale * (2.0 * v2 * v2 + 1.0)
    t = target / det_s
    b[0] = (x[j, 0] + t * s[j, 0]) / mu
    b[1] = x[j, 1] - t * s[j, 1]
    b[2] = x[j, 2] - t * s[j, 2]


@njit(inline="always", fastmath=FAST)
def _step(octagon, mu, x, s, j, target, products, y0, y1, y2, dx, ds):
    """Write the steps of one contact point towards `y = G^T (r + dr)`; return the largest feasible step of both."""
    reach = 1e30
    if octagon:
        for k in range(8):
            y = y0 + mu * (_RAY_X[k] * y1 + _RAY_Y[k] * y2)
            ds[j, k] = y - s[j, k]
            dx[j, k] = (target - products[j, k] - x[j, k] * y) / s[j, k]
            if ds[j, k] < 0.0:
                reach = min(reach, -s[j, k] / ds[j, k])
            if dx[j, k] < 0.0:
                reach = min(reach, -x[j, k] / dx[j, k])
        return reach
    y0 /= mu
    v0, v1, v2, scale, det_s = _scaling(x, s, j)
    along = 2.0 * (v0 * y0 + v1 * y1 + v2 * y2)
    t = target / det_s
    dx[j, 0] = t * s[j, 0] - scale * (along * v0 - y0)
    dx[j, 1] = -t * s[j, 1] - scale * (along * v1 + y1)
    dx[j, 2] = -t * s[j, 2] - scale * (along * v2 + y2)
    ds[j, 0], ds[j, 1], ds[j, 2] = y0 - s[j, 0], y1 - s[j, 1], y2 - s[j, 2]
    return min(_to_boundary(x, dx, j), _to_boundary(s, ds, j))


@njit(inline="always", fastmath=FAST)
def _to_boundary(x, dx, j):
    """Return the largest step along `dx` that stays in the cone `x0 >= |(x1, x2)|`."""
    a = dx[j, 0] * dx[j, 0] - dx[j, 1] * dx[j, 1] - dx[j, 2] * dx[j, 2]
    b = x[j, 0] * dx[j, 0] - x[j, 1] * dx[j, 1] - x[j, 2] * dx[j, 2]
    c = x[j, 0] * x[j, 0] - x[j, 1] * x[j, 1] - x[j, 2] * x[j, 2]
    reach = 1e30
    if dx[j, 0] < 0.0:
        reach = -x[j, 0] / dx[j, 0]
    discriminant = b * b - a * c
    if discriminant > 0.0:
        root = math.sqrt(discriminant)
        q = -(b + math.copysign(root, b))
        for t in (q / a if a != 0.0 else -1.0, c / q if q != 0.0 else -1.0):
            if t > 0.0:
                reach = min(reach, t)
    return reach


@njit(fastmath=FAST, cache=True)
def _start(structure, work, pairs, octagon, mu, r):
    """Write interior multipliers and slacks near the ADMM result in `work.z` and `r`."""
    z, v, weights, slacks = work.z, work.v, work.weights, work.slacks
    points = work.start[pairs]
    strains(structure, work, pairs, r)
    mean_force, mean_slack = 0.0, 0.0
    for j in range(points):
        mean_force += z[j, 0]
        mean_slack += abs(v[j, 0])
    # Where ADMM has found no force, start from a share of the gravity load per contact point.
    least = 0.01 * math.sqrt(dot(work, r, r) / points)
    mean_force = max(mean_force / points, least)
    mean_slack = max(mean_slack / points, least)
    for j in range(points):
        force = z[j, 0] + mean_force
        slack = max(v[j, 0], 0.0) + mean_slack
        if octagon:
            for k in range(8):
                weights[j, k] = force / 8.0
                slacks[j, k] = slack
        else:
            weights[j, 0], weights[j, 1], weights[j, 2] = mu[j] * force, 0.0, 0.0
            slacks[j, 0], slacks[j, 1], slacks[j, 2] = slack / mu[j], 0.0, 0.0


@njit(fastmath=FAST, cache=True)
def strains(structure, work, pairs, velocity):
    """Write `work.v = G^T velocity`."""
    basis, start, pair, slot_a, slot_b, v = work.basis, work.start, work.pair, work.slot_a, work.slot_b, work.v
    transfer_a, transfer_b = structure.transfer_a, structure.transfer_b
    for p in range(pairs):
        s0, s1, s2, s3, s4, s5 = pair_velocity(transfer_a, transfer_b, pair[p], slot_a[p], slot_b[p], velocity)
        for j in range(start[p], start[p + 1]):
            v[j, 0], v[j, 1], v[j, 2] = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)


@njit(fastmath=FAST, cache=True)
def _assemble(structure, work, pairs, octagon, mu, r, target, matrix):
    """Write the right-hand side, and the matrix if requested."""
    basis, start, pair, slot_a, slot_b = work.basis, work.start, work.pair, work.slot_a, work.slot_b
    ta, tb, free, v, rhs, panels = structure.transfer_a, structure.transfer_b, work.free, work.v, work.rhs, work.panels
    weights, slacks, products = work.weights, work.slacks, work.products
    if matrix:
        clear_panels(panels, 1.0, matrix)
    strains(structure, work, pairs, r)
    copy_rows(work.free, work.load, rhs)
    for j in range(len(free)):
        if free[j]:
            for i in range(6):
                rhs[j, i] -= r[j, i]
    w, b = np.empty(6), np.empty(3)
    local, left = np.empty((6, 6)), np.empty((6, 6))
    for p in range(pairs):
        local[:] = 0.0
        a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(start[p], start[p + 1]):
            _system(octagon, mu[j], weights, slacks, j, target, products, w, b)
            w00, w01, w02, w11, w12, w22 = w[0], w[1], w[2], w[3], w[4], w[5]
            c0 = b[0] - w00 * v[j, 0] - w01 * v[j, 1] - w02 * v[j, 2]
            c1 = b[1] - w01 * v[j, 0] - w11 * v[j, 1] - w12 * v[j, 2]
            c2 = b[2] - w02 * v[j, 0] - w12 * v[j, 1] - w22 * v[j, 2]
            a0, a1, a2, a3, a4, a5 = add_force(basis, j, c0, c1, c2, a0, a1, a2, a3, a4, a5)
            if matrix:
                add_point_matrix(basis, j, w00, w01, w02, w11, w12, w22, local)
        add_pair_wrench(ta, tb, pair[p], slot_a[p], slot_b[p], a0, a1, a2, a3, a4, a5, rhs)
        if matrix:
            add_pair_matrix(structure, work, p, local, left)


@njit(inline="always", fastmath=FAST)
def add_point_matrix(basis, j, w00, w01, w02, w11, w12, w22, out):
    """Add the lower triangle of `B w B^T` to `out`, with the basis `B` of a point and a symmetric matrix `w`."""
    for i in range(6):
        h0 = basis[j, i, 0] * w00 + basis[j, i, 1] * w01 + basis[j, i, 2] * w02
        h1 = basis[j, i, 0] * w01 + basis[j, i, 1] * w11 + basis[j, i, 2] * w12
        h2 = basis[j, i, 0] * w02 + basis[j, i, 1] * w12 + basis[j, i, 2] * w22
        for k in range(i + 1):
            out[i, k] += h0 * basis[j, k, 0] + h1 * basis[j, k, 1] + h2 * basis[j, k, 2]


@njit(fastmath=FAST, cache=True)
def _steps(structure, work, pairs, octagon, mu, target):
    """Write the steps of multipliers and slacks to the velocity in `work.residual`; return the largest feasible one."""
    weights, slacks, products, v = work.weights, work.slacks, work.products, work.v
    dx, ds = work.weight_steps, work.slack_steps
    strains(structure, work, pairs, work.residual)
    reach = 1e30
    for j in range(work.start[pairs]):
        here = _step(octagon, mu[j], weights, slacks, j, target, products, v[j, 0], v[j, 1], v[j, 2], dx, ds)
        reach = min(reach, here)
    return reach


@njit(fastmath=FAST, cache=True)
def _newton(structure, work, pairs, octagon, mu, r, target, refines):
    """Solve the factored system, whose right-hand side is in `work.rhs`, and write all steps.

    The velocity after the whole step goes to `work.residual`. Where weights differ by many orders of magnitude, forces
    magnify the errors of the solution, and what they leave out of balance exceeds the velocity. So this is solved for
    in turn, as in iterative refinement, as long as that halves it.

    Returns:
        The largest feasible step length.
    """
    free, ahead, rhs, symmetric = work.free, work.residual, work.rhs, pairs >= 0
    copy_rows(free, r, ahead)
    before = np.inf
    while True:
        solve_panels(work.panels, rhs, symmetric)
        for j in range(len(free)):
            if free[j]:
                for i in range(6):
                    ahead[j, i] += rhs[j, i]
        reach = _steps(structure, work, pairs, octagon, mu, target)
        if not refines:
            break
        _write_forces(work, work.start[pairs], octagon, mu, 1.0)
        copy_rows(work.free, work.load, rhs)
        add_wrenches(structure, work, pairs, work.z, rhs)
        for j in range(len(free)):
            if free[j]:
                for i in range(6):
                    rhs[j, i] -= ahead[j, i]
        error = math.sqrt(dot(work, rhs, rhs))
        if not MARGIN * math.sqrt(dot(work, ahead, ahead)) < error < 0.5 * before:
            break
        before = error
    return reach


@njit(fastmath=FAST, cache=True)
def _complementarity(work, points, size, length):
    """Return the mean product of multipliers and slacks after a step of this length."""
    weights, slacks, dx, ds = work.weights, work.slacks, work.weight_steps, work.slack_steps
    total = 0.0
    for j in range(points):
        for k in range(size):
            total += (weights[j, k] + length * dx[j, k]) * (slacks[j, k] + length * ds[j, k])
    return total / points


@njit(fastmath=FAST, cache=True)
def _write_forces(work, points, octagon, mu, length):
    """Write the forces after a step of this length to `work.z`."""
    z, weights, dx = work.z, work.weights, work.weight_steps
    for j in range(points):
        if octagon:
            n, x, y = 0.0, 0.0, 0.0
            for k in range(8):
                weight = weights[j, k] + length * dx[j, k]
                n += weight
                x += _RAY_X[k] * weight
                y += _RAY_Y[k] * weight
            z[j, 0], z[j, 1], z[j, 2] = n, mu[j] * x, mu[j] * y
        else:
            z[j, 0] = (weights[j, 0] + length * dx[j, 0]) / mu[j]
            z[j, 1], z[j, 2] = weights[j, 1] + length * dx[j, 1], weights[j, 2] + length * dx[j, 2]


@njit(fastmath=FAST, cache=True)
def run_interior(structure, work, pairs, options):
    """Run from the iterate of ADMM.

    As with the exact solver, a state is unstable too where a velocity proves a residual above the resolution alone.
    This is decided at the end, since most such bounds still rise.

    Returns:
        Verdict, residual and steps. The velocity is in `work.velocity`.
    """
    mu, points = work.friction, work.start[pairs]
    octagon = structure.cone == OCTAGON
    for j in range(points):
        octagon = octagon or mu[j] <= NEGLIGIBLE  # without friction both cones are the same ray
    size = 8 if octagon else 3
    r, free, ahead, proof = work.velocity, work.free, work.residual, work.proof
    weights, slacks, dx, ds, products = work.weights, work.slacks, work.weight_steps, work.slack_steps, work.products
    copy_rows(work.free, work.load, r)
    add_wrenches(structure, work, pairs, work.z, r)
    if points == 0:
        verdict, residual, _ = judge(structure, work, pairs, r, options, options.resolution)
        return verdict, residual, 0
    _start(structure, work, pairs, octagon, mu, r)
    residual, proven = np.nan, 0.0
    predict, correct = points == 0, points > 0  # not literals, each of which numba would compile separately
    for iteration in range(1, options.interior_steps + 1):
        for j in range(points):
            for k in range(size):
                dx[j, k], ds[j, k], products[j, k] = 0.0, 0.0, 0.0
        gap = _complementarity(work, points, size, 0.0)
        _assemble(structure, work, pairs, octagon, mu, r, 0.0, correct)
        if not factor_panels(structure.elimination.supernode, work.panels, correct):
            break
        reach = min(1.0, _newton(structure, work, pairs, octagon, mu, r, 0.0, predict))
        centring = max(_complementarity(work, points, size, reach) / gap, 0.0) ** 3
        target = centring * gap / (8.0 if octagon else 1.0)
        if octagon:  # the second-order term of the quadratic cone is neglected
            for j in range(points):
                for k in range(size):
                    products[j, k] = dx[j, k] * ds[j, k]
        _assemble(structure, work, pairs, octagon, mu, r, target, predict)
        reach = min(1.0, _BACK_OFF * _newton(structure, work, pairs, octagon, mu, r, target, correct))
        for j in range(len(free)):
            if free[j]:
                for i in range(6):
                    r[j, i] += reach * (ahead[j, i] - r[j, i])
        _write_forces(work, points, octagon, mu, reach)
        for j in range(points):
            for k in range(size):
                weights[j, k] += reach * dx[j, k]
                slacks[j, k] += reach * ds[j, k]
        if not dot(work, r, r) < np.inf:
            break
        verdict, residual, least = judge(structure, work, pairs, r, options, options.resolution)
        if verdict != UNDECIDED:
            return verdict, residual, iteration
        if least > proven:
            proven = least
            copy_rows(free, r, proof)
    if proven > (1.0 + MARGIN) * options.resolution:
        copy_rows(free, proof, r)
        return UNSTABLE, proven, options.interior_steps
    return UNDECIDED, residual, options.interior_steps
