"""Local repair of contact forces: balance near a change with the forces farther away as they were.

A state differs from a stable one, whose forces are known, in a part or two. Forces that balance it differ from those
mostly near by. So keep the forces outside a region around the change, take those at its border as loads, and balance
the parts inside: the work of a few parts however large the structure is. Forces inside cannot change what the loads sum
up to, so the weight of a part that is let go of has to reach a support: a region that fails is followed by one along
the shortest way to a support, and this one extends over its border where it would press most, until it is balanced or
has more than half of the parts. The last region has all free parts that contacts between free parts join to the change:
forces elsewhere are in balance whatever happens there. Failure proves nothing, since steps may get stuck.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.centring import run_centring
from falsework.stability.cpu.cones import project_joint
from falsework.stability.cpu.kernel import factor_admm, run_admm
from falsework.stability.cpu.layout import (
    FAST,
    add_force,
    add_pair_wrench,
    add_wrench,
    load_forces,
    make_scratch,
    restrict,
    set_gravity,
    store_forces,
)
from falsework.stability.cpu.neighbourhood import extend_region, freeze_outside_ball, freeze_outside_corridor
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED, residual_of_part
from falsework.utils.kernels import njit

_ROUNDING = float(np.finfo(np.float64).eps ** 0.75)
"""Distance of forces from their cones, as a share of them, that is left to rounding; the checker allows more."""


@njit(cache=True)
def _keep_border(structure, state, near, work, pairs, forces):
    """Turn the forces between parts that are free in `near` and parts that are free in `state` alone into loads.

    Returns:
        Number of pairs left, at the front of the scratch, and whether one of them leads to a part that cannot move,
        without which a weight that nothing bore before has nowhere to go.
    """
    parts, basis, pair, start = structure.pair_parts, work.basis, work.pair, work.start
    scale, friction, pull, stick, tears = work.force_scale, work.friction, work.pull, work.stick, work.tears
    kept, points, grounded = 0, 0, False
    load_forces(structure, work, pairs, forces, work.z)
    for p in range(pairs):
        q, begin, end, a, b = pair[p], start[p], start[p + 1], work.slot_a[p], work.slot_b[p]
        if (a < 0 and state[parts[q, 0]] == 1) or (b < 0 and state[parts[q, 1]] == 1):
            add_wrench(structure, work, p, work.z, work.load)
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


@njit(fastmath=FAST, cache=True)
def _accept_forces(structure, state, options, residual, forces):
    """Return the residual of contact forces in N in a state; moves them into their cones, and clears the others.

    Forces that are in their cones up to rounding are left as they are, bit by bit.
    """
    parts, first, basis, scale = structure.pair_parts, structure.pair_start, structure.basis, structure.force_scale
    friction, pull, stick, cone = structure.friction, structure.pull, structure.stick, structure.cone
    transfer_a, transfer_b = structure.transfer_a, structure.transfer_b
    pull_a, pull_b = structure.pull_a, structure.pull_b
    position, order = structure.elimination.position, structure.elimination.order
    set_gravity(structure, state, residual)
    pressed, pulled = 0.0, 0.0
    for q in range(len(parts)):
        part_a, part_b = parts[q, 0], parts[q, 1]
        if state[part_a] == 0 or state[part_b] == 0 or (state[part_a] == 2 and state[part_b] == 2):
            for j in range(first[q], first[q + 1]):
                forces[j, 0], forces[j, 1], forces[j, 2] = 0.0, 0.0, 0.0
            continue
        a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(first[q], first[q + 1]):
            u0, u1, u2 = forces[j, 0] / scale[j] + pull[j], forces[j, 1] / scale[j], forces[j, 2] / scale[j]
            f0, f1, f2 = project_joint(cone, u0, u1, u2, friction[j], stick[j])
            if abs(f0 - u0) + abs(f1 - u1) + abs(f2 - u2) > _ROUNDING * (abs(u0) + abs(u1) + abs(u2)):
                forces[j, 0], forces[j, 1], forces[j, 2] = (f0 - pull[j]) * scale[j], f1 * scale[j], f2 * scale[j]
            pressed += f0 * scale[j]
            pulled += pull[j] * scale[j]
            a0, a1, a2, a3, a4, a5 = add_force(basis, j, f0, f1, f2, a0, a1, a2, a3, a4, a5)
        a = position[part_a] if state[part_a] == 1 else -1
        b = position[part_b] if state[part_b] == 1 else -1
        add_pair_wrench(transfer_a, transfer_b, q, a, b, a0, a1, a2, a3, a4, a5, residual)
        for r in range(6):
            if a >= 0:
                residual[a, r] += pull_a[q, r]
            if b >= 0:
                residual[b, r] += pull_b[q, r]
    if pressed > options.force_bound * structure.weight + pulled:
        return np.inf
    worst = 0.0
    for j in range(len(order)):
        if state[order[j]] == 1:
            worst = max(worst, residual_of_part(structure, order[j], residual, j))
    return worst


@njit(cache=True)
def _balance(structure, work, pairs, options, interior, level, patient, forces):
    """Balance forces on the parts in `work` from known ones, in N; return the verdict and iterations."""
    if pairs == 0:  # nothing touches the parts, so no force can balance them
        return UNDECIDED, 0
    if interior:
        load_forces(structure, work, pairs, forces, work.z)
        return run_centring(structure, work, pairs, options, level, patient)
    load_forces(structure, work, pairs, forces, work.u)
    if not factor_admm(structure, work, pairs, options.rho):
        return UNDECIDED, 0
    verdict, _, iterations = run_admm(structure, work, pairs, options)
    return verdict, iterations


@njit(cache=True)
def repair_state(structure, state, parent, reach, interior, options, work, near, forces):
    """Balance a state with forces of its parent that change only near their difference, else as far as they are joined.

    Args:
        structure, options, work: `KernelArrays`, `Options` and `Scratch`.
        state, parent: shape (parts,).
        reach: contacts by which the first region reaches beyond the change. The second has also the ways from there to
            a support that are longer than the shortest one by no more than that. Then it is extended by as much, and
            by twice as much each further time. Without any, or without a difference, the whole is balanced.
        interior: whether forces stay inside their cones, by `run_centring`; ADMM leaves them on the boundaries.
        near: scratch, shape (parts,).
        forces: in: contact forces in N that balance the parent; out: of the state if it is stable. Shape (points, 3).

    Returns:
        `STABLE` or `UNDECIDED`; residual; iterations.
    """
    bound, spent = (1.0 - MARGIN) * options.resolution, 0
    residual = _accept_forces(structure, state, options, work.residual, forces)
    if residual < bound:
        return STABLE, residual, spent
    level, regions = structure.weight / len(state), 0
    velocity = work.rhs if interior else work.velocity
    kept, free = freeze_outside_ball(structure, state, parent, reach, near)
    local = reach > 0 and kept > 0
    while True:
        local = local and 2 * kept <= free
        joined = 0
        if not local and reach > 0:
            joined, _ = freeze_outside_ball(structure, state, parent, len(state), near)
        if not local and joined == 0:
            for part in range(len(state)):  # assigning the array would need what portable code has not
                near[part] = state[part]
        pairs, _ = restrict(structure, near, work)
        grounded = True
        if local:
            pairs, grounded = _keep_border(structure, state, near, work, pairs, forces)
        if grounded:
            verdict, iterations = _balance(structure, work, pairs, options, interior, level, not local, forces)
            spent += iterations
            if verdict == STABLE:
                store_forces(structure, work, pairs, forces)
                residual = _accept_forces(structure, state, options, work.residual, forces)
                if residual < bound:
                    return STABLE, residual, spent
                # What is still out of balance lies outside the region.
        if not local:
            return UNDECIDED, np.nan, spent
        if regions == 0:
            kept, free = freeze_outside_corridor(structure, state, parent, reach, near)
            regions = 1
        else:
            before = kept
            if grounded:
                kept = extend_region(structure, state, near, velocity, forces, reach << (regions - 1))
            local = kept > before
            regions += 1


@njit(nogil=True, cache=True)
def repair_range(structure, states, parents, known, reach, interior, options, forces, verdict, residual, iterations):
    """Balance states whose `verdict` is `UNDECIDED` with the forces of their parents, where those are `known`.

    Arrays as in `solve_range`, other arguments as for `repair_state`.

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
            beside = states[i], parents[i], reach, interior
            verdict[i], residual[i], taken = repair_state(structure, *beside, options, work, near, forces[i])
            iterations[i] += taken
        left += verdict[i] == UNDECIDED
    return left
