"""Loads of robots in the states of a build: the force and the moment on every part that they hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, States
from falsework.stability.certificate import chunks
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.holds import HoldLoad
from falsework.stability.second_order.springs import into_cone
from falsework.stability.settings import StabilitySettings
from falsework.stability.strength import strength_of

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.problem import Problem

Array = NDArray[np.float64]
Loads = tuple[tuple[HoldLoad, ...], ...]
"""Loads of robots in each state of a plan, one entry a state."""


CLOSE = 0.01
"""Share by which two evaluations of the same build may differ in what robots bear."""


def loads_in(assembly: Assembly, state: States, wrenches: Array) -> tuple[HoldLoad, ...]:
    """Return what robots bear in a state.

    Args:
        state: shape (parts,).
        wrenches: on each held part about its centre of mass, N and N m, shape (parts, 6).
    """
    held = np.flatnonzero((state == HELD) & ~assembly.immovable)
    force, moment = (np.linalg.norm(wrenches[held, some], axis=1) for some in (slice(3), slice(3, 6)))
    return tuple(map(HoldLoad, held.tolist(), force.tolist(), moment.tolist()))


def loads_of_build(
    assembly: Assembly, problem: Problem, settings: StabilitySettings, states: States, histories: Sequence[History]
) -> Loads:
    """Return what robots bear in the states of a replay.

    Args:
        problem: its equilibrium problem.
        settings: cone, gravity and reserve of the replay.
        states: in assembly order, shape (states, parts).
        histories: after each of these states.
    """
    geometry = geometry_of(assembly.contacts, assembly.mass)
    whole, loads = strength_of(assembly, settings.gravity, settings.reserve), assembly.applied_wrench(settings.gravity)
    joints, found = assembly.joints, []
    # Where joints set or break, every state has contacts of its own strength.
    rows = np.arange(len(histories))
    alone = (joints is not None and joints.setting) or any(history.torn.any() for history in histories)
    for together in np.split(rows, rows[1:]) if alone else chunks(rows, len(whole.friction)):
        some, here = [histories[row] for row in together], states[together]
        strength = whole.at(some[0].torn, some[0].age, joints)
        springs = np.stack([history.springs for history in some]) * problem.force_scale[:, None]
        forces = np.where(
            geometry.present(here)[..., None], into_cone(springs, strength, settings.friction_cone)[0], 0.0
        )
        wrenches = -(geometry.wrenches(forces) + loads)
        found += [loads_in(assembly, state, wrench) for state, wrench in zip(here, wrenches, strict=True)]
    return tuple(found)


def larger_loads(some: Loads, others: Loads) -> Loads:
    """Return the larger of two forces, and of two moments, for every part held in the states of one plan."""
    return tuple(
        tuple(
            HoldLoad(one.part, max(one.force, other.force), max(one.moment, other.moment))
            for one, other in zip(here, there, strict=True)
        )
        for here, there in zip(some, others, strict=True)
    )


def largest_load(loads: Iterable[Iterable[HoldLoad]]) -> tuple[float, float]:
    """Return the largest force, N, and the largest moment, N m; zero where nothing is held."""
    every = [load for state in loads for load in state]
    return max((load.force for load in every), default=0.0), max((load.moment for load in every), default=0.0)
