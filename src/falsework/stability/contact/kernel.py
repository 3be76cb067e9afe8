"""Compiled verdict under `contact` for one state and for a range of states, without the GIL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from falsework.assembly.model import Assembly
from falsework.stability.contact.law import contact_force
from falsework.stability.contact.newton import (
    MOVES_AWAY,
    RESTS,
    VERDICT_SCHEDULE,
    ContactArrays,
    StepSchedule,
    close_gap,
    equilibrate,
    make_contact_scratch,
    solve_statics,
)
from falsework.stability.cpu.layout import make_scratch, pair_velocity, point_velocity, restrict, set_gravity
from falsework.stability.cpu.neighbourhood import RINGS, freeze_outside_ball
from falsework.stability.cpu.products import LANES, ROWS
from falsework.stability.cpu.termination import MARGIN, STABLE, UNDECIDED
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, HoldSettings, limits_of
from falsework.stability.problem import Problem
from falsework.stability.stiffness import MOVEMENT, TANGENTIAL_RATIO, normal_stiffness, structure_size
from falsework.utils.kernels import njit

NEAR_RINGS = RINGS[-1]
"""Distance from a changed part, in contacts, within which parts settle first; smaller where that is half of all."""


class ContactOptions(NamedTuple):
    """Numerical options of the kernel."""

    tolerance: float
    """Largest residual of a state at rest."""
    steps: int
    """Limit on Newton iterations from rest."""
    warm_steps: int
    """The same from the displacement of a parent."""
    near_steps: int
    """The same for the parts near a change, while the others are fixed."""
    first_step: float
    """First time step from rest."""
    warm_first_step: float
    """The same from the displacement of a parent."""
    schedule: StepSchedule = VERDICT_SCHEDULE
    """Rules by which the time step grows."""


def build_contact_structure(
    assembly: Assembly,
    problem: Problem,
    gravity: float,
    ratio: float = TANGENTIAL_RATIO,
    holds: HoldSettings = HoldSettings(),
) -> ContactArrays:
    """Lay out the stiffness of a structure for the kernel.

    Args:
        assembly: the structure.
        problem: its scaled equilibrium problem.
        gravity: m/s2.
        ratio: ratio of tangential to normal stiffness.
        holds: stiffness and limits of the holds of robots.
    """
    stiffness = normal_stiffness(assembly, gravity) / problem.force_scale**2
    scale = 1.0 / float(np.median(stiffness)) if len(stiffness) else 1.0
    wider = ((0, 0), (0, 0), (0, LANES - ROWS))
    mass, limits = assembly.mass.mass, limits_of(assembly, holds, gravity)
    stiff = holds.stiffness
    pressing = min(stiff, PRESS_STIFFNESS) / mass * scale
    return ContactArrays(
        normal=stiffness * scale,
        tangential=ratio * stiffness * scale,
        turned_a=np.array(np.pad(problem.transfer_a.transpose(0, 2, 1), wider), order="C"),
        turned_b=np.array(np.pad(problem.transfer_b.transpose(0, 2, 1), wider), order="C"),
        rows=np.array(np.pad(problem.basis.transpose(0, 2, 1), wider), order="C"),
        scale=scale,
        reach=assembly.mass.gyration,
        limit=MOVEMENT * structure_size(assembly),
        grip=np.zeros(len(mass)) if np.isinf(stiff) else stiff / mass * scale,
        press_grip=pressing,
        force_limit=limits.force / np.sqrt(mass),
        moment_limit=limits.moment,
        hybrid=holds.mode is HoldMode.HYBRID,
    )


@njit(cache=True)
def place_contacts(structure, contact_structure, state, work, contact, pairs):
    """Copy stiffness and gravity into the compact order of a state, without history."""
    normal, tangential = contact_structure.normal, contact_structure.tangential
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            contact.normal[j] = normal[j + shift]
            contact.tangential[j] = tangential[j + shift]
            for k in range(3):
                contact.offset[j, k] = 0.0
    close_gap(work, contact, pairs)
    set_gravity(structure, state, contact.load)


@njit(cache=True)
def read_displacement(structure, contact_structure, work, displacement, out):
    """Whiten a displacement in m and rad of shape (parts, 6); zero for parts that cannot move."""
    order, factor = structure.elimination.order, structure.momentum
    for j in range(len(work.free)):
        for r in range(6):
            out[j, r] = 0.0
        if work.free[j]:
            part = order[j]
            for r in range(6):
                for c in range(6):
                    out[j, r] += factor[part, c, r] * displacement[part, c]
                out[j, r] /= contact_structure.scale


@njit(cache=True)
def write_displacement(structure, contact_structure, work, whitened, out):
    """Write the displacement in m and rad of the parts that can move; other rows of (parts, 6) are kept."""
    order, turn = structure.elimination.order, structure.acceleration
    for j in range(len(work.free)):
        if work.free[j]:
            part = order[j]
            for r in range(6):
                out[part, r] = 0.0
                for c in range(6):
                    out[part, r] += turn[part, r, c] * whitened[j, c]
                out[part, r] *= contact_structure.scale


@njit(cache=True)
def write_forces(structure, work, contact, pairs, out):
    """Write contact forces in N, shape (points, 3), from the spring forces of a state."""
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
def lacks_contact(work, contact, pairs):
    """Return whether a part that can move, and that no robot holds, has no contact with a present part."""
    touched = contact.grip > 0.0
    for p in range(pairs):
        if work.slot_a[p] >= 0:
            touched[work.slot_a[p]] = True
        if work.slot_b[p] >= 0:
            touched[work.slot_b[p]] = True
    return np.any(work.free & ~touched)


@njit(cache=True)
def move_far_parts(structure, state, near, work, contact, pairs, displacement):
    """Load the springs between the parts that move in `near` and those that move in `state` only, by these.

    Args:
        structure, work, contact, pairs: as in `equilibrate`, of the state `near`.
        state, near: shape (parts,).
        displacement: whitened, of all parts, shape (n, 6).
    """
    position, parts = structure.elimination.position, structure.pair_parts
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
def settle_near(
    structure, contact_structure, state, parent, options, tolerance, work, contact, near, moved, displacement
):
    """Move the parts near the difference of a state from its parent to rest, while the others are fixed.

    Forces change most there, and the matrix of the whole structure is not factored. Improves `displacement`, in m and
    rad, shape (parts, 6), even where the parts do not reach rest; `near` (parts,) and `moved` (n, 6) are scratch.

    Returns:
        Number of iterations.
    """
    rings, kept, free = NEAR_RINGS + 1, 1, 0
    while 2 * kept > free and rings > 0:
        rings -= 1
        kept, free = freeze_outside_ball(structure, state, parent, rings, near)
    if kept == 0 or rings == 0:
        return 0
    pairs, _ = restrict(structure, state, work)
    read_displacement(structure, contact_structure, work, displacement, moved)
    order = structure.elimination.order
    for j in range(len(order)):
        if near[order[j]] == 1:
            for r in range(6):
                moved[j, r] = 0.0
    pairs, _ = restrict(structure, near, work)
    place_contacts(structure, contact_structure, near, work, contact, pairs)
    move_far_parts(structure, state, near, work, contact, pairs, moved)
    read_displacement(structure, contact_structure, work, displacement, contact.displacement)
    result, _, spent = equilibrate(
        structure,
        contact_structure,
        work,
        contact,
        pairs,
        options.near_steps,
        tolerance,
        options.first_step,
        VERDICT_SCHEDULE,
    )
    if result != MOVES_AWAY:
        write_displacement(structure, contact_structure, work, contact.displacement, displacement)
    return spent


@njit(cache=True)
def solve_contact_state(structure, contact_structure, state, options, work, contact, displacement, forces, warm):
    """Search for a displacement at which a state is in equilibrium.

    Args:
        structure, contact_structure, options, work, contact: `KernelArrays`, `ContactArrays`, `ContactOptions`,
            `Scratch` and `ContactScratch`.
        state: shape (parts,).
        displacement: in: a guess in m and rad where `warm`; out: the displacement. Shape (parts, 6).
        forces: out: contact forces in N, shape (points, 3) or (0, 3).
        warm: whether to start from the guess; else the structure is loaded from rest.

    Returns:
        `RESTS`, `MOVES_AWAY` or `OPEN`; the residual; iterations.
    """
    pairs, count = restrict(structure, state, work)
    if count == 0:
        displacement[:] = 0.0
        forces[:] = 0.0
        return RESTS, 0.0, 0
    if lacks_contact(work, contact, pairs):
        displacement[:] = 0.0
        forces[:] = 0.0
        return MOVES_AWAY, np.inf, 0
    place_contacts(structure, contact_structure, state, work, contact, pairs)
    tolerance, steps, first_step = (1.0 - MARGIN) * options.tolerance, options.steps, options.first_step
    if warm:
        read_displacement(structure, contact_structure, work, displacement, contact.displacement)
        steps, first_step = options.warm_steps, options.warm_first_step
    else:
        contact.displacement[:] = 0.0
    result, residual, spent = solve_statics(
        structure, contact_structure, work, contact, pairs, steps, tolerance, first_step, count > 0, options.schedule
    )
    displacement[:] = 0.0
    write_displacement(structure, contact_structure, work, contact.displacement, displacement)
    if len(forces):
        write_forces(structure, work, contact, pairs, forces)
    return result, residual, spent


@njit(nogil=True, cache=True)
def rest_range(
    structure, contact_structure, states, parents, options, displacement, forces, warm, verdict, residual, steps, found
):
    """Search for rest positions of states whose `verdict` is `UNDECIDED`; arrays as in `solve_contact_state`, batched.

    States at rest become `STABLE`. `forces` may be empty; `parents` is read where `warm`; `found` is `RESTS`,
    `MOVES_AWAY` or `OPEN`, and iterations are added to `iterations`.

    Returns:
        Number of states left undecided.
    """
    nothing = np.zeros((0, 3))
    work, contact = make_scratch(structure), make_contact_scratch(structure)
    near, moved = np.empty(states.shape[1], np.uint8), np.zeros((len(structure.elimination.order), 6))
    tolerance = (1.0 - MARGIN) * options.tolerance
    count = 0
    for i in range(len(states)):
        if verdict[i] != UNDECIDED:
            continue
        force = forces[i] if len(forces) else nothing
        if warm[i]:
            steps[i] += settle_near(
                structure,
                contact_structure,
                states[i],
                parents[i],
                options,
                tolerance,
                work,
                contact,
                near,
                moved,
                displacement[i],
            )
        result, left, taken = solve_contact_state(
            structure, contact_structure, states[i], options, work, contact, displacement[i], force, warm[i]
        )
        found[i] = result
        steps[i] += taken
        if result == RESTS:
            verdict[i], residual[i] = STABLE, left
        else:
            count += 1
    return count
