"""Compiled search for the rest position of one state under several loads, without the GIL."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.kernel import lacks_contact, place_contacts, read_displacement, write_displacement
from falsework.stability.contact.newton import MOVES_AWAY, RESTS, make_contact_scratch, solve_statics
from falsework.stability.cpu.layout import make_scratch, restrict
from falsework.stability.cpu.termination import MARGIN
from falsework.utils.kernels import njit


@njit(nogil=True, cache=True)
def rest_under(
    structure, contact_structure, state, loads, moved, options, displacement, warm, after, result, residual, iterations
):
    """Search for the rest position of a state under each load; the law is that of `solve_contact_state`.

    The search ends with the first load under which none is found.

    Args:
        structure, contact_structure, options: as in `solve_contact_state`; without iterations from rest, the result
            from the guesses counts.
        state: shape (parts,).
        loads: wrenches on the parts, N and Nm, shape (loads, parts, 6).
        moved: scaled spring forces of the contact points at zero displacement, caused by displaced fixed parts,
            shape (points, 3) or (0, 3).
        displacement: in: guesses in m and rad where `warm`; out: displacements, shape (loads, parts, 6).
        warm: whether `displacement` holds guesses.
        after: for each load, an earlier one whose displacement is the guess; -1 for its own.
        result, residual, iterations: out, one entry per load.

    Returns:
        Number of loads that were tried.
    """
    work, contact = make_scratch(structure), make_contact_scratch(structure)
    order, turn = structure.elimination.order, structure.acceleration
    pairs, count = restrict(structure, state, work)
    adrift = count > 0 and lacks_contact(work, contact, pairs)
    place_contacts(structure, contact_structure, state, work, contact, pairs)
    for p in range(pairs if len(moved) else 0):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            for r in range(3):
                contact.offset[j, r] = moved[j + shift, r]
    tolerance = (1.0 - MARGIN) * options.tolerance
    mends = pairs >= 0  # not a literal, for which numba would recompile the search
    for k in range(len(loads)):
        iterations[k] = 0
        if count == 0 or adrift:
            result[k], residual[k] = (MOVES_AWAY, np.inf) if adrift else (RESTS, 0.0)
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
        if warm:
            guess = displacement[k if after[k] < 0 else after[k]]
            read_displacement(structure, contact_structure, work, guess, contact.displacement)
            result[k], residual[k], iterations[k] = solve_statics(
                structure,
                contact_structure,
                work,
                contact,
                pairs,
                options.warm_steps,
                tolerance,
                options.warm_first_step,
                mends,
                options.schedule,
            )
        if not warm or (result[k] != RESTS and options.steps > 0):
            contact.displacement[:] = 0.0
            result[k], residual[k], taken = solve_statics(
                structure,
                contact_structure,
                work,
                contact,
                pairs,
                options.steps,
                tolerance,
                options.first_step,
                mends,
                options.schedule,
            )
            iterations[k] += taken
        displacement[k] = 0.0
        write_displacement(structure, contact_structure, work, contact.displacement, displacement[k])
        if result[k] != RESTS:
            return k + 1
    return len(loads)
