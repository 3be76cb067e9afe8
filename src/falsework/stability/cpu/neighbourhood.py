"""Regions near a change, and a search for a mechanism there before the whole state is solved.

A state differs from a stable one in a part or two, and if it is unstable, the mechanism is mostly near them. So hold
every part that is more than a few contacts away and check the rest: if that is unstable, then so is the
state, since holding fewer parts never helps, and the velocity that proves it, zero far away, proves it for the
whole. Such a proof costs the work of a few parts however large the structure is, and unstable states are
those that take longest on the whole structure.
"""

from __future__ import annotations

import numpy as np

from falsework.stability.cpu.kernel import solve_state
from falsework.stability.cpu.layout import make_scratch, pair_velocity, point_velocity
from falsework.stability.cpu.termination import UNDECIDED, UNSTABLE
from falsework.utils.kernels import njit

REACH = 3
"""Contacts from a change within which parts settle first, and a mechanism is sought last; by which the first region
of a repair reaches beyond it, and by which that is extended first. Checked on recorded searches."""
_MARKED = 0.5
"""Share of the largest change of force that a region would pass on over its border, from which another part counts as
pressed (the marking of Doerfler, 1996); checked on recorded searches."""


@njit(cache=True)
def _path_lengths(structure, state, seeds, count, limit, depth):
    """Write how many contacts each free part is away from the parts `seeds[:count]`, -1 beyond a limit.

    `seeds` has room for all parts and is overwritten.
    """
    first, pair, parts = structure.neighbour_start, structure.neighbour_pair, structure.pair_parts
    depth[:] = -1
    for k in range(count):
        depth[seeds[k]] = 0
    head, tail = 0, count
    while head < tail:
        i = seeds[head]
        head += 1
        if depth[i] == limit:
            break
        for k in range(first[i], first[i + 1]):
            q = pair[k]
            other = parts[q, 0] + parts[q, 1] - i
            if depth[other] < 0 and state[other] == 1:
                depth[other] = depth[i] + 1
                seeds[tail] = other
                tail += 1


@njit(cache=True)
def _changed_parts(state, parent, changed):
    """Write the parts in which two states differ; return their number."""
    count = 0
    for i in range(len(state)):
        if state[i] != parent[i]:
            changed[count] = i
            count += 1
    return count


@njit(cache=True)
def freeze_outside_ball(structure, state, parent, rings, near):
    """Copy `state` to `near`, holding free parts over `rings` contacts from where it differs from `parent`.

    Returns:
        Number of parts that stay free, and number of free parts before.
    """
    depth, queue = np.empty(len(state), np.int32), np.empty(len(state), np.int32)
    _path_lengths(structure, state, queue, _changed_parts(state, parent, queue), rings, depth)
    kept, free = 0, 0
    for i in range(len(state)):
        near[i] = 2 if state[i] == 1 and depth[i] < 0 else state[i]
        kept += near[i] == 1
        free += state[i] == 1
    return kept, free


@njit(cache=True)
def freeze_outside_corridor(structure, state, parent, detour, near):
    """Copy `state` to `near`, holding free parts away from the shortest ways from the change to a support.

    Those on ways that are longer than the shortest by up to `detour` contacts stay free, and those as far from where it
    differs from `parent`. Ways lead to parts that robots hold only where none leads to a support: what a part that is
    held near by can take up, regions around the change have shown already.

    Returns:
        Number of parts that stay free, and number of free parts before.
    """
    parts, position = len(state), structure.elimination.position
    queue, away, down = np.empty(parts, np.int32), np.empty(parts, np.int32), np.empty(parts, np.int32)
    shortest, changed = parts, 0
    for supported in range(2):
        fixed = 0
        for i in range(parts):
            if state[i] == 2 and (supported == 1 or position[i] < 0):
                queue[fixed] = i
                fixed += 1
        _path_lengths(structure, state, queue, fixed, parts, down)
        changed = _changed_parts(state, parent, queue)
        for k in range(changed):
            if down[queue[k]] >= 0:
                shortest = min(shortest, down[queue[k]])
        if shortest < parts:
            break
    _path_lengths(structure, state, queue, changed, shortest + detour, away)
    kept, free = 0, 0
    for i in range(parts):
        beside = away[i] < 0 or (away[i] > detour and (down[i] < 0 or away[i] + down[i] > shortest + detour))
        near[i] = 2 if state[i] == 1 and beside else state[i]
        kept += near[i] == 1
        free += state[i] == 1
    return kept, free


@njit(cache=True)
def extend_region(structure, state, near, velocity, forces, reach):
    """Free the parts that a region presses most, and those fewer than `reach` contacts from them.

    Over a contact that bears a force, a motion of the region changes it about as much as by the motion times the square
    of the force: this is what steps inside the cones do (`centring.py`).

    Args:
        structure: `KernelArrays`.
        state: shape (parts,).
        near: the state with the parts outside the region held; in and out, shape (parts,).
        velocity: of the parts of the region, whitened, as its last step left it, shape (n, 6).
        forces: contact forces in N, shape (points, 3).
        reach: 1 frees the parts that are pressed alone.

    Returns:
        Number of free parts.
    """
    parts, first, position = structure.pair_parts, structure.pair_start, structure.elimination.position
    ta, tb, basis, scale = structure.transfer_a, structure.transfer_b, structure.basis, structure.force_scale
    pressed, queue = np.zeros(len(state)), np.empty(len(state), np.int32)
    away = np.empty(len(state), np.int32)
    most, count, kept = 0.0, 0, 0
    for q in range(len(parts)):
        a, b = parts[q, 0], parts[q, 1]
        if state[a] == 0 or state[b] == 0 or (near[a] == 1) == (near[b] == 1):
            continue
        slot_a, slot_b = position[a] if near[a] == 1 else -1, position[b] if near[b] == 1 else -1
        s0, s1, s2, s3, s4, s5 = pair_velocity(ta, tb, q, slot_a, slot_b, velocity)
        change = 0.0
        for j in range(first[q], first[q + 1]):
            d0, d1, d2 = point_velocity(basis, j, s0, s1, s2, s3, s4, s5)
            square = (forces[j, 0] / scale[j]) ** 2
            change += square * square * (d0 * d0 + d1 * d1 + d2 * d2)
        outside = b if near[a] == 1 else a
        if state[outside] == 1:
            pressed[outside] = max(pressed[outside], np.sqrt(change))
            most = max(most, pressed[outside])
    for i in range(len(state)):
        if pressed[i] > 0.0 and pressed[i] >= _MARKED * most:
            queue[count] = i
            count += 1
    _path_lengths(structure, state, queue, count, reach - 1, away)
    for i in range(len(state)):
        if away[i] >= 0:
            near[i] = 1
        kept += near[i] == 1
    return kept


@njit(cache=True)
def find_mechanism(structure, state, parent, reach, options, work, velocity):
    """Search for a mechanism near the difference of a state from its parent; parts over `reach` contacts away are held.

    `velocity` as in `solve_state`.

    Returns:
        `UNSTABLE` or `UNDECIDED`, the residual that it is based on, and iterations.
    """
    near = np.empty(len(state), np.uint8)
    kept, free = freeze_outside_ball(structure, state, parent, reach, near)
    if kept == 0 or 2 * kept > free:
        return UNDECIDED, np.nan, 0
    forces = np.zeros((0, 3))
    cold = len(forces) > 0  # not a literal, for which numba would recompile the solver
    verdict, residual, iterations = solve_state(structure, near, options, work, forces, velocity, cold)
    if verdict != UNSTABLE:  # forces that balance these parts alone prove nothing
        verdict, residual = UNDECIDED, np.nan
    return verdict, residual, iterations


@njit(nogil=True, cache=True)
def local_instability_range(structure, states, parents, reach, options, velocity, verdict, residual, iterations):
    """Search for mechanisms near the difference of states, whose `verdict` is `UNDECIDED`, from their parents.

    Arrays as in `solve_range`, `reach` as in `find_mechanism`.

    Returns:
        Number of states left undecided.
    """
    nothing = np.zeros((0, 6))
    work = make_scratch(structure)
    left = 0
    for i in range(len(states)):
        if verdict[i] != UNDECIDED:
            continue
        motion = velocity[i] if len(velocity) else nothing
        verdict[i], residual[i], taken = find_mechanism(structure, states[i], parents[i], reach, options, work, motion)
        iterations[i] += taken
        left += verdict[i] == UNDECIDED
    return left
