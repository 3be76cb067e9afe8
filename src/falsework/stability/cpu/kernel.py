"""Compiled verdict of one state, and of a range of states without the GIL.

ADMM settles most states within fifty cheap iterations; the interior point method settles the rest.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.admm import factor_admm, run_admm, try_bonded
from falsework.stability.cpu.interior_point import run_interior
from falsework.stability.cpu.layout import load_forces, make_scratch, restrict, store_forces
from falsework.stability.cpu.termination import STABLE, UNDECIDED
from falsework.utils.kernels import njit


@njit(cache=True)
def solve_state(structure, state, options, work, forces, velocity, warm):
    """Decide one state.

    Args:
        structure, options, work: `KernelArrays`, `Options` and `Scratch`.
        state: shape (parts,).
        forces: in: initial contact forces in N where `warm`; out: the forces. Shape (points, 3) or (0, 3).
        velocity: out: the virtual velocity, zero where parts do not move, shape (parts, 6) or (0, 6).
        warm: whether `forces` holds an initial guess.

    Returns:
        Verdict, the residual that it is based on, ADMM iterations, interior-point steps.
    """
    pairs, count = restrict(structure, state, work)
    if count == 0:
        return STABLE, 0.0, 0, 0
    if warm:
        load_forces(structure, work, pairs, forces, work.u)
    else:
        for j in range(work.start[pairs]):
            work.u[j, 0], work.u[j, 1], work.u[j, 2] = work.pull[j], 0.0, 0.0
    verdict, residual, iterations, steps = UNDECIDED, np.nan, 0, 0
    if work.pulled[0] > 0.0:
        verdict, residual = try_bonded(structure, work, pairs, options)
    if verdict == UNDECIDED and factor_admm(structure, work, pairs, options.rho):
        verdict, residual, iterations = run_admm(structure, work, pairs, options)
        if verdict == UNDECIDED and options.interior_steps > 0:
            verdict, residual, steps = run_interior(structure, work, pairs, options)
    if len(forces):
        forces[:] = 0.0
        store_forces(structure, work, pairs, forces)
    if len(velocity):
        velocity[:] = 0.0
        for j in range(len(work.free)):
            if work.free[j]:
                part = structure.elimination.order[j]
                for r in range(6):
                    for c in range(6):
                        velocity[part, r] += structure.acceleration[part, r, c] * work.velocity[j, c]
    return verdict, residual, iterations, steps


@njit(nogil=True, cache=True)
def solve_range(structure, states, options, forces, velocity, warm, verdict, residual, iterations, steps):
    """Decide the states whose `verdict` is `UNDECIDED`, one by one; arrays as in `solve_state`, batched.

    `forces` and `velocity` may be empty where no certificates are requested. Iterations and steps are added to their
    arrays.
    """
    nothing_f = np.zeros((0, 3))
    nothing_v = np.zeros((0, 6))
    work = make_scratch(structure)
    for i in range(len(states)):
        if verdict[i] != UNDECIDED:
            continue
        force = forces[i] if len(forces) else nothing_f
        motion = velocity[i] if len(velocity) else nothing_v
        v, r, k, s = solve_state(structure, states[i], options, work, force, motion, warm)
        verdict[i] = v
        residual[i] = r
        iterations[i] += k
        steps[i] += s
