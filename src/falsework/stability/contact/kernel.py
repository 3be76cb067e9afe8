"""Compiled verdict under `contact` on a range of states, and rest positions of one under loads, without the GIL."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.law import contact_force
from falsework.stability.contact.layout import VERDICT_SCHEDULE, make_contact_scratch
from falsework.stability.contact.newton import MOVES_AWAY, OPEN, RESTS, close_gap, equilibrate, solve_statics
from falsework.stability.cpu.kernel import solve_state
from falsework.stability.cpu.layout import pair_velocity, point_velocity, restrict, set_gravity, write_motion
from falsework.stability.cpu.neighbourhood import REACH, find_mechanism, freeze_outside_ball
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED, UNSTABLE
from falsework.stability.verdict import Verdict
from falsework.utils.kernels import njit

SLIDES = int(Verdict.SLIDES)


@njit(cache=True)
def place_contacts(law, state, contact, pairs):
    """Copy stiffness and gravity into the compact order of a state that `restrict` has prepared, without history."""
    work = contact.work
    for p in range(pairs):
        shift = law.structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            contact.normal[j], contact.tangential[j] = law.normal[j + shift], law.tangential[j + shift]
            for k in range(3):
                contact.offset[j, k] = 0.0
    close_gap(contact, pairs)
    set_gravity(law.structure, state, contact.load)


@njit(cache=True)
def read_displacement(law, work, displacement, out):
    """Whiten a displacement in m and rad of shape (parts, 6); zero for parts that cannot move."""
    order, factor = law.structure.elimination.order, law.structure.momentum
    for j in range(len(work.free)):
        for r in range(6):
            out[j, r] = 0.0
        if work.free[j]:
            part = order[j]
            for r in range(6):
                for c in range(6):
                    out[j, r] += factor[part, c, r] * displacement[part, c]
                out[j, r] /= law.scale


@njit(cache=True)
def write_forces(structure, contact, pairs, out):
    """Write contact forces in N, shape (points, 3), from the spring forces of a state."""
    work = contact.work
    out[:] = 0.0
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            n, x, y = contact.trial[j, 0], contact.trial[j, 1], contact.trial[j, 2]
            mu, pull, stick = work.friction[j], contact.pull[j], contact.stick[j]
            f0, f1, f2 = contact_force(structure.cone, mu, pull, stick, n, x, y)
            scale = work.force_scale[j]
            out[j + shift, 0], out[j + shift, 1], out[j + shift, 2] = f0 * scale, f1 * scale, f2 * scale


@njit(cache=True)
def lacks_contact(contact, pairs):
    """Return whether a part that can move, and that no robot holds, has no contact with a present part."""
    work, touched = contact.work, contact.grip > 0.0
    for p in range(pairs):
        if work.slot_a[p] >= 0:
            touched[work.slot_a[p]] = True
        if work.slot_b[p] >= 0:
            touched[work.slot_b[p]] = True
    return np.any(work.free & ~touched)


@njit(cache=True)
def move_far_parts(structure, state, near, contact, pairs, displacement):
    """Load the springs between the parts that move in `near` and those that move in `state` only, by these.

    Args:
        structure: `KernelArrays`.
        state, near: shape (parts,).
        contact, pairs: the state `near`, prepared as for `equilibrate`.
        displacement: whitened, of all parts, shape (n, 6).
    """
    position, parts, work = structure.elimination.position, structure.pair_parts, contact.work
    ta, tb = structure.transfer_a, structure.transfer_b
    for p in range(pairs):
        q = work.pair[p]
        a, b = parts[q, 0], parts[q, 1]
        slot_a = position[a] if state[a] == 1 and near[a] != 1 else -1
        slot_b = position[b] if state[b] == 1 and near[b] != 1 else -1
        if slot_a < 0 and slot_b < 0:
            continue
        s0, s1, s2, s3, s4, s5 = pair_velocity(ta, tb, q, slot_a, slot_b, displacement)
        for j in range(work.start[p], work.start[p + 1]):
            d0, d1, d2 = point_velocity(work.basis, j, s0, s1, s2, s3, s4, s5)
            contact.offset[j, 0] -= contact.normal[j] * d0
            contact.offset[j, 1] -= contact.tangential[j] * d1
            contact.offset[j, 2] -= contact.tangential[j] * d2


@njit(cache=True)
def settle_near(law, state, parent, options, contact, displacement):
    """Move the parts near the difference of a state from its parent to rest, while the others are fixed.

    Forces change most there, and the matrix of the whole structure is not factored. Improves `displacement`, in m and
    rad, shape (parts, 6), even where the parts do not reach rest.

    Returns:
        Number of iterations.
    """
    structure, work, near = law.structure, contact.work, np.empty(len(state), np.uint8)
    rings, kept, free = REACH + 1, 1, 0
    while 2 * kept > free and rings > 0:
        rings -= 1
        kept, free = freeze_outside_ball(structure, state, parent, rings, near)
    if kept == 0 or rings == 0:
        return 0
    moved, order = np.empty((len(work.free), 6)), structure.elimination.order
    pairs, _ = restrict(structure, state, work)
    read_displacement(law, work, displacement, moved)
    for j in range(len(order)):
        if near[order[j]] == 1:
            for r in range(6):
                moved[j, r] = 0.0
    pairs, _ = restrict(structure, near, work)
    place_contacts(law, near, contact, pairs)
    move_far_parts(structure, state, near, contact, pairs, moved)
    read_displacement(law, work, displacement, contact.displacement)
    tolerance = (1.0 - MARGIN) * options.tolerance
    result, _, spent = equilibrate(
        law, contact, pairs, options.warm_steps // 2, tolerance, options.first_step, VERDICT_SCHEDULE
    )
    if result != MOVES_AWAY:
        write_motion(structure, work, contact.displacement, law.scale, displacement)
    return spent


@njit(cache=True)
def solve_contact_state(law, state, options, steps, contact, displacement, forces, warm):
    """Search for a displacement at which a state is in equilibrium.

    Args:
        law, options, contact: `ContactArrays`, `ContactOptions` and `ContactScratch`.
        state: shape (parts,).
        steps: limit on iterations.
        displacement: in: a guess in m and rad where `warm`; out: the displacement. Shape (parts, 6).
        forces: out: contact forces in N, shape (points, 3) or (0, 3).
        warm: whether to start from the guess; else the structure is loaded from rest.

    Returns:
        `RESTS`, `MOVES_AWAY` or `OPEN`; the residual; iterations.
    """
    pairs, count = restrict(law.structure, state, contact.work)
    adrift = count > 0 and lacks_contact(contact, pairs)
    if count == 0 or adrift:
        displacement[:] = 0.0
        forces[:] = 0.0
        return (MOVES_AWAY, np.inf, 0) if adrift else (RESTS, 0.0, 0)
    place_contacts(law, state, contact, pairs)
    if warm:
        read_displacement(law, contact.work, displacement, contact.displacement)
    else:
        contact.displacement[:] = 0.0
    first_step = options.warm_first_step if warm else options.first_step
    tolerance = (1.0 - MARGIN) * options.tolerance
    result, residual, spent = solve_statics(
        law, contact, pairs, steps, tolerance, first_step, count > 0, options.schedule
    )
    displacement[:] = 0.0
    write_motion(law.structure, contact.work, contact.displacement, law.scale, displacement)
    if len(forces):
        write_forces(law.structure, contact, pairs, forces)
    return result, residual, spent


@njit(nogil=True, cache=True)
def rest_range(
    law, states, parents, balance, options, more, seeks, bonded, displacement, forces, velocity, warm, verdict,
    residual, iterations,
):  # fmt: skip
    """Decide states under `contact`, one by one: the first of these attempts that ends with a proof counts.

    Where joints pull, the structure as bonded; where `seeks`, a mechanism near the difference from the parent; a rest
    position, from that of the parent where `warm`; a mechanism farther from the difference; the solver of the
    equilibrium problem; and `more` iterations from where those from the parent's position ended.

    Args:
        law, options: as in `solve_contact_state`.
        states, parents: shape (batch, parts).
        balance: `Options` of the equilibrium problem.
        more: limit on the last iterations.
        seeks: whether mechanisms are sought near the difference.
        bonded: whether joints pull.
        displacement: in: guesses where `warm`; out: where iterations ended, shape (batch, parts, 6).
        forces, velocity: out, batched, or empty.
        warm: shape (batch,).
        verdict, residual, iterations: out, one entry a state. Where parts move away though forces in equilibrium may
            exist, the residual is infinite.
    """
    nothing, none = np.zeros((0, 3)), np.zeros((0, 6))
    contact, parts, points = make_contact_scratch(law), states.shape[1], len(law.normal)
    moved, pressed = np.empty((parts, 6)), np.empty((points if len(forces) else 0, 3))
    again, no_steps = parts > 0, len(nothing)  # not literals, for which numba would recompile the search
    for i in range(len(states)):
        state, force = states[i], forces[i] if len(forces) else nothing
        motion = velocity[i] if len(velocity) else none
        if bonded:  # the first iterations of any search, which start from rest
            result, left, taken = solve_contact_state(law, state, options, no_steps, contact, moved, force, not again)
            iterations[i] += taken
            if result == RESTS:
                verdict[i], residual[i] = STABLE, left
                for p in range(parts):  # entry by entry: assigning rows to rows would compile numba's messages
                    for r in range(6):
                        displacement[i, p, r] = moved[p, r]
                continue
        if seeks:
            verdict[i], residual[i], taken = find_mechanism(
                law.structure, state, parents[i], 1, balance, contact.work, motion
            )
            iterations[i] += taken
            if verdict[i] == UNSTABLE:
                continue
        if warm[i]:
            iterations[i] += settle_near(law, state, parents[i], options, contact, displacement[i])
        steps = options.warm_steps if warm[i] else options.steps
        result, left, taken = solve_contact_state(law, state, options, steps, contact, displacement[i], force, warm[i])
        iterations[i] += taken
        if result == RESTS:
            verdict[i], residual[i] = STABLE, left
            continue
        if seeks:
            verdict[i], residual[i], taken = find_mechanism(
                law.structure, state, parents[i], REACH, balance, contact.work, motion
            )
            iterations[i] += taken
        if verdict[i] == UNDECIDED:
            verdict[i], residual[i], taken = solve_state(
                law.structure, state, balance, contact.work, force, motion, not again
            )
            iterations[i] += taken
        if warm[i] and result == OPEN and verdict[i] != UNSTABLE:
            result, left, taken = solve_contact_state(
                law, state, options, more, contact, displacement[i], pressed, again
            )
            iterations[i] += taken
            if result == RESTS:
                verdict[i], residual[i] = STABLE, left
                for j in range(len(pressed)):
                    for k in range(3):
                        force[j, k] = pressed[j, k]
        if result == OPEN and verdict[i] != UNSTABLE:
            verdict[i] = UNDECIDED
        if result == MOVES_AWAY and verdict[i] == STABLE:
            verdict[i] = SLIDES
        elif result == MOVES_AWAY and verdict[i] == UNDECIDED:
            residual[i] = np.inf


@njit(nogil=True, cache=True)
def rest_under(law, state, loads, moved, options, displacement, warm, result):
    """Search for the rest position of a state under each load; the law is that of `solve_contact_state`.

    The search ends with the first load under which none is found.

    Args:
        law, options: as in `solve_contact_state`; without iterations from rest, the result from the guesses counts.
        state: shape (parts,).
        loads: wrenches on the parts, N and Nm, shape (loads, parts, 6).
        moved: scaled spring forces of the contact points at zero displacement, caused by displaced fixed parts,
            shape (points, 3) or (0, 3).
        displacement: in: guesses in m and rad where `warm`; out: displacements, shape (loads, parts, 6).
        warm: whether `displacement` holds guesses.
        result: out: `RESTS`, `MOVES_AWAY` or `OPEN`, one entry per load.

    Returns:
        Number of loads that were tried.
    """
    contact, structure = make_contact_scratch(law), law.structure
    work, order, turn = contact.work, structure.elimination.order, structure.acceleration
    pairs, count = restrict(structure, state, work)
    adrift = count > 0 and lacks_contact(contact, pairs)
    place_contacts(law, state, contact, pairs)
    for p in range(pairs if len(moved) else 0):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            for r in range(3):
                contact.offset[j, r] = moved[j + shift, r]
    tolerance = (1.0 - MARGIN) * options.tolerance
    mends = pairs >= 0  # not a literal, for which numba would recompile the search
    for k in range(len(loads)):
        if count == 0 or adrift:
            result[k] = MOVES_AWAY if adrift else RESTS
            displacement[k] = 0.0
            if adrift:
                return k + 1
            continue
        for j in range(len(order)):
            part = order[j]
            for r in range(6):
                contact.load[j, r] = 0.0
                for c in range(6):
                    contact.load[j, r] += turn[part, c, r] * loads[k, part, c]
        for cold in range(0 if warm else 1, 2):
            if cold:
                contact.displacement[:] = 0.0
                steps, first_step = options.steps, options.first_step
            else:
                read_displacement(law, work, displacement[k], contact.displacement)
                steps, first_step = options.warm_steps, options.warm_first_step
            result[k], _, _ = solve_statics(law, contact, pairs, steps, tolerance, first_step, mends, options.schedule)
            if result[k] == RESTS or options.steps == 0:
                break
        displacement[k] = 0.0
        write_motion(structure, work, contact.displacement, law.scale, displacement[k])
        if result[k] != RESTS:
            return k + 1
    return len(loads)
