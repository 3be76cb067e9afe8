"""Loads of robots in the states of a build: the force and the moment on every part that they hold."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, States
from falsework.stability.holds import HoldLoad

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
