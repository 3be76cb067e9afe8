"""Compiled step of a replay: contacts with history, holds that give way and press, and gradual release by robots.

Between two steps the structure keeps the positions of its parts and the spring forces of its contact points. Parts are
inserted unstressed. When a robot releases a part, or a part is removed, the wrenches that are then missing are
transferred to the contacts in equal increments; after each, points that slid keep their friction force.

A robot that holds a part bears what balances it, and resists its movement like a spring. Where robots press, they add
given wrenches in the increments in which the part is released.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.stability.contact.hold_kernel import add_across, hold_wrench, overloaded, set_holds
from falsework.stability.contact.kernel import lacks_contact, move_far_parts, place_contacts
from falsework.stability.contact.law import contact_force
from falsework.stability.contact.layout import VERDICT_SCHEDULE, make_contact_scratch
from falsework.stability.contact.newton import (
    MOVES_AWAY,
    OPEN,
    OVERLOADS,
    RESTS,
    close_gap,
    equilibrate,
    evaluate,
    moves_far,
    solve_statics,
)
from falsework.stability.cpu.layout import restrict, write_motion
from falsework.stability.cpu.neighbourhood import REACH, freeze_outside_ball
from falsework.utils.kernels import njit

PASSING = 1e-2
"""Largest residual, a share of gravity, with which an increment passes on to the next, which takes up what is left.
Friction then differs by a tenth of what it differs between four increments and sixteen."""
_LARGEST = 4
"""No increment grows beyond one part in so many of the load: those of the default release all have that size."""


class HistoryArrays(NamedTuple):
    """What a structure keeps from step to step; changed in place."""

    displacement: NDArray[np.float64]
    """Displacement of the parts since they were placed, m and rad, shape (parts, 6)."""
    springs: NDArray[np.float64]
    """Scaled spring forces of all contact points, shape (points, 3)."""
    torn: NDArray[np.bool_]
    """Contact points whose tensile strength was exceeded, shape (points,)."""
    set_share: NDArray[np.float64]
    """Share of its full strength that each contact point has reached, shape (points,), or (0,) if all."""


@njit(cache=True)
def load_history(law, state, contact, history, missing, share):
    """Prepare a state with the spring forces of its history, under gravity minus a share of the missing wrenches.

    The part of a hold, where `contact.grip` is not zero, misses all of its wrench: that is what the robot bears.

    Returns:
        Number of acting pairs of parts, and number of parts that can move.
    """
    structure, work = law.structure, contact.work
    pairs, count = restrict(structure, state, work)
    place_contacts(law, state, contact, pairs)
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            for k in range(3):
                contact.offset[j, k] = history.springs[j + shift, k]
            if history.torn[j + shift]:
                work.pull[j], work.stick[j] = 0.0, 0.0
            elif len(history.set_share):
                work.pull[j] *= history.set_share[j + shift]
                work.stick[j] *= history.set_share[j + shift]
    close_gap(contact, pairs)
    for j in range(len(work.free)):
        if work.free[j]:
            left = 1.0 if contact.grip[j] > 0.0 else share
            for r in range(6):
                contact.load[j, r] -= left * missing[j, r]
    return pairs, count


@njit(cache=True)
def _keep_history(law, contact, pairs, history, moved):
    """Add the increment to the displacement, and store the spring forces with friction limited by the law.

    `moved`, of shape (parts, 6), is the displacement of the increment alone: written for the parts that can move.
    """
    structure, work, displacement, springs = law.structure, contact.work, history.displacement, history.springs
    write_motion(structure, work, contact.displacement, law.scale, moved)
    for part in range(len(moved)):
        for r in range(6):
            displacement[part, r] += moved[part, r]
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            n, mu, pull, stick = contact.trial[j, 0], work.friction[j], contact.pull[j], contact.stick[j]
            _, x, y = contact_force(structure.cone, mu, pull, stick, n, contact.trial[j, 1], contact.trial[j, 2])
            if work.pull[j] + work.stick[j] > pull + stick:
                history.torn[j + shift] = True
                work.pull[j], work.stick[j] = 0.0, 0.0
            springs[j + shift, 0], springs[j + shift, 1], springs[j + shift, 2] = n, x, y
            contact.offset[j, 0], contact.offset[j, 1], contact.offset[j, 2] = n, x, y
    contact.displacement[:] = 0.0


@njit(cache=True)
def place_new(structure, before, state, noise, history):
    """Initialise the parts and contacts that a step adds: parts at their planned pose, contact points without force.

    Args:
        structure, history: `KernelArrays` and `HistoryArrays`.
        before, state: shape (parts,).
        noise: tangential spring forces of new contact points, shape (points, 2).
    """
    for part in range(len(state)):
        if before[part] == 0 or state[part] == 0:
            for r in range(6):
                history.displacement[part, r] = 0.0
    springs = history.springs
    for q in range(len(structure.pair_parts)):
        a, b = structure.pair_parts[q, 0], structure.pair_parts[q, 1]
        if before[a] == 0 or before[b] == 0 or state[a] == 0 or state[b] == 0:
            for j in range(structure.pair_start[q], structure.pair_start[q + 1]):
                springs[j, 0], springs[j, 1], springs[j, 2] = 0.0, noise[j, 0], noise[j, 1]
                history.torn[j] = False


@njit(cache=True)
def lose_carriers(structure, before, state, was, history, lost):
    """Write by how much less contacts carry parts that stay held, whitened wrenches of shape (parts, 6).

    They do where a step removes a part, or where a joint that gives way has set further.

    Args:
        was: the history of the state before.
        history: the same springs with the strength that contact points have now.
    """
    sets, whole = len(history.set_share) > 0, np.empty(6)
    kept = np.minimum(before, state)
    for part in range(len(state)):
        sets = sets or (before[part] != 0 and state[part] == 0)
        for r in range(6):
            lost[part, r] = 0.0
    for part in range(len(state) if sets else 0):
        if before[part] == 2 and state[part] == 2 and structure.elimination.position[part] >= 0:
            hold_wrench(structure, before, part, was, whole)
            hold_wrench(structure, kept, part, history, lost[part])
            for r in range(6):
                lost[part, r] -= whole[r]


@njit(cache=True)
def gains_strength(structure, kept, was, history):
    """Return whether a contact point that gives way between parts that stay has set further, and so bears more.

    Args:
        kept: 0 for parts that do not stay, shape (parts,).
        was, history: as in `lose_carriers`.
    """
    for q in range(len(structure.pair_parts) if len(history.set_share) else 0):
        if kept[structure.pair_parts[q, 0]] != 0 and kept[structure.pair_parts[q, 1]] != 0:
            for j in range(structure.pair_start[q], structure.pair_start[q + 1]):
                weak = history.springs[j, 0] < -was.set_share[j] * structure.pull[j]
                if weak and not history.torn[j] and history.set_share[j] > was.set_share[j]:
                    return True
    return False


@njit(cache=True)
def settle_step(law, before, state, press_part, press_wrench, lost, options, increments, contact, history, track):
    """Move a structure with history to rest in a state.

    The parts near the change are solved first with the others fixed, since few of these move much.

    Args:
        law, options, contact: as in `solve_contact_state`.
        before, state: shape (parts,).
        press_part, press_wrench: held parts that robots press, and the whitened wrenches that they add, shapes (n,)
            and (n, 6).
        lost: whitened wrenches by which contacts carry held parts less, see `lose_carriers`.
        increments: in how many the missing wrenches are transferred, at most; all of gravity where the history is
            empty.
        history: `HistoryArrays`.
        track: out: displacement in each increment, m and rad, shape (increments, parts, 6), zero before; nothing is
            written where it has no increments.

    Returns:
        `RESTS`, `MOVES_AWAY` or `OPEN`; residual; iterations; the part that moved most, and its movement in m.
    """
    structure, work = law.structure, contact.work
    moving, origin, near = np.empty_like(state), np.empty_like(state), np.empty_like(state)
    set_holds(law, before, state, press_part, press_wrench, contact, moving, origin)
    missing, push = np.zeros((len(work.free), 6)), np.zeros((len(work.free), 6))
    pairs, count = load_history(law, moving, contact, history, missing, 0.0)
    if count == 0:
        return RESTS, 0.0, 0, -1, 0.0
    contact.displacement[:] = 0.0
    spent, result, residual = 0, RESTS, 0.0
    evaluate(law, contact, pairs, contact.displacement, contact.trial, contact.residual)
    for j in range(len(work.free)):
        for r in range(6):
            if work.free[j]:
                missing[j, r] = contact.residual[j, r]
            if contact.grip[j] > 0.0:  # robots bear what they bore before; their springs take over what is lost
                push[j, r] = -lost[structure.elimination.order[j], r] / increments
    for k in range(len(press_part)):
        for r in range(6):
            push[structure.elimination.position[press_part[k]], r] += press_wrench[k, r] / increments
    count = increments
    if lacks_contact(contact, pairs):
        result, count = MOVES_AWAY, 0
    mends = work.start[pairs] < 0  # not a literal, for which numba would recompile the search
    kept, free = freeze_outside_ball(structure, moving, origin, REACH, near)
    local = kept > 0 and 2 * kept <= free
    moved = np.zeros((len(state), 6))
    ahead = np.zeros((len(work.free), 6))  # parts move, and contacts slide, in each increment much as in the last
    number, done, size = 0, 0, min(1, count)
    while size > 0:
        number, done = number + 1, done + size
        share = 1.0 - done / count
        tolerance = options.tolerance if done == count else max(options.tolerance, PASSING)
        result, whole = OPEN, 0
        for j in range(len(ahead)):
            for r in range(6):
                missing[j, r] -= size * push[j, r]
                contact.displacement[j, r] = ahead[j, r]
        if local:
            pairs, _ = load_history(law, near, contact, history, missing, share)
            if number > 1:
                move_far_parts(structure, moving, near, contact, pairs, ahead)
            first = options.first_step if number == 1 else options.warm_first_step
            result, residual, taken = equilibrate(
                law, contact, pairs, options.warm_steps // 2, tolerance, first, VERDICT_SCHEDULE
            )
            spent += taken
        pairs, _ = load_history(law, moving, contact, history, missing, share)
        # From where the near parts came to rest, or from what is expected, then from before.
        left = 2 if result == RESTS or (number > 1 and not local) else 1
        while left > 0:
            steps, first = options.warm_steps, options.warm_first_step
            if left == 1:
                contact.displacement[:] = 0.0
                steps, first = options.steps, options.first_step
            result, residual, taken = solve_statics(
                law, contact, pairs, steps, tolerance, first, mends, VERDICT_SCHEDULE
            )
            spent, whole = spent + taken, whole + taken
            left = 0 if result == RESTS else left - 1
        for j in range(len(ahead)):
            for r in range(6):
                ahead[j, r] = contact.displacement[j, r]
                missing[j, r] += contact.grip[j] * ahead[j, r]  # zero but for held parts
            if 0.0 < contact.across[j] < np.inf:
                add_across(contact, j, ahead, 1.0, missing)
        step = track[number - 1] if len(track) else moved
        _keep_history(law, contact, pairs, history, step)
        if result != RESTS:
            break
        # Where one step of Newton's method is enough the response is linear, and the path loses nothing.
        grown = min(2 * size, max(count // _LARGEST, 1)) if whole <= 1 else max(size // 2, 1)
        grown = min(grown, count - done)
        for j in range(len(ahead)):
            for r in range(6):
                ahead[j, r] *= grown / size
        size = grown
    part, movement = -1, 0.0
    for i in range(len(state)):
        for r in range(6 if state[i] != 0 else 0):
            moved = abs(history.displacement[i, r]) * (1.0 if r < 3 else law.reach[i])
            if moved > movement:
                part, movement = i, moved
    if result == RESTS and moves_far(law, contact, pairs, movement):
        result = MOVES_AWAY
    return result, residual, spent, part, movement


@njit(nogil=True, cache=True)
def replay_range(
    law, states, first, last, fresh, press_start, press_part, press_wrench, options, increments, noise, displacement,
    springs, torn, set_share, track, result, residual, part, movement, iterations,
):  # fmt: skip
    """Replay consecutive states until one does not come to rest; return how many did, those before included.

    Args:
        law, options, increments: as in `settle_step`.
        states: shape (steps + 1, parts); the history belongs to the first, unless `fresh`.
        first, last: the states to replay, up to `last`; those before have been.
        fresh: whether the first of all states has no history.
        press_start, press_part, press_wrench: the robots that press in the step to state `i` are the entries
            `press_start[i]:press_start[i + 1]`; see `settle_step`.
        noise: as in `place_new`.
        displacement, springs, torn, set_share: `HistoryArrays` before and after each state, with `steps + 1` entries
            each; the first entry is given, the others are written, but for `set_share`.
        track: as in `settle_step`, one entry a state.
        result, residual, part, movement, iterations: out, one entry per state; iterations zero before.
    """
    contact, lost = make_contact_scratch(law), np.zeros((states.shape[1], 6))
    for i in range(first, last):
        history = HistoryArrays(displacement[i], springs[i], torn[i], set_share[i])
        settles = fresh
        if i > 0:
            # Entry by entry: assigning rows to rows would compile numba's error messages, for seconds.
            for p in range(states.shape[1]):
                for r in range(6):
                    displacement[i, p, r] = displacement[i - 1, p, r]
            for j in range(springs.shape[1]):
                for k in range(3):
                    springs[i, j, k] = springs[i - 1, j, k]
                torn[i, j] = torn[i - 1, j]
            was = HistoryArrays(displacement[i], springs[i], torn[i], set_share[i - 1])
            lose_carriers(law.structure, states[i - 1], states[i], was, history, lost)
            settles = gains_strength(law.structure, np.minimum(states[i - 1], states[i]), was, history)
            place_new(law.structure, states[i - 1], states[i], noise, history)
            for p in range(states.shape[1]):
                # Holding a part changes nothing; releasing or removing one does.
                settles = settles or (states[i, p] != states[i - 1, p] and states[i, p] != 2)
        result[i], residual[i] = RESTS, 0.0
        if settles:
            begin, end = press_start[i], press_start[i + 1]
            result[i], residual[i], iterations[i], part[i], movement[i] = settle_step(
                law, states[max(i - 1, 0)], states[i], press_part[begin:end], press_wrench[begin:end], lost, options,
                increments, contact, history, track[i],
            )  # fmt: skip
        elif i > 0:
            part[i], movement[i] = part[i - 1], movement[i - 1]
        strained = overloaded(law, states[i], history) if result[i] == RESTS else -1
        if strained >= 0:  # by its own load, perhaps, as soon as the part is held
            result[i], part[i] = OVERLOADS, strained
        if result[i] != RESTS:
            return i
    return last
