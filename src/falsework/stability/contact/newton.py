"""Pseudo-transient Newton iteration for the displacement at which contact forces balance the load.

The method is that of Kelley and Keyes (1998). Each iteration is a linearly implicit Euler step of `du/dt = r(u)`, the
motion of the structure in a viscous medium, with `r` the unbalanced wrenches. The time step grows as
the residual falls, so the method becomes Newton's where there is an equilibrium, and follows the moving parts
where there is none. Velocities, displacements and wrenches are whitened by the masses as in `Problem`.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.hold_kernel import LOCKED, along_line, resist_across
from falsework.stability.contact.law import contact_force, gauge
from falsework.stability.contact.tangent import assemble_tangent
from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.layout import FAST, add_force, add_pair_wrench, copy_rows, pair_velocity, point_velocity
from falsework.stability.cpu.panels import RIDGE, factor_panels, solve_panels
from falsework.stability.cpu.termination import largest_residual
from falsework.stability.stiffness import SETTLEMENTS
from falsework.stability.strength import TEARS
from falsework.utils.kernels import njit

RESTS, MOVES_AWAY, OPEN, OVERLOADS = 1, -1, 0, -2
"""Results: at rest, parts move away, undecided, and in replays that a robot bears more than it can."""

_CUT = 0.1
"""Smallest share of a step that is taken before the time step is reduced instead, by this factor."""
_TEARS = (TEARS + 1.0) / 2.0
"""A contact point breaks at this multiple of its tensile strength, within the rounding that the checker allows."""
_BONDED_STEPS = 3
"""Iterations in which a structure with tensile joints is tried as bonded."""
_FAR = 10.0
"""Multiple of the displacement limit at which iterations end: on the way to rest they may overshoot."""


@njit(fastmath=FAST, cache=True)
def evaluate(law, contact, pairs, displacement, trial, out):
    """Write the residual `load + G f(displacement)` and the elastic trial forces; return the residual's norm."""
    structure, work = law.structure, contact.work
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
            a0, a1, a2, a3, a4, a5 = add_force(basis, j, f0, f1, f2, a0, a1, a2, a3, a4, a5)
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
def close_gap(contact, pairs):
    """Restore the strength of all acting points."""
    work, pull, stick = contact.work, contact.pull, contact.stick
    for j in range(work.start[pairs]):
        pull[j], stick[j] = work.pull[j], work.stick[j]


@njit(cache=True)
def open_contact(contact, pairs, mends):
    """Break the points whose springs exceed their tensile strength; return whether anything changed.

    With `mends`, broken points whose springs pull less are restored, so that the displacement alone decides which are.
    """
    work, pull, stick, trial = contact.work, contact.pull, contact.stick, contact.trial
    whole, sticky, tears, changed = work.pull, work.stick, work.tears, False
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
def largest_movement(law, work, displacement):
    """Return the largest movement of a part, m, as `movement_of`."""
    free, order, turn = work.free, law.structure.elimination.order, law.structure.acceleration
    worst = 0.0
    for j in range(len(free)):
        if free[j]:
            part = order[j]
            for r in range(6):
                total = 0.0
                for c in range(6):
                    total += turn[part, r, c] * displacement[j, c]
                worst = max(worst, abs(total) * (1.0 if r < 3 else law.reach[part]))
    return worst * law.scale


@njit(cache=True)
def moves_far(law, contact, pairs, moved):
    """Return whether a movement in m exceeds the limit at the trial forces of a state, as `movement_limit`."""
    if moved <= law.limit:
        return False
    work, settles = contact.work, 0.0
    for j in range(work.start[pairs]):
        settles = max(settles, contact.trial[j, 0] / (contact.normal[j] * work.force_scale[j]))
    return moved > SETTLEMENTS * settles * law.scale


@njit(fastmath=FAST, cache=True)
def _switches(cone, contact, pairs):
    """Return whether a contact point opens, closes, begins to slide or ceases to between two sets of trial forces."""
    work, now, ahead = contact.work, contact.trial, contact.next_trial
    for j in range(work.start[pairs]):
        mu, pull, stick = work.friction[j], contact.pull[j], contact.stick[j]
        n, m = now[j, 0] + pull, ahead[j, 0] + pull
        slides = gauge(cone, now[j, 1], now[j, 2]) > mu * max(n, 0.0) + stick
        if (n > 0.0) != (m > 0.0) or slides != (gauge(cone, ahead[j, 1], ahead[j, 2]) > mu * max(m, 0.0) + stick):
            return True
    return False


@njit(cache=True)
def _at_rest(law, contact, pairs):
    """Return `RESTS`, or `MOVES_AWAY` where parts came to rest only beyond the displacement limit."""
    moved = largest_movement(law, contact.work, contact.displacement)
    return MOVES_AWAY if moves_far(law, contact, pairs, moved) else RESTS


@njit(fastmath=FAST, cache=True)
def equilibrate(law, contact, pairs, steps, tolerance, first_step, schedule):
    """Iterate from `contact.displacement` until the parts come to rest, move away, or the steps are used up.

    Args:
        law, contact, pairs: `ContactArrays`, and a state prepared by `restrict` and `place_contacts`.
        steps: limit on iterations.
        tolerance: largest residual of a state at rest, as `largest_residual`.
        first_step: first time step.
        schedule: `StepSchedule`.

    Returns:
        `RESTS`, `MOVES_AWAY` or `OPEN`; residual; iterations. Displacement and spring forces are in `contact`.
    """
    structure, work = law.structure, contact.work
    free, panels, symmetric = work.free, work.panels, pairs < 0  # not a literal, for which numba would compile anew
    now, ahead, step = contact.displacement, contact.next_displacement, contact.step
    residual, next_residual = contact.residual, contact.next_residual
    size = evaluate(law, contact, pairs, now, contact.trial, residual)
    worst = largest_residual(structure, work, residual)
    time, before = first_step, 0.0
    for iteration in range(steps):
        if worst <= tolerance:
            return _at_rest(law, contact, pairs), worst, iteration
        if iteration == 0:
            lay_out_panels(structure, free, panels)
        assemble_tangent(law, contact, pairs, 1.0 / time)
        if not factor_panels(structure.elimination.supernode, panels, symmetric):
            time *= _CUT
            continue
        copy_rows(free, residual, step)
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
            next_size = evaluate(law, contact, pairs, ahead, contact.next_trial, next_residual)
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
            late = iteration >= schedule.patience and _switches(structure.cone, contact, pairs)
            least = schedule.late_growth if late else schedule.growth
            if next_size > size:
                least = min(least, schedule.growth_after_rise)
            time = min(time * max(least, size / max(next_size, 1e-300)), 1.0 / RIDGE)
        else:
            time *= 2.0 * length
        before, size = size, next_size
        copy_rows(free, ahead, now)
        copy_rows(free, next_residual, residual)
        for j in range(work.start[pairs]):
            for k in range(3):
                contact.trial[j, k] = contact.next_trial[j, k]
        worst = largest_residual(structure, work, residual)
        moved = largest_movement(law, work, now)
        if moves_far(law, contact, pairs, moved / _FAR):
            return MOVES_AWAY, worst, iteration + 1
    if worst <= tolerance:
        return _at_rest(law, contact, pairs), worst, steps
    return OPEN, worst, steps


@njit(cache=True)
def solve_statics(law, contact, pairs, steps, tolerance, first_step, mends, schedule):
    """Find a rest position as `equilibrate` does, at which no contact point exceeds its tensile strength.

    Points that exceed it are broken and bear nothing, and the search continues from there. With `mends`, those that
    close again are restored, as in the law without history; if that does not terminate within the steps, the state is
    left undecided.
    """
    close_gap(contact, pairs)
    spent = 0
    if contact.work.pulled[0] > 0.0:
        # Tensile joints mostly keep everything in place: the elastic solution, in one or two Newton steps.
        begin = contact.displacement.copy()
        result, residual, spent = equilibrate(law, contact, pairs, _BONDED_STEPS, tolerance, 1.0 / RIDGE, schedule)
        if result == RESTS and not open_contact(contact, pairs, mends):
            return result, residual, spent
        close_gap(contact, pairs)
        for j in range(len(begin)):  # entry by entry: array assignment would compile error messages
            for r in range(6):
                contact.displacement[j, r] = begin[j, r]
    result, residual, taken = equilibrate(law, contact, pairs, steps, tolerance, first_step, schedule)
    spent += taken
    rounds = 0
    while result == RESTS and open_contact(contact, pairs, mends):
        rounds += 1
        if mends and max(rounds, spent) > steps:
            return OPEN, residual, spent
        result, residual, taken = equilibrate(law, contact, pairs, steps, tolerance, first_step, schedule)
        spent += taken
    return result, residual, spent
