"""Termination tests of the solvers in float64: admissible forces in balance, or a velocity that proves instability.

`certificate.py` repeats both from the meshes' contacts alone; these run inside the compiled loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from falsework.stability.cpu.cones import support
from falsework.stability.cpu.layout import FAST, add_wrenches, copy_rows, pair_velocity, point_velocity
from falsework.utils.kernels import njit

STABLE, UNSTABLE, UNDECIDED = 1, -1, 0
MARGIN = 1e-3
"""Both tests are stricter than their limits by this share, so that rounding cannot overturn them."""


class Options(NamedTuple):
    """Numerical options of the kernel; see `NumericalSettings` for their meaning."""

    rho: float
    relaxation: float
    iterations: int
    check_every: int
    interior_steps: int
    tolerance: float
    resolution: float
    """Residual below which forces prove a state stable; see `StabilitySettings.resolution`."""
    force_bound: float


@njit(inline="always", fastmath=FAST)
def residual_of_part(structure, part, residual, j):
    """Return the largest acceleration of a part, as a share of gravity, from row `j` of the whitened residual."""
    turn, measure = structure.acceleration, structure.measure
    worst = 0.0
    for r in range(6):
        total = 0.0
        for c in range(6):
            total += turn[part, r, c] * residual[j, c]
        worst = max(worst, abs(total) * measure[part, r // 3])
    return worst


@njit(fastmath=FAST, cache=True)
def largest_residual(structure, work, residual):
    """Return the largest acceleration of a part that can move, as a share of gravity, from the whitened residual."""
    worst = 0.0
    for j in range(len(work.free)):
        if work.free[j]:
            worst = max(worst, residual_of_part(structure, structure.elimination.order[j], residual, j))
    return worst


@njit(fastmath=FAST, cache=True)
def check_primal(structure, work, pairs, forces, options, residual):
    """Return the residual that forces of the cone leave; infinity if they exceed the force bound.

    The whitened residual is written to `residual`.
    """
    copy_rows(work.free, work.load, residual)
    add_wrenches(structure, work, pairs, forces, residual)
    pressed = 0.0
    for j in range(work.start[pairs]):
        pressed += forces[j, 0] * work.force_scale[j]
    if pressed > options.force_bound * structure.weight + work.pulled[0]:
        return np.inf
    return largest_residual(structure, work, residual)


@njit(fastmath=FAST, cache=True)
def check_dual(structure, work, pairs, velocity, options, limit):
    """Return the lower bound, proven by a velocity, on the residual of any forces of the cone below the force bound.

    For forces `f` of the cone with sum of normals at most `U W`, `velocity . (G f + g)` is at least
    `velocity . g - U W max_c support(-G^T velocity)_c`, minus the power that cohesion absorbs. It
    is at most the residual, the largest acceleration times `measure`, times the 1-norm of the momentum of `velocity`
    divided by `measure`. Bounds below `limit` may be returned as 0.
    """
    free, order, load, mass = work.free, structure.elimination.order, work.load, structure.momentum
    measure = structure.measure
    power = 0.0
    momentum = 0.0
    for j in range(len(free)):
        if not free[j]:
            continue
        part = order[j]
        for r in range(6):
            power += velocity[j, r] * load[j, r]
            total = 0.0
            for c in range(6):
                total += mass[part, r, c] * velocity[j, c]
            momentum += abs(total) / measure[part, r // 3]
    bound = options.force_bound * structure.weight + work.pulled[0]
    allowed = (power - limit * momentum) / bound
    if allowed <= 0.0:
        return 0.0
    basis, start, pair, slot_a, slot_b = work.basis, work.start, work.pair, work.slot_a, work.slot_b
    transfer_a, transfer_b, scale = structure.transfer_a, structure.transfer_b, work.force_scale
    friction, stick = work.friction, work.stick
    worst, stuck = 0.0, 0.0
    for p in range(pairs):
        s0, s1, s2, s3, s4, s5 = pair_velocity(transfer_a, transfer_b, pair[p], slot_a[p], slot_b[p], velocity)
        for j in range(start[p], start[p + 1]):
            n, x, y = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)
            worst = max(worst, support(structure.cone, -n, -x, -y, friction[j]) / scale[j])
            if stick[j] > 0.0:
                stuck += stick[j] * support(structure.cone, 0.0, x, y, 1.0)
        if worst > allowed:
            return 0.0
    return (power - stuck - worst * bound) / momentum


@njit(fastmath=FAST, cache=True)
def judge(structure, work, pairs, velocity, options, limit):
    """Judge the current forces `work.z` and a velocity.

    Returns:
        Verdict, the residual that it is based on, and the lower bound on the residual that the velocity proves; 0 if it
        is below `limit`.
    """
    worst = check_primal(structure, work, pairs, work.z, options, work.residual)
    if worst < (1.0 - MARGIN) * options.resolution:
        return STABLE, worst, 0.0
    least = check_dual(structure, work, pairs, velocity, options, limit)
    if least > (1.0 + MARGIN) * options.tolerance:
        return UNSTABLE, least, least
    return UNDECIDED, worst, least
