"""Compiled holds of robots: which parts give way in a step, along which lines, and what their robots bear after it."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.law import contact_force
from falsework.utils.kernels import njit

LOCKED = np.inf
"""Stiffness across its line of a hold that lets a part move along the line only."""


@njit(cache=True)
def along_line(contact, j, motion):
    """Leave of a motion or wrench of a part, row `j` of shape (n, 6), what is along the line of its hold."""
    line = contact.line
    size = motion[j, 0] * line[j, 0] + motion[j, 1] * line[j, 1] + motion[j, 2] * line[j, 2]
    for r in range(3):
        motion[j, r], motion[j, 3 + r] = size * line[j, r], 0.0


@njit(cache=True)
def add_across(contact, j, displacement, factor, out):
    """Add `factor` times the wrench of the spring across the line of a hold, beyond that of `grip`."""
    line, more = contact.line, factor * (contact.across[j] - contact.grip[j])
    size = displacement[j, 0] * line[j, 0] + displacement[j, 1] * line[j, 1] + displacement[j, 2] * line[j, 2]
    for r in range(3):
        out[j, r] += more * (displacement[j, r] - size * line[j, r])
        out[j, 3 + r] += more * displacement[j, 3 + r]


@njit(cache=True)
def resist_across(contact, j, displacement, out):
    """Balance a part across the line of its hold: by the spring of the robot, or whatever it takes."""
    if contact.across[j] == LOCKED:
        along_line(contact, j, out)
    else:
        add_across(contact, j, displacement, -1.0, out)


@njit(cache=True)
def set_holds(law, before, state, pressed, wrench, contact, moving, origin):
    """Write the springs of the holds in a step, and which parts can move in it.

    Args:
        law, contact: as in `settle_step`.
        before, state: shape (parts,).
        pressed: held parts that robots press in this step, shape (n,).
        wrench: whitened wrenches that they add, shape (n, 6); with (0, 6) the parts give way in all directions.
        moving: out: `state` with the parts whose holds give way as installed, shape (parts,).
        origin: out: the same where the step changes nothing, 3 where it does, shape (parts,).
    """
    position, grip, across = law.structure.elimination.position, contact.grip, contact.across
    for j in range(len(grip)):
        grip[j], across[j] = 0.0, 0.0
    for i in range(len(state)):
        moving[i] = state[i]
        if state[i] == 2 and position[i] >= 0 and law.grip[i] > 0.0:
            moving[i], grip[position[i]] = 1, law.grip[i]
        origin[i] = moving[i] if before[i] == state[i] else 3
    for k in range(len(pressed)):
        i = pressed[k]
        j = position[i]
        moving[i], origin[i], grip[j] = 1, 3, law.press_grip[i]
        if law.hybrid and len(wrench):
            size = np.sqrt(wrench[k, 0] ** 2 + wrench[k, 1] ** 2 + wrench[k, 2] ** 2)
            across[j] = law.grip[i] if law.grip[i] > 0.0 else LOCKED
            for r in range(3):
                contact.line[j, r] = wrench[k, r] / size if size > 0.0 else 0.0


@njit(cache=True)
def hold_wrench(structure, state, part, history, out):
    """Write the whitened wrench of a robot on a part that it holds, shape (6,), from the forces of its contacts."""
    first, pair, parts = structure.neighbour_start, structure.neighbour_pair, structure.pair_parts
    for r in range(6):
        out[r] = -structure.gravity[part, r]
    for k in range(first[part], first[part + 1]):
        q = pair[k]
        other = parts[q, 0] + parts[q, 1] - part
        if state[other] == 0:
            continue
        transfer = structure.transfer_a if parts[q, 0] == part else structure.transfer_b
        for j in range(structure.pair_start[q], structure.pair_start[q + 1]):
            pull, stick = structure.pull[j], structure.stick[j]
            if history.torn[j]:
                pull, stick = 0.0, 0.0
            elif len(history.set_share):
                pull *= history.set_share[j]
                stick *= history.set_share[j]
            n, x, y = history.springs[j, 0], history.springs[j, 1], history.springs[j, 2]
            f0, f1, f2 = contact_force(structure.cone, structure.friction[j], pull, stick, n, x, y)
            for i in range(6):
                bundle = structure.basis[j, i, 0] * f0 + structure.basis[j, i, 1] * f1 + structure.basis[j, i, 2] * f2
                for r in range(6):
                    out[r] -= transfer[q, r, i] * bundle


@njit(cache=True)
def overloaded(law, state, history):
    """Return the first part whose robot bears more than it can, or -1."""
    structure, wrench = law.structure, np.empty(6)
    for i in range(len(state)):
        if state[i] != 2 or structure.elimination.position[i] < 0:
            continue
        hold_wrench(structure, state, i, history, wrench)
        force, moment = 0.0, 0.0
        for r in range(3):
            force += wrench[r] * wrench[r]
            turning = 0.0
            for c in range(3):
                turning += structure.momentum[i, 3 + r, 3 + c] * wrench[3 + c]
            moment += turning * turning
        most, largest = law.force_limit[i], law.moment_limit[i]
        if force > most * most or moment > largest * largest:
            return i
    return -1
