"""Proofs of the states of a route, each accepted by the certificate checker."""

from __future__ import annotations

import numpy as np

from falsework.assembly.state import States
from falsework.stability.oracle import StabilityOracle
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Verdicts

_PROVED_AT_ONCE = 64
"""States whose contact forces are in memory together, unless all are kept."""


def prove(states: States, oracle: StabilityOracle, *, forces: bool) -> tuple[Verdicts, StateArrays | None]:
    """Prove the states of a route: from what the search found them stable by, else from states before and after.

    Args:
        states: shape (states, parts).
        oracle: proves them, under a criterion without history.
        forces: keep the proofs.

    Returns:
        Verdicts, and the forces that prove them.
    """
    verdicts = Verdicts.all_undecided(len(states))
    kept = StateArrays(len(states), oracle.problem.points, 3) if forces else None
    for beside in (-1, 1):
        for first in range(0, len(states), _PROVED_AT_ONCE):
            rows = np.arange(first, min(first + _PROVED_AT_ONCE, len(states)))
            rows = rows[~verdicts.stable[rows]]
            if not len(rows):
                continue
            near = states[np.clip(rows + beside, 0, len(states) - 1)]
            found = oracle.verdicts(states[rows], near=near, require_certificate=True)
            verdicts.put(rows, found)
            if kept is not None and found.forces is not None:
                kept[rows[found.stable]] = found.forces[found.stable]
    return verdicts, kept
