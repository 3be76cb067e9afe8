"""Local repair of contact forces: balance near a change with the forces farther away as they were.

A state differs from a stable one, whose forces are known, in a part or two. Forces that balance it differ from those
mostly near by. So keep every force more than a few contacts away, take those at the border as loads, and balance the
parts inside: the work of a few parts however large the structure is. Failure proves nothing, since forces may have to
change farther away: the weight of a part that is let go of has to reach a support.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.admm import factor_admm, run_admm
from falsework.stability.cpu.cones import project_joint
from falsework.stability.cpu.interior_point import run_interior
from falsework.stability.cpu.layout import add_pair_wrench, make_scratch, restrict
from falsework.stability.cpu.neighbourhood import hold_far_parts
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED, check_primal
from falsework.utils.kernels import njit

REPAIR_RINGS = (2, 4, 8)
"""Distances from a changed part in contacts within which forces may change, tried in turn."""


@njit(cache=True)
def _keep_border(structure, state, near, work, pairs, forces):
    """Turn the forces between parts that are free in `near` and parts that are free in `state` alone into loads.

    Returns:
        Number of pairs left, at the front of the scratch, and whether one of them leads to a part that cannot move,
        without which a weight that nothing bore before has nowhere to go.
    """
    parts, first = structure.pair_parts, structure.pair_start
    ta, tb, basis, pair, start = structure.transfer_a, structure.transfer_b, work.basis, work.pair, work.start
    scale, friction, pull, stick, tears = work.force_scale, work.friction, work.pull, work.stick, work.tears
    kept, points, grounded = 0, 0, False
    for p in range(pairs):
        q, begin, end, a, b = pair[p], start[p], start[p + 1], work.slot_a[p], work.slot_b[p]
        if (a < 0 and state[parts[q, 0]] == 1) or (b < 0 and state[parts[q, 1]] == 1):
            a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(begin, end):
                c = first[q] + j - begin
                f0 = forces[c, 0] / scale[j] + pull[j]
                f1, f2 = forces[c, 1] / scale[j], forces[c, 2] / scale[j]
                a0 += basis[j, 0, 0] * f0 + basis[j, 0, 1] * f1 + basis[j, 0, 2] * f2
                a1 += basis[j, 1, 0] * f0 + basis[j, 1, 1] * f1 + basis[j, 1, 2] * f2
                a2 += basis[j, 2, 0] * f0 + basis[j, 2, 1] * f1 + basis[j, 2, 2] * f2
                a3 += basis[j, 3, 0] * f0 + basis[j, 3, 1] * f1 + basis[j, 3, 2] * f2
                a4 += basis[j, 4, 0] * f0 + basis[j, 4, 1] * f1 + basis[j, 4, 2] * f2
                a5 += basis[j, 5, 0] * f0 + basis[j, 5, 1] * f1 + basis[j, 5, 2] * f2
            add_pair_wrench(ta, tb, q, a, b, a0, a1, a2, a3, a4, a5, work.load)
            continue
        grounded = grounded or a < 0 or b < 0
        pair[kept], start[kept], work.slot_a[kept], work.slot_b[kept] = q, points, a, b
        for j in range(begin, end):
            for i in range(6):
                for k in range(3):
                    basis[points, i, k] = basis[j, i, k]
            scale[points], friction[points], pull[points] = scale[j], friction[j], pull[j]
            stick[points], tears[points] = stick[j], tears[j]
            points += 1
        kept += 1
    start[kept] = points
    return kept, grounded


@njit(cache=True)
def _accept_forces(structure, state, options, work, forces):
    """Return the residual of contact forces in N in a state; they are moved into their cones, and the others cleared.

    `work.z` then holds them as `solve_state` leaves them.
    """
    pairs, _ = restrict(structure, state, work)
    z, pull, mu, stick, cone = work.z, work.pull, work.friction, work.stick, structure.cone
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            c, scale = j + shift, work.force_scale[j]
            f0, f1, f2 = forces[c, 0] / scale + pull[j], forces[c, 1] / scale, forces[c, 2] / scale
            z[j, 0], z[j, 1], z[j, 2] = project_joint(cone, f0, f1, f2, mu[j], stick[j])
    forces[:] = 0.0
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            scale = work.force_scale[j]
            forces[j + shift, 0] = (z[j, 0] - pull[j]) * scale
            forces[j + shift, 1], forces[j + shift, 2] = z[j, 1] * scale, z[j, 2] * scale
    return check_primal(structure, work, pairs, z, options, work.residual)


@njit(cache=True)
def repair_state(structure, state, parent, rings, options, work, near, forces):
    """Balance a state with forces of its parent that change only near their difference.

    Args:
        structure, options, work: `KernelArrays`, `Options` and `Scratch`.
        state, parent: shape (parts,).
        rings: distances from the difference, tried in turn.
        near: scratch, shape (parts,).
        forces: in: contact forces in N that balance the parent; out: of the state, or a guess at them if undecided.
            Shape (points, 3).

    Returns:
        `STABLE` or `UNDECIDED`; residual; ADMM iterations; interior-point steps.
    """
    bound, spent, taken = (1.0 - MARGIN) * options.tolerance, 0, 0
    residual = _accept_forces(structure, state, options, work, forces)
    if residual < bound:
        return STABLE, residual, spent, taken
    for ring in rings:
        kept, free = hold_far_parts(structure, state, parent, ring, near)
        if kept == 0 or 2 * kept > free:
            break
        pairs, _ = restrict(structure, near, work)
        pairs, grounded = _keep_border(structure, state, near, work, pairs, forces)
        if not grounded:
            continue
        for p in range(pairs):
            shift = structure.pair_start[work.pair[p]] - work.start[p]
            for j in range(work.start[p], work.start[p + 1]):
                for r in range(3):
                    work.u[j, r] = forces[j + shift, r] / work.force_scale[j]
                work.u[j, 0] += work.pull[j]
        if not factor_admm(structure, work, pairs, options.rho):
            break
        verdict, _, iterations = run_admm(structure, work, pairs, options)
        spent += iterations
        if verdict == UNDECIDED and options.interior_steps > 0:
            verdict, _, steps = run_interior(structure, work, pairs, options)
            taken += steps
        if verdict != STABLE:
            continue
        for p in range(pairs):
            shift = structure.pair_start[work.pair[p]] - work.start[p]
            for j in range(work.start[p], work.start[p + 1]):
                work.z[j, 0] -= work.pull[j]
                for r in range(3):
                    forces[j + shift, r] = work.z[j, r] * work.force_scale[j]
        residual = _accept_forces(structure, state, options, work, forces)
        if residual < bound:
            return STABLE, residual, spent, taken
        break  # the forces farther away do not balance their parts
    return UNDECIDED, np.nan, spent, taken


@njit(nogil=True, cache=True)
def repair_range(structure, states, parents, known, rings, options, forces, verdict, residual, iterations, steps):
    """Balance states whose `verdict` is `UNDECIDED` with the forces of their parents, where those are `known`.

    Arrays as in `solve_range`.

    Returns:
        Number of states left undecided.
    """
    near = np.empty(states.shape[1], np.uint8)
    work = make_scratch(structure)
    left = 0
    for i in range(len(states)):
        if verdict[i] != UNDECIDED:
            continue
        if known[i]:
            v, r, k, s = repair_state(structure, states[i], parents[i], rings, options, work, near, forces[i])
            verdict[i] = v
            residual[i] = r
            iterations[i] += k
            steps[i] += s
        left += verdict[i] == UNDECIDED
    return left
