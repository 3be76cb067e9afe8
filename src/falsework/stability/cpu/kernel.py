"""Compiled verdict of one state, and of a range of states without the GIL.

Over-relaxed ADMM settles most states within fifty cheap iterations; the interior point method settles the rest. ADMM is
in Douglas-Rachford form, with one vector `u` per contact point: with `z = proj_K(u)`, an iteration solves
`S w = G (2 z - u) + g` and adds `relaxation (z - u - G^T w)` to `u` (docs/how-it-works). `z` are the forces, `w` the
velocity.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.cones import NEGLIGIBLE, project_joint
from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.interior_point import run_interior
from falsework.stability.cpu.layout import (
    FAST,
    add_force,
    add_pair_wrench,
    add_wrenches,
    copy_rows,
    load_forces,
    make_scratch,
    pair_velocity,
    point_velocity,
    restrict,
    store_forces,
    write_motion,
)
from falsework.stability.cpu.panels import add_block, clear_panels, factor_panels, solve_panels
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED, check_primal, judge
from falsework.utils.kernels import njit


@njit(fastmath=FAST, cache=True)
def factor_admm(structure, work, pairs, rho):
    """Factor `S = rho I + G G^T` of the state."""
    panels, supernode, symmetric = work.panels, structure.elimination.supernode, pairs >= 0
    lay_out_panels(structure, work.free, panels)
    clear_panels(panels, rho, symmetric)
    pair, slot_a, slot_b = work.pair, work.slot_a, work.slot_b
    upper, diagonal, block, width = panels.upper, panels.diagonal, panels.block, panels.width
    stiff_a, stiff_b, stiff_side = structure.stiffness_aa, structure.stiffness_bb, structure.stiffness_side
    for p in range(pairs):
        q, a, b = pair[p], slot_a[p], slot_b[p]
        if a >= 0:
            add_block(stiff_a, q, upper, diagonal[a], width[supernode[a]])
        if b >= 0:
            add_block(stiff_b, q, upper, diagonal[b], width[supernode[b]])
        if a >= 0 and b >= 0:
            add_block(stiff_side, q, upper, block[q], width[supernode[min(a, b)]])
    return factor_panels(supernode, panels, symmetric)


@njit(fastmath=FAST, cache=True)
def try_bonded(structure, work, pairs, options):
    """Try the least-norm forces, those of fully bonded contacts; return verdict and residual.

    With tensile joints they are mostly admissible.
    """
    basis, start, pair, slot_a, slot_b = work.basis, work.start, work.pair, work.slot_a, work.slot_b
    z, pull, mu, stick, w, cone = work.z, work.pull, work.friction, work.stick, work.velocity, structure.cone
    if not factor_admm(structure, work, pairs, NEGLIGIBLE):
        return UNDECIDED, np.nan
    for j in range(start[pairs]):
        z[j, 0], z[j, 1], z[j, 2] = pull[j], 0.0, 0.0
    copy_rows(work.free, work.load, w)
    add_wrenches(structure, work, pairs, z, w)
    solve_panels(work.panels, w, True)
    transfer_a, transfer_b = structure.transfer_a, structure.transfer_b
    for p in range(pairs):
        s0, s1, s2, s3, s4, s5 = pair_velocity(transfer_a, transfer_b, pair[p], slot_a[p], slot_b[p], w)
        for j in range(start[p], start[p + 1]):
            t0, t1, t2 = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)
            z[j, 0], z[j, 1], z[j, 2] = project_joint(cone, pull[j] - t0, -t1, -t2, mu[j], stick[j])
    worst = check_primal(structure, work, pairs, z, options, work.residual)
    return (STABLE, worst) if worst < (1.0 - MARGIN) * options.resolution else (UNDECIDED, worst)


@njit(fastmath=FAST, cache=True)
def run_admm(structure, work, pairs, options):
    """Run ADMM from `work.u`; return verdict, residual and iterations. The velocity is in `work.velocity`."""
    alpha, cone = options.relaxation, structure.cone
    basis, start, pair, slot_a, slot_b = work.basis, work.start, work.pair, work.slot_a, work.slot_b
    transfer_a, transfer_b = structure.transfer_a, structure.transfer_b
    mu, stick = work.friction, work.stick
    free, u, z, v, w, rhs = work.free, work.u, work.z, work.v, work.velocity, work.rhs
    for j in range(start[pairs]):
        z[j, 0], z[j, 1], z[j, 2] = project_joint(cone, u[j, 0], u[j, 1], u[j, 2], mu[j], stick[j])
        for r in range(3):
            v[j, r] = 2.0 * z[j, r] - u[j, r]
    copy_rows(work.free, work.load, rhs)
    add_wrenches(structure, work, pairs, v, rhs)
    for iteration in range(1, options.iterations + 1):
        copy_rows(free, rhs, w)
        solve_panels(work.panels, w, True)
        copy_rows(work.free, work.load, rhs)
        for p in range(pairs):
            q, a, b = pair[p], slot_a[p], slot_b[p]
            s0, s1, s2, s3, s4, s5 = pair_velocity(transfer_a, transfer_b, q, a, b, w)
            a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(start[p], start[p + 1]):
                t0, t1, t2 = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)
                u0 = u[j, 0] + alpha * (z[j, 0] - u[j, 0] - t0)
                u1 = u[j, 1] + alpha * (z[j, 1] - u[j, 1] - t1)
                u2 = u[j, 2] + alpha * (z[j, 2] - u[j, 2] - t2)
                z0, z1, z2 = project_joint(cone, u0, u1, u2, mu[j], stick[j])
                u[j, 0], u[j, 1], u[j, 2] = u0, u1, u2
                z[j, 0], z[j, 1], z[j, 2] = z0, z1, z2
                v0, v1, v2 = 2.0 * z0 - u0, 2.0 * z1 - u1, 2.0 * z2 - u2
                a0, a1, a2, a3, a4, a5 = add_force(basis, j, v0, v1, v2, a0, a1, a2, a3, a4, a5)
            add_pair_wrench(transfer_a, transfer_b, q, a, b, a0, a1, a2, a3, a4, a5, rhs)
        if iteration % options.check_every == 0:
            verdict, residual, _ = judge(structure, work, pairs, w, options, options.tolerance)
            if verdict != UNDECIDED:
                return verdict, residual, iteration
    return UNDECIDED, np.nan, options.iterations


@njit(cache=True)
def solve_state(structure, state, options, work, forces, velocity, warm):
    """Decide one state.

    Args:
        structure, options, work: `KernelArrays`, `Options` and `Scratch`.
        state: shape (parts,).
        forces: in: initial contact forces in N where `warm`; out: the forces, those between parts that cannot move as
            they were. Shape (points, 3) or (0, 3).
        velocity: out: the virtual velocity, zero where parts do not move, shape (parts, 6) or (0, 6).
        warm: whether `forces` holds an initial guess.

    Returns:
        Verdict, the residual that it is based on, iterations of both methods.
    """
    pairs, count = restrict(structure, state, work)
    if count == 0:
        return STABLE, 0.0, 0
    if warm:
        load_forces(structure, work, pairs, forces, work.u)
    else:
        for j in range(work.start[pairs]):
            work.u[j, 0], work.u[j, 1], work.u[j, 2] = work.pull[j], 0.0, 0.0
    verdict, residual, iterations = UNDECIDED, np.nan, 0
    if work.pulled[0] > 0.0:
        verdict, residual = try_bonded(structure, work, pairs, options)
    if verdict == UNDECIDED and factor_admm(structure, work, pairs, options.rho):
        verdict, residual, iterations = run_admm(structure, work, pairs, options)
        if verdict == UNDECIDED and options.interior_steps > 0:
            verdict, residual, steps = run_interior(structure, work, pairs, options)
            iterations += steps
    if len(forces):
        store_forces(structure, work, pairs, forces)
    if len(velocity):
        velocity[:] = 0.0
        write_motion(structure, work, work.velocity, 1.0, velocity)
    return verdict, residual, iterations


@njit(nogil=True, cache=True)
def solve_range(structure, states, options, forces, velocity, warm, verdict, residual, iterations):
    """Decide the states whose `verdict` is `UNDECIDED`, one by one; arrays as in `solve_state`, batched.

    `forces` and `velocity` may be empty where no certificates are requested. Iterations are added up.
    """
    nothing_f = np.zeros((0, 3))
    nothing_v = np.zeros((0, 6))
    work = make_scratch(structure)
    for i in range(len(states)):
        if verdict[i] != UNDECIDED:
            continue
        force = forces[i] if len(forces) else nothing_f
        motion = velocity[i] if len(velocity) else nothing_v
        verdict[i], residual[i], taken = solve_state(structure, states[i], options, work, force, motion, warm)
        iterations[i] += taken
