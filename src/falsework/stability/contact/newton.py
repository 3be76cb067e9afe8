"""Pseudo-transient Newton iteration for the displacement at which contact forces balance the load.

The method is that of Kelley and Keyes (1998). Each iteration is a linearly implicit Euler step of `du/dt = r(u)`, the
motion of the structure in a viscous medium, with `r` the unbalanced wrenches. The time step grows as
the residual falls, so the method becomes Newton's where there is an equilibrium, and follows the moving parts
where there is none. Velocities, displacements and wrenches are whitened by the masses as in `Problem`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.stability.contact.hybrid_kernel import LOCKED, along_line, resist_across
from falsework.stability.contact.law import contact_force
from falsework.stability.contact.tangent import assemble_tangent
from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.layout import FAST, add_pair_wrench, pair_velocity, point_velocity
from falsework.stability.cpu.panels import RIDGE, factor_panels, solve_panels
from falsework.stability.stiffness import SETTLEMENTS
from falsework.stability.strength import TEARS
from falsework.utils.kernels import njit

RESTS, MOVES_AWAY, OPEN, OVERLOADS = 1, -1, 0, -2
"""Results: at rest, parts move away, undecided, and in replays that a robot bears more than it can."""

FIRST_STEP = 30.0
"""First time step, in units in which the median contact stiffness is 1: longer means lower viscosity. With much longer
steps iterations may jump to an equilibrium that parts would not reach as they settle into their contacts."""
WARM_FIRST_STEP = 1e4
"""The same from the displacement of a parent, which is closer to the solution."""
_GROWTH = 4.0
"""Least growth of the time step after a full step; it grows by the decrease of the residual where that is more."""
_PATIENCE = 60
"""Iterations after which the least growth is `StepSchedule.late_growth`."""
_CUT = 0.1
"""Smallest share of a step that is taken before the time step is reduced instead, by this factor."""
_TEARS = (TEARS + 1.0) / 2.0
"""A contact point breaks at this multiple of its tensile strength, within the rounding that the checker allows."""
_BONDED_STEPS = 3
"""Iterations in which a structure with tensile joints is tried as bonded."""
_FAR = 10.0
"""Multiple of the displacement limit at which iterations end: on the way to rest they may overshoot."""


class StepSchedule(NamedTuple):
    """Rules by which the time step grows and steps are accepted."""

    late_growth: float
    """Least growth of the time step after a full step, after `_PATIENCE` iterations."""
    growth_after_rise: float
    """Largest of the least growth where a full step raised the residual."""
    memory: float
    """Share of the last but one residual up to which a step may raise the residual."""


VERDICT_SCHEDULE = StepSchedule(late_growth=1.2, growth_after_rise=_GROWTH, memory=0.0)
"""StepSchedule of verdicts and replays: contacts that alternate between sliding and sticking need shorter steps."""


class ContactArrays(NamedTuple):
    """Arrays that the criterion adds to `KernelArrays`: scaled stiffness, and units of displacement."""

    normal: NDArray[np.float64]
    """Normal stiffness of each contact point in scaled variables, median 1, shape (points,)."""
    tangential: NDArray[np.float64]
    turned_a: NDArray[np.float64]
    """Transposes of `Problem.transfer_a`, with rows of eight numbers, shape (pairs, 6, 8)."""
    turned_b: NDArray[np.float64]
    rows: NDArray[np.float64]
    """Transposes of `Problem.basis`, shape (points, 3, 8)."""
    scale: float
    """Metres (or radians) of displacement per scaled unit."""
    reach: NDArray[np.float64]
    """Radius of gyration of each part, m: converts rotations to movements, shape (parts,)."""
    limit: float
    """Movement of a part up to which a structure never counts as collapsing, m."""
    grip: NDArray[np.float64]
    """Scaled stiffness of a robot's hold on each part, zero where holds are rigid, shape (parts,). The stiffness of a
    hold is a multiple of the mass matrix of its part, so one number is enough."""
    press_grip: NDArray[np.float64]
    """The same of a robot that presses, which is compliant; never zero."""
    force_limit: NDArray[np.float64]
    """Largest whitened force of a robot on each part, shape (parts,)."""
    moment_limit: NDArray[np.float64]
    """Largest moment of a robot on each part about its centre of mass, N m, shape (parts,)."""
    hybrid: bool
    """Whether robots that press control the force along one direction only, and the position across it."""


class ContactScratch(NamedTuple):
    """Scratch memory of one thread, in addition to `Scratch`; points in the compact order of the current state."""

    normal: NDArray[np.float64]
    """Scaled stiffness of the acting points, shape (points,)."""
    tangential: NDArray[np.float64]
    pull: NDArray[np.float64]
    """Scaled tensile strength of the acting points, zero where they are broken, shape (points,)."""
    stick: NDArray[np.float64]
    offset: NDArray[np.float64]
    """Spring forces at zero displacement: the history in a replay, shape (points, 3)."""
    trial: NDArray[np.float64]
    """Elastic trial forces of the springs, shape (points, 3)."""
    next_trial: NDArray[np.float64]
    tangent: NDArray[np.float64]
    """Tangent stiffness of the points of one pair, shape (points, 9)."""
    load: NDArray[np.float64]
    """Whitened external wrenches on the parts, shape (n, 6)."""
    displacement: NDArray[np.float64]
    """Shape (n, 6), whitened and scaled."""
    next_displacement: NDArray[np.float64]
    residual: NDArray[np.float64]
    next_residual: NDArray[np.float64]
    step: NDArray[np.float64]
    grip: NDArray[np.float64]
    """Scaled stiffness of the hold on each part, zero for parts that nothing holds, shape (n,)."""
    across: NDArray[np.float64]
    """Scaled stiffness across `line` of a hold that controls the force along it; `LOCKED` where the part may not move
    across it; zero for other parts, shape (n,)."""
    line: NDArray[np.float64]
    """Direction of the force of such a hold, a unit vector, shape (n, 3)."""


@njit(cache=True)
def make_contact_scratch(structure):
    """Return scratch large enough for every state of a structure."""
    n, points = len(structure.elimination.order), len(structure.basis)
    return ContactScratch(
        np.zeros(points),
        np.zeros(points),
        np.zeros(points),
        np.zeros(points),
        np.zeros((points, 3)),
        np.zeros((points, 3)),
        np.zeros((points, 3)),
        np.zeros((points, 9)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros(n),
        np.zeros(n),
        np.zeros((n, 3)),
    )


@njit(fastmath=FAST, cache=True)
def evaluate(structure, work, contact, pairs, displacement, trial, out):
    """Write the residual `load + G f(displacement)` and the elastic trial forces; return the residual's norm."""
    basis, start, pair, slot_a, slot_b = work.basis, work.start, work.pair, work.slot_a, work.slot_b
    ta, tb, cone, mu = structure.transfer_a, structure.transfer_b, structure.cone, work.friction
    pull, stick = contact.pull, contact.stick
    kn, kt, offset, load, free = contact.normal, contact.tangential, contact.offset, contact.load, work.free
    grip = contact.grip
    for j in range(len(free)):
        if free[j]:
            for r in range(6):
                out[j, r] = load[j, r] - grip[j] * displacement[j, r]
    for p in range(pairs):
        q, a, b = pair[p], slot_a[p], slot_b[p]
        s0, s1, s2, s3, s4, s5 = pair_velocity(ta, tb, q, a, b, displacement)
        a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(start[p], start[p + 1]):
            d0, d1, d2 = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)
            t0, t1, t2 = offset[j, 0] - kn[j] * d0, offset[j, 1] - kt[j] * d1, offset[j, 2] - kt[j] * d2
            trial[j, 0], trial[j, 1], trial[j, 2] = t0, t1, t2
            f0, f1, f2 = contact_force(cone, mu[j], pull[j], stick[j], t0, t1, t2)
            a0 += basis[j, 0, 0] * f0 + basis[j, 0, 1] * f1 + basis[j, 0, 2] * f2
            a1 += basis[j, 1, 0] * f0 + basis[j, 1, 1] * f1 + basis[j, 1, 2] * f2
            a2 += basis[j, 2, 0] * f0 + basis[j, 2, 1] * f1 + basis[j, 2, 2] * f2
            a3 += basis[j, 3, 0] * f0 + basis[j, 3, 1] * f1 + basis[j, 3, 2] * f2
            a4 += basis[j, 4, 0] * f0 + basis[j, 4, 1] * f1 + basis[j, 4, 2] * f2
            a5 += basis[j, 5, 0] * f0 + basis[j, 5, 1] * f1 + basis[j, 5, 2] * f2
        add_pair_wrench(ta, tb, q, a, b, a0, a1, a2, a3, a4, a5, out)
    total = 0.0
    for j in range(len(free)):
        if free[j]:
            if contact.across[j] != 0.0:
                resist_across(contact, j, displacement, out)
            for r in range(6):
                total += out[j, r] * out[j, r]
    return np.sqrt(total)


@njit(cache=True)
def close_gap(work, contact, pairs):
    """Restore the strength of all acting points."""
    whole, sticky, pull, stick = work.pull, work.stick, contact.pull, contact.stick
    for j in range(work.start[pairs]):
        pull[j], stick[j] = whole[j], sticky[j]


@njit(cache=True)
def open_contact(work, contact, pairs, mends):
    """Break the points whose springs exceed their tensile strength; return whether anything changed.

    With `mends`, broken points whose springs pull less are restored, so that the displacement alone decides which are.
    """
    whole, sticky, pull, stick, trial = work.pull, work.stick, contact.pull, contact.stick, contact.trial
    tears, changed = work.tears, False
    for j in range(work.start[pairs]):
        if not tears[j] or whole[j] + sticky[j] <= 0.0:
            continue
        torn = pull[j] + stick[j] == 0.0
        if trial[j, 0] < -_TEARS * whole[j]:
            if not torn:
                pull[j], stick[j] = 0.0, 0.0
                changed = True
        elif torn and mends:
            pull[j], stick[j] = whole[j], sticky[j]
            changed = True
    return changed


@njit(fastmath=FAST, cache=True)
def largest_residual(structure, work, wrench):
    """Return the residual of whitened wrenches: the largest acceleration that they cause, scaled by `measure`."""
    free, order = work.free, structure.elimination.order
    turn, measure = structure.acceleration, structure.measure
    worst = 0.0
    for j in range(len(free)):
        if free[j]:
            part = order[j]
            for r in range(6):
                total = 0.0
                for c in range(6):
                    total += turn[part, r, c] * wrench[j, c]
                worst = max(worst, abs(total) * measure[part, r // 3])
    return worst


@njit(fastmath=FAST, cache=True)
def largest_movement(structure, contact_structure, work, displacement):
    """Return the largest movement of a part, m.

    The movement of a part is that of its centre, or of a point one radius of gyration away by its rotation.
    """
    free, order, turn = work.free, structure.elimination.order, structure.acceleration
    worst = 0.0
    for j in range(len(free)):
        if free[j]:
            part = order[j]
            for r in range(6):
                total = 0.0
                for c in range(6):
                    total += turn[part, r, c] * displacement[j, c]
                worst = max(worst, abs(total) * (1.0 if r < 3 else contact_structure.reach[part]))
    return worst * contact_structure.scale


@njit(cache=True)
def moves_far(contact_structure, work, contact, pairs, moved):
    """Return whether a movement in m exceeds the limit at the trial forces of a state, as `movement_limit`."""
    if moved <= contact_structure.limit:
        return False
    settles = 0.0
    for j in range(work.start[pairs]):
        settles = max(settles, contact.trial[j, 0] / (contact.normal[j] * work.force_scale[j]))
    return moved > SETTLEMENTS * settles * contact_structure.scale


@njit(cache=True)
def _at_rest(structure, contact_structure, work, contact, pairs, displacement):
    """Return `RESTS`, or `MOVES_AWAY` where parts came to rest only beyond the displacement limit."""
    moved = largest_movement(structure, contact_structure, work, displacement)
    return MOVES_AWAY if moves_far(contact_structure, work, contact, pairs, moved) else RESTS


@njit(fastmath=FAST, cache=True)
def equilibrate(structure, contact_structure, work, contact, pairs, steps, tolerance, first_step, schedule):
    """Iterate from `contact.displacement` until the parts come to rest, move away, or the steps are used up.

    Args:
        structure, contact_structure, work, contact, pairs: a state prepared by `restrict` and `place_contacts`.
        steps: limit on iterations.
        tolerance: largest residual of a state at rest, as `largest_residual`.
        first_step: first time step.
        schedule: `StepSchedule`.

    Returns:
        `RESTS`, `MOVES_AWAY` or `OPEN`; residual; iterations. Displacement and spring forces are in `contact`.
    """
    free, panels, symmetric = work.free, work.panels, pairs < 0  # not a literal, for which numba would compile anew
    now, ahead, step = contact.displacement, contact.next_displacement, contact.step
    residual, next_residual = contact.residual, contact.next_residual
    size = evaluate(structure, work, contact, pairs, now, contact.trial, residual)
    worst = largest_residual(structure, work, residual)
    time, before = first_step, 0.0
    for iteration in range(steps):
        if worst <= tolerance:
            return _at_rest(structure, contact_structure, work, contact, pairs, now), worst, iteration
        if iteration == 0:
            lay_out_panels(structure, free, panels)
        assemble_tangent(structure, contact_structure, work, contact, pairs, 1.0 / time)
        if not factor_panels(structure.elimination.supernode, panels, symmetric):
            time *= _CUT
            continue
        for j in range(len(free)):
            if free[j]:
                for r in range(6):
                    step[j, r] = residual[j, r]
        solve_panels(panels, step, False)
        for j in range(len(free)):
            if free[j] and contact.across[j] == LOCKED:
                along_line(contact, j, step)
        length, limit = 1.0, max(size, schedule.memory * before)
        while True:
            for j in range(len(free)):
                if free[j]:
                    for r in range(6):
                        ahead[j, r] = now[j, r] + length * step[j, r]
            next_size = evaluate(structure, work, contact, pairs, ahead, contact.next_trial, next_residual)
            implicit = 0.0  # residual of the implicit Euler step
            for j in range(len(free)):
                if free[j]:
                    for r in range(6):
                        defect = next_residual[j, r] - length * step[j, r] / time
                        implicit += defect * defect
            if min(np.sqrt(implicit), next_size) <= limit:
                break
            length *= 0.5
            if length < _CUT:
                break
        if length < _CUT or not next_size < np.inf:
            time *= _CUT
            continue
        if length == 1.0:
            least = _GROWTH if iteration < _PATIENCE else schedule.late_growth
            if next_size > size:
                least = min(least, schedule.growth_after_rise)
            time = min(time * max(least, size / max(next_size, 1e-300)), 1.0 / RIDGE)
        else:
            time *= 2.0 * length
        before, size = size, next_size
        for j in range(len(free)):
            if free[j]:
                for r in range(6):
                    now[j, r], residual[j, r] = ahead[j, r], next_residual[j, r]
        for j in range(work.start[pairs]):
            for k in range(3):
                contact.trial[j, k] = contact.next_trial[j, k]
        worst = largest_residual(structure, work, residual)
        moved = largest_movement(structure, contact_structure, work, now)
        if moves_far(contact_structure, work, contact, pairs, moved / _FAR):
            return MOVES_AWAY, worst, iteration + 1
    if worst <= tolerance:
        return _at_rest(structure, contact_structure, work, contact, pairs, now), worst, steps
    return OPEN, worst, steps


@njit(cache=True)
def solve_statics(structure, contact_structure, work, contact, pairs, steps, tolerance, first_step, mends, schedule):
    """Find a rest position as `equilibrate` does, at which no contact point exceeds its tensile strength.

    Points that exceed it are broken and bear nothing, and the search continues from there. With `mends`, those that
    close again are restored, as in the law without history; if that does not terminate within the steps, the state is
    left undecided.
    """
    close_gap(work, contact, pairs)
    spent = 0
    if work.pulled[0] > 0.0:
        # Tensile joints mostly keep everything in place: the elastic solution, in one or two Newton steps.
        begin = contact.displacement.copy()
        result, residual, spent = equilibrate(
            structure, contact_structure, work, contact, pairs, _BONDED_STEPS, tolerance, 1.0 / RIDGE, schedule
        )
        if result == RESTS and not open_contact(work, contact, pairs, mends):
            return result, residual, spent
        close_gap(work, contact, pairs)
        for j in range(len(begin)):  # entry by entry: array assignment would compile error messages
            for r in range(6):
                contact.displacement[j, r] = begin[j, r]
    result, residual, taken = equilibrate(
        structure, contact_structure, work, contact, pairs, steps, tolerance, first_step, schedule
    )
    spent += taken
    rounds = 0
    while result == RESTS and open_contact(work, contact, pairs, mends):
        rounds += 1
        if mends and max(rounds, spent) > steps:
            return OPEN, residual, spent
        result, residual, taken = equilibrate(
            structure, contact_structure, work, contact, pairs, steps, tolerance, first_step, schedule
        )
        spent += taken
    return result, residual, spent
