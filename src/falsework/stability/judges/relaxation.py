"""Compiled loop of the discrete-element method: unit time steps until a state comes to rest or has collapsed."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, REMOVED

Array = NDArray[np.float64]

STANDS, OPEN, FALLS = 1, 0, -1
"""Results of the relaxation; open: still moving at the step limit."""

_EVERY = 100
"""Steps between two checks for rest or collapse."""
_PERIODS = 10.0
"""Least length of a ramp, in periods of a held part on the spring of its robot: a shorter one would swing the part."""


class Model(NamedTuple):
    """Structure in units of the size and weight of a typical part."""

    parts: NDArray[np.int32]
    """Shape (contacts, 2)."""
    start: NDArray[np.int32]
    """Shape (contacts + 1,)."""
    frames: Array
    """Shape (contacts, 3, 3)."""
    arm_a: Array
    """From the centre of mass of part `a` to the centre of the contact, shape (contacts, 3)."""
    arm_b: Array
    local: Array
    """Contact points relative to the centre, in the frame of the contact, shape (points, 3)."""
    stiffness: Array
    """Stiffness of the normal springs, shape (points,)."""
    weight: Array
    """Shape (parts,)."""
    applied: Array
    """Weight and other loads, shape (parts, 6)."""
    radius: Array
    """Shape (parts,)."""
    gyration: Array
    """Inertia by mass, about the centre of mass, shape (parts, 3, 3)."""
    friction: Array
    """Coefficient of friction of each contact point, shape (points,)."""


class JudgedHolds(NamedTuple):
    """Held parts that can move: each hangs on the spring of its robot."""

    stiffness: Array
    """Stiffness against translation, zero for parts that nothing holds or that a rigid hold fixes, shape (parts,).
    Against rotation it is this times the inertia by mass."""
    fresh: NDArray[np.bool_]
    """Parts that a robot takes as they are: it bears at first what balances them, and `wrench`, shape (parts,)."""
    wrench: Array
    """What each robot bears, in: before its part moves; out: after that, shape (parts, 6)."""
    line: Array
    """Direction of the force of a robot that controls the position across it, a unit vector; zero for other parts,
    shape (parts, 3)."""
    across: Array
    """Stiffness across that direction, infinite where a part moves along it only, shape (parts,)."""


@nb.njit(cache=True, nogil=True)
def relax(model, state, gap, friction, grip, tangential, damping, ramp, steps, fallen, rest):
    """Integrate until a state comes to rest or collapses; time step and unit of mass are one.

    Args:
        model: the structure.
        state: shape (parts,).
        gap: in and out: opening of each contact point, negative where compressed, shape (points,).
        friction: in and out: tangential forces on part `b`, shape (points, 2).
        grip: springs of the robots; a wrench that they do not balance at the start is ramped up like any other.
        tangential, damping, ramp, steps, fallen, rest: as in `DiscreteElementSettings`; soft robots lengthen ramp and
            steps.

    Returns:
        Result, largest displacement since the start, and the part with it.
    """
    slot = np.empty(len(state), np.int64)
    free = np.flatnonzero((state == INSTALLED) | (grip.stiffness > 0.0))
    bodies = len(free)
    if bodies == 0:
        return STANDS, 0.0, -1
    slot[:] = bodies  # one more body that never moves represents all fixed parts
    for body in range(bodies):
        slot[free[body]] = body
    active, points = _active(model, state, slot, bodies)
    index = np.empty(points, np.int64)
    first = np.zeros(len(active) + 1, np.int64)
    for k in range(len(active)):
        begin, end = model.start[active[k]], model.start[active[k] + 1]
        first[k + 1] = first[k] + end - begin
        for j in range(end - begin):
            index[first[k] + j] = begin + j
    side_a, side_b = slot[model.parts[active, 0]], slot[model.parts[active, 1]]
    frames, arm_a, arm_b = model.frames[active], model.arm_a[active], model.arm_b[active]
    local, stiff, rough = model.local[index], model.stiffness[index], model.friction[index]
    open_, slide = gap[index], friction[index]
    hold, turn, line, across = grip.stiffness[free], model.gyration[free], grip.line[free], grip.across[free]
    stiffest = hold.copy()
    for body in range(bodies):
        if line[body].any() and across[body] < np.inf:
            stiffest[body] = max(hold[body], across[body])
    inertia = _inertia(bodies, side_a, side_b, first, frames, arm_a, arm_b, local, stiff, tangential, stiffest, turn)
    for body in range(bodies):
        if inertia[body, 0] == 0.0:
            return FALLS, np.inf, free[body]
        if across[body] == np.inf and line[body].any():
            inertia[body, :3] = inertia[body, :3].max()  # under one mass a part moves along the force on it
    slow = _slow_ramp(inertia, hold, turn, ramp)
    ramp, steps = slow, steps + slow - ramp
    weight, applied, radius = model.weight[free], model.applied[free] + grip.wrench[free], model.radius[free]
    motion, moved = np.zeros((bodies + 1, 6)), np.zeros((bodies + 1, 6))
    load, missing = np.zeros((bodies + 1, 6)), np.zeros((bodies + 1, 6))
    answer, largest, part = OPEN, 0.0, free[0]
    resting = 0
    for step in range(steps + 1):
        load[bodies] = 0.0
        for body in range(bodies):
            for i in range(6):
                load[body, i] = applied[body, i]
        for k in range(len(active)):
            _contact(
                motion[side_a[k]], motion[side_b[k]], load[side_a[k]], load[side_b[k]], frames[k], arm_a[k], arm_b[k],
                local, stiff, open_, slide, first[k], first[k + 1], tangential, rough,
            )  # fmt: skip
        for body in range(bodies):
            if hold[body] > 0.0:
                if step == 0 and grip.fresh[free[body]]:
                    for i in range(6):
                        applied[body, i] -= load[body, i] - grip.wrench[free[body], i]
                        load[body, i] = grip.wrench[free[body], i]
                _pull(hold[body], line[body], across[body], turn[body], moved[body], load[body])
                if across[body] == np.inf and line[body].any():
                    _along(line[body], load[body])
        if step == 0:
            missing = load.copy()
        if step % _EVERY == 0:
            largest, part = _largest(moved, radius, free)
            if largest > fallen:
                answer = FALLS
                break
            # Twice in a row: an oscillation may pass through momentary balance.
            resting = resting + 1 if (step == 0 or step > ramp) and _balanced(load, weight, rest) else 0
            if resting == 2 or (resting == 1 and step == 0):
                answer = STANDS
                break
        share = max(0.0, 1.0 - (step + 1) / ramp)
        for body in range(bodies):
            for i in range(6):
                force = load[body, i] - share * missing[body, i]
                v = motion[body, i]
                drag = damping * abs(force)
                v += (force - (drag if v > 0.0 else -drag if v < 0.0 else 0.0)) / inertia[body, i]
                motion[body, i] = v
                moved[body, i] += v
    for j in range(points):
        gap[index[j]] = open_[j]
        friction[index[j], 0], friction[index[j], 1] = slide[j, 0], slide[j, 1]
    for body in range(bodies):
        if hold[body] > 0.0:
            for i in range(6):
                grip.wrench[free[body], i] = applied[body, i] - model.applied[free[body], i]
            _pull(hold[body], line[body], across[body], turn[body], moved[body], grip.wrench[free[body]])
    return answer, largest, part


@nb.njit(cache=True, nogil=True)
def _slow_ramp(inertia, hold, turn, ramp):
    """Return the steps over which to ramp up a load where robots are springs, at least `ramp`."""
    for body in range(len(hold)):
        if hold[body] > 0.0:
            for i in range(3):
                shift, swing = inertia[body, i], inertia[body, 3 + i] / turn[body, i, i]
                ramp = max(ramp, int(_PERIODS * 2.0 * np.pi * np.sqrt(max(shift, swing) / hold[body])))
    return ramp


@nb.njit(cache=True, nogil=True)
def _pull(hold, line, across, turn, moved, load):
    """Add the wrench of a robot's spring to the load of its part."""
    swing, more = hold, 0.0
    if across < np.inf and line.any():
        swing, more = across, across - hold
    size = moved[0] * line[0] + moved[1] * line[1] + moved[2] * line[2]
    for i in range(3):
        load[i] -= hold * moved[i] + more * (moved[i] - size * line[i])
        for k in range(3):
            load[3 + i] -= swing * turn[i, k] * moved[3 + k]


@nb.njit(cache=True, nogil=True)
def _along(line, load):
    """Leave of a load what is along the direction in which the part can move."""
    size = load[0] * line[0] + load[1] * line[1] + load[2] * line[2]
    for i in range(3):
        load[i], load[3 + i] = size * line[i], 0.0


@nb.njit(cache=True, nogil=True)
def _active(model, state, slot, bodies):
    """Return the acting contacts, both parts present and one of them a body, and their number of points."""
    active = np.empty(len(model.parts), np.int64)
    count, points = 0, 0
    for c in range(len(model.parts)):
        a, b = model.parts[c]
        if state[a] != REMOVED and state[b] != REMOVED and min(slot[a], slot[b]) < bodies:
            active[count] = c
            count += 1
            points += model.start[c + 1] - model.start[c]
    return active[:count], points


@nb.njit(cache=True, nogil=True)
def _inertia(bodies, side_a, side_b, first, frames, arm_a, arm_b, local, stiff, tangential, hold, turn):
    """Return masses that make a unit step stable, shape (bodies, 6).

    With row sums of the absolute stiffness as masses, all squared frequencies would be at most 1. A unit step is stable
    up to 4; half the row sums allow 2.
    """
    inertia, row = np.zeros((bodies + 1, 6)), np.zeros((2, 6))
    for k in range(len(side_a)):
        frame = frames[k]
        for j in range(first[k], first[k + 1]):
            x, y, z = local[j, 0], local[j, 1], local[j, 2]
            for axis in range(3):
                total = 0.0
                for side in range(2):
                    middle = arm_a[k] if side == 0 else arm_b[k]
                    for i in range(3):
                        one, two = (i + 1) % 3, (i + 2) % 3
                        along = middle[one] + frame[0, one] * x + frame[1, one] * y + frame[2, one] * z
                        across = middle[two] + frame[0, two] * x + frame[1, two] * y + frame[2, two] * z
                        row[side, i] = abs(frame[axis, i])
                        row[side, 3 + i] = abs(along * frame[axis, two] - across * frame[axis, one])
                    if (side_a[k] if side == 0 else side_b[k]) < bodies:
                        for i in range(6):
                            total += row[side, i]
                spring = 0.5 * total * (stiff[j] if axis == 0 else tangential * stiff[j])
                for i in range(6):
                    inertia[side_a[k], i] += spring * row[0, i]
                    inertia[side_b[k], i] += spring * row[1, i]
    for body in range(bodies):
        most = 0.0
        for i in range(3):
            turned = abs(turn[body, i, 0]) + abs(turn[body, i, 1]) + abs(turn[body, i, 2])
            inertia[body, i] += 0.5 * hold[body]
            inertia[body, 3 + i] += 0.5 * hold[body] * turned
            most = max(most, inertia[body, i])
        # A rotation that no spring resists, as about the normal through a single point, still needs some mass.
        for i in range(3, 6):
            inertia[body, i] = max(inertia[body, i], 1e-6 * most)
    return inertia[:bodies]


@nb.njit(cache=True, nogil=True)
def _contact(va, vb, load_a, load_b, f, ra, rb, local, stiff, gap, slide, begin, end, tangential, mu):
    """Advance the points of one contact by one step and add their forces to the loads of both parts."""
    # Motion of part b relative to part a at the centre of the contact, then in its frame.
    x = vb[0] + vb[4] * rb[2] - vb[5] * rb[1] - va[0] - va[4] * ra[2] + va[5] * ra[1]
    y = vb[1] + vb[5] * rb[0] - vb[3] * rb[2] - va[1] - va[5] * ra[0] + va[3] * ra[2]
    z = vb[2] + vb[3] * rb[1] - vb[4] * rb[0] - va[2] - va[3] * ra[1] + va[4] * ra[0]
    wx, wy, wz = vb[3] - va[3], vb[4] - va[4], vb[5] - va[5]
    v0 = f[0, 0] * x + f[0, 1] * y + f[0, 2] * z
    v1 = f[1, 0] * x + f[1, 1] * y + f[1, 2] * z
    v2 = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
    w0 = f[0, 0] * wx + f[0, 1] * wy + f[0, 2] * wz
    w1 = f[1, 0] * wx + f[1, 1] * wy + f[1, 2] * wz
    w2 = f[2, 0] * wx + f[2, 1] * wy + f[2, 2] * wz
    s0 = s1 = s2 = m0 = m1 = m2 = 0.0
    for j in range(begin, end):
        p0, p1, p2 = local[j, 0], local[j, 1], local[j, 2]
        gap[j] += v0 + w1 * p2 - w2 * p1
        if gap[j] >= 0.0:
            slide[j, 0] = 0.0
            slide[j, 1] = 0.0
            continue
        normal = -stiff[j] * gap[j]
        spring = tangential * stiff[j]
        t1 = slide[j, 0] - spring * (v1 + w2 * p0 - w0 * p2)
        t2 = slide[j, 1] - spring * (v2 + w0 * p1 - w1 * p0)
        limit = mu[j] * normal
        square = t1 * t1 + t2 * t2
        if square > limit * limit:
            cut = limit / np.sqrt(square)
            t1 *= cut
            t2 *= cut
        slide[j, 0] = t1
        slide[j, 1] = t2
        s0 += normal
        s1 += t1
        s2 += t2
        m0 += p1 * t2 - p2 * t1
        m1 += p2 * normal - p0 * t2
        m2 += p0 * t1 - p1 * normal
    x = f[0, 0] * s0 + f[1, 0] * s1 + f[2, 0] * s2
    y = f[0, 1] * s0 + f[1, 1] * s1 + f[2, 1] * s2
    z = f[0, 2] * s0 + f[1, 2] * s1 + f[2, 2] * s2
    mx = f[0, 0] * m0 + f[1, 0] * m1 + f[2, 0] * m2
    my = f[0, 1] * m0 + f[1, 1] * m1 + f[2, 1] * m2
    mz = f[0, 2] * m0 + f[1, 2] * m1 + f[2, 2] * m2
    load_b[0] += x
    load_b[1] += y
    load_b[2] += z
    load_b[3] += mx + rb[1] * z - rb[2] * y
    load_b[4] += my + rb[2] * x - rb[0] * z
    load_b[5] += mz + rb[0] * y - rb[1] * x
    load_a[0] -= x
    load_a[1] -= y
    load_a[2] -= z
    load_a[3] -= mx + ra[1] * z - ra[2] * y
    load_a[4] -= my + ra[2] * x - ra[0] * z
    load_a[5] -= mz + ra[0] * y - ra[1] * x


@nb.njit(cache=True, nogil=True)
def _largest(moved, radius, free):
    """Return the largest displacement of any part, and that part."""
    largest, part = -1.0, -1
    for body in range(len(free)):
        u = moved[body]
        shift = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
        shift += radius[body] * np.sqrt(u[3] ** 2 + u[4] ** 2 + u[5] ** 2)
        if shift > largest:
            largest, part = shift, free[body]
    return largest, part


@nb.njit(cache=True, nogil=True)
def _balanced(load, weight, rest):
    """Return whether the unbalanced force of every part is small against its weight."""
    for body in range(len(weight)):
        for i in range(6):
            if abs(load[body, i]) > rest * weight[body]:
                return False
    return True
