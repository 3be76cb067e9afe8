"""Forces and moments that robots exert on held parts, and largest settlements of supports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States
from falsework.stability.certificate import residual_of_forces
from falsework.stability.margins.brackets import FLOOR, Interval, largest
from falsework.stability.margins.conditions import Answer, OutOfTime
from falsework.stability.margins.prober import Prober
from falsework.stability.margins.state_margins import HeldLoad, triple
from falsework.stability.second_order.springs import springs_of_displacement
from falsework.stability.stiffness import MOVEMENT, structure_size

Array = NDArray[np.float64]

_DEEPEST = 0.9
"""Largest settlement, as a share of the displacement limit: parts settle under their own weight too."""


def held_loads(prober: Prober, state: States, start: Answer) -> tuple[HeldLoad, ...]:
    """Return the load on each robot: the weight of its part, and the forces of the parts in contact with it.

    Under `contact` the forces follow from the contact law; under `equilibrium` they are one of possibly many sets
    that balance the state.

    Args:
        state: shape (parts,).
        start: the stable answer for the unmodified state.
    """
    held = np.flatnonzero((state == HELD) & ~prober.assembly.immovable)
    net = prober.problem.gravity_wrench + prober.contact_wrench(state, prober.forces(state, start))
    return tuple(HeldLoad(int(part), *(triple(-net[part, rows]) for rows in (slice(3), slice(3, 6)))) for part in held)


def settlements(prober: Prober, state: States, start: Answer) -> tuple[tuple[int, float | None], ...]:
    """Return the largest settlement of each boundary part that carries load, with the others in place.

    A settlement is imposed on one fixed part; the others follow by the contact law and come to rest within the
    displacement limit or not. So a settlement of nearly a thousandth of the structure counts as unbounded.

    Args:
        state: shape (parts,).
        start: the stable answer for the unmodified state.

    Returns:
        Boundary parts with settlements in m, None where there is no bound.

    Raises:
        OutOfTime: the time of the prober is over.
    """
    assembly, problem, claim, depths = prober.assembly, prober.problem, prober.settings.claim, []
    active, geometry = problem.active(state[None])[0], problem.geometry
    cap = _DEEPEST * MOVEMENT * structure_size(assembly)
    for part in np.flatnonzero(assembly.boundary).tolist():
        if not (active & ((geometry.part_a == part) | (geometry.part_b == part))).any():
            continue
        sunk = np.zeros((problem.parts, 6))
        sunk[part, 2] = -1.0

        def probe(depth: float, near: Answer, sunk: Array = sunk) -> Answer:
            answer = prober.ask(state, start.condition, near, moved=depth * sunk)
            if answer.displacement is None:
                return answer
            springs = springs_of_displacement(assembly, state[None], (answer.displacement + depth * sunk)[None], claim)
            left = residual_of_forces(assembly, state[None], springs.forces, claim)[0]
            return answer if left <= claim.tolerance else replace(answer, stands=False)

        bracket = largest(probe, Interval(start, guess=0.5 * cap, cap=cap, floor=FLOOR * cap))
        if not bracket.finished:
            raise OutOfTime
        depths.append((part, None if bracket.outside is None else float(bracket.inside)))
    return tuple(depths)
