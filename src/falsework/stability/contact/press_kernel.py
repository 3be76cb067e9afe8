"""Compiled response of contact forces to robots that press: linear, with closed contacts that stick."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.hold_kernel import set_holds
from falsework.stability.contact.layout import make_contact_scratch
from falsework.stability.contact.newton import evaluate
from falsework.stability.contact.replay_kernel import HistoryArrays, load_history
from falsework.stability.contact.tangent import assemble_tangent
from falsework.stability.cpu.cones import NEGLIGIBLE
from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.layout import pair_velocity, point_velocity
from falsework.stability.cpu.neighbourhood import REACH, freeze_outside_ball
from falsework.stability.cpu.panels import factor_panels, solve_panels
from falsework.utils.kernels import njit


@njit(nogil=True, cache=True)
def press_responses(law, before, state, pressed, springs, torn, set_share, points, forces, moves):
    """Write the spring forces after a release, and by how much unit wrenches of robots change them.

    Parts more than `REACH` contacts away stay where they are.

    Args:
        law: as in `settle_step`.
        before, state: state before and after a part is released, shape (parts,).
        pressed: held parts on which robots press, shape (n,).
        springs, torn, set_share: the history before the release, as in `HistoryArrays`.
        points: out: contact points whose forces follow, shape (points,).
        forces: out: scaled spring forces without pressing, then their change by each component of a whitened wrench on
            the first, second, ... pressed part, in the order of `points`, shape (1 + 6 n, points, 3).
        moves: out: the whitened movements of the pressed parts that belong to them, shape (1 + 6 n, 6 n).

    Returns:
        Number of contact points; 0 where there is no response.
    """
    contact, parts, structure = make_contact_scratch(law), len(state), law.structure
    work, near = contact.work, np.empty(parts, np.uint8)
    origin, moving = np.empty(parts, np.uint8), np.empty(parts, np.uint8)
    position = structure.elimination.position
    nothing = np.zeros((0, 6))
    set_holds(law, before, state, pressed, nothing, contact, moving, origin)
    freeze_outside_ball(structure, moving, origin, REACH, near)
    missing = np.zeros((len(work.free), 6))
    history = HistoryArrays(missing, springs, torn, set_share)
    pairs, count = load_history(law, near, contact, history, missing, 0.0)
    if count == 0:
        return 0
    contact.displacement[:] = 0.0
    evaluate(law, contact, pairs, contact.displacement, contact.trial, contact.residual)
    total = work.start[pairs]
    for j in range(total):
        work.friction[j] = 1.0 / NEGLIGIBLE
    lay_out_panels(structure, work.free, work.panels)
    assemble_tangent(law, contact, pairs, NEGLIGIBLE)
    if not factor_panels(structure.elimination.supernode, work.panels, pairs < 0):
        return 0
    step = contact.step
    for column in range(1 + 6 * len(pressed)):
        for j in range(len(work.free)):
            for r in range(6):
                # What robots bear stays; the released part is carried by its contacts.
                loaded = column == 0 and work.free[j] and contact.grip[j] == 0.0
                step[j, r] = contact.residual[j, r] if loaded else 0.0
        if column > 0:
            step[position[pressed[(column - 1) // 6]], (column - 1) % 6] = 1.0
        solve_panels(work.panels, step, False)
        for k in range(len(pressed)):
            for r in range(6):
                moves[column, 6 * k + r] = step[position[pressed[k]], r]
        for p in range(pairs):
            s0, s1, s2, s3, s4, s5 = pair_velocity(
                structure.transfer_a, structure.transfer_b, work.pair[p], work.slot_a[p], work.slot_b[p], step
            )
            shift = structure.pair_start[work.pair[p]] - work.start[p]
            for j in range(work.start[p], work.start[p + 1]):
                points[j] = j + shift
                d0, d1, d2 = point_velocity(work.basis, j, s0, s1, s2, s3, s4, s5)
                closed = 1.0 if contact.trial[j, 0] + contact.pull[j] >= 0.0 or contact.stick[j] > 0.0 else 0.0
                forces[column, j, 0] = -closed * contact.normal[j] * d0
                forces[column, j, 1] = -closed * contact.tangential[j] * d1
                forces[column, j, 2] = -closed * contact.tangential[j] * d2
                if column == 0:
                    for r in range(3):
                        forces[0, j, r] += closed * contact.offset[j, r]
    return total
