"""Compiled holds of robots: which parts give way in a step, and what their robots bear after it."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.hybrid_kernel import LOCKED
from falsework.stability.contact.law import contact_force
from falsework.utils.kernels import njit


@njit(cache=True)
def set_holds(structure, contact_structure, before, state, pressed, wrench, contact, moving, origin):
    """Write the springs of the holds in a step, and which parts can move in it.

    Args:
        structure, contact_structure, contact: as in `settle_step`.
        before, state: shape (parts,).
        pressed: held parts that robots press in this step, shape (n,).
        wrench: whitened wrenches that they add, shape (n, 6); with (0, 6) the parts give way in all directions.
        moving: out: `state` with the parts whose holds give way as installed, shape (parts,).
        origin: out: the same where the step changes nothing, 3 where it does, shape (parts,).
    """
    position, grip, across = structure.elimination.position, contact.grip, contact.across
    for j in range(len(grip)):
        grip[j], across[j] = 0.0, 0.0
    for i in range(len(state)):
        moving[i] = state[i]
        if state[i] == 2 and position[i] >= 0 and contact_structure.grip[i] > 0.0:
            moving[i], grip[position[i]] = 1, contact_structure.grip[i]
        origin[i] = moving[i] if before[i] == state[i] else 3
    for k in range(len(pressed)):
        i = pressed[k]
        j = position[i]
        moving[i], origin[i], grip[j] = 1, 3, contact_structure.press_grip[i]
        if contact_structure.hybrid and len(wrench):
            size = np.sqrt(wrench[k, 0] ** 2 + wrench[k, 1] ** 2 + wrench[k, 2] ** 2)
            across[j] = contact_structure.grip[i] if contact_structure.grip[i] > 0.0 else LOCKED
            for r in range(3):
                contact.line[j, r] = wrench[k, r] / size if size > 0.0 else 0.0


@njit(cache=True)
def hold_wrench(structure, state, part, springs, torn, set_share, out):
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
            if torn[j]:
                pull, stick = 0.0, 0.0
            elif len(set_share):
                pull *= set_share[j]
                stick *= set_share[j]
            f0, f1, f2 = contact_force(
                structure.cone, structure.friction[j], pull, stick, springs[j, 0], springs[j, 1], springs[j, 2]
            )
            for i in range(6):
                bundle = structure.basis[j, i, 0] * f0 + structure.basis[j, i, 1] * f1 + structure.basis[j, i, 2] * f2
                for r in range(6):
                    out[r] -= transfer[q, r, i] * bundle


@njit(cache=True)
def overloaded(structure, contact_structure, state, springs, torn, set_share):
    """Return the first part whose robot bears more than it can, or -1."""
    wrench = np.empty(6)
    for i in range(len(state)):
        if state[i] != 2 or structure.elimination.position[i] < 0:
            continue
        hold_wrench(structure, state, i, springs, torn, set_share, wrench)
        force, moment = 0.0, 0.0
        for r in range(3):
            force += wrench[r] * wrench[r]
            turning = 0.0
            for c in range(3):
                turning += structure.momentum[i, 3 + r, 3 + c] * wrench[3 + c]
            moment += turning * turning
        most, largest = contact_structure.force_limit[i], contact_structure.moment_limit[i]
        if force > most * most or moment > largest * largest:
            return i
    return -1
