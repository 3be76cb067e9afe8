"""Proofs of the states of a route, each accepted by the certificate checker."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.oracle import Stability
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Verdicts

_PROVED_AT_ONCE = 64
"""States whose contact forces are in memory together, unless all are kept."""
_LARGE = 100
"""Parts from which states are proved from the displacement of the state before, which takes fewer iterations ..."""
_PIECES = 8
"""... in so many pieces of the route side by side, each begun from rest."""


class _Proofs:
    """Verdicts on the states of a route, and what of their proofs is kept."""

    def __init__(self, states: States, oracle: Stability, forces: bool) -> None:
        """Begin with undecided states, shape (states, parts)."""
        points, contact = oracle.problem.points, oracle.settings.criterion == "contact"
        self.verdicts = Verdicts.blank(
            len(states),
            points=points if forces and contact else None,
            parts=oracle.problem.parts if forces and contact else None,
            displaced=contact,
        )
        # Under `equilibrium` most forces are those of the state before; a displacement changes everywhere.
        self.forces = StateArrays(len(states), points, 3) if forces and not contact else None

    def put(self, rows: NDArray[np.int64], found: Verdicts) -> None:
        """Keep verdicts on some states, with their proofs."""
        self.verdicts.put(rows, found)
        if self.forces is not None and found.forces is not None:
            self.forces[rows[found.stable]] = found.forces[found.stable]


def prove(states: States, oracle: Stability, *, forces: bool) -> tuple[Verdicts, StateArrays | None]:
    """Check the states of a route: from what the search found them stable by, else one after the other.

    Args:
        states: shape (states, parts).
        oracle: checks them.
        forces: keep the proofs.

    Returns:
        Verdicts, under `contact` with the proofs; under `equilibrium` the forces apart.
    """
    proofs = _Proofs(states, oracle, forces)
    for first in range(0, len(states), _PROVED_AT_ONCE):
        rows = np.arange(first, min(first + _PROVED_AT_ONCE, len(states)))
        proofs.put(rows, oracle.check_again(states[rows]))
    rest = np.flatnonzero(~proofs.verdicts.stable)
    if len(rest):
        _prove_in_order(states, rest, oracle, proofs)
    for row in np.flatnonzero(~proofs.verdicts.stable):
        beside = states[max(row - 1, 0) : row + 2]
        proofs.put(np.array([row]), oracle.check_beside(states[row], beside))
    return proofs.verdicts, proofs.forces


def _prove_in_order(states: States, rest: NDArray[np.int64], oracle: Stability, proofs: _Proofs) -> None:
    """Check states of a route; those of a large structure from the displacement or forces of the state before.

    Args:
        states: shape (states, parts).
        rest: rows to be checked, ascending.
        oracle: checks them.
        proofs: out: verdicts on them, and proofs.
    """
    length = -(-len(rest) // _PIECES)
    if oracle.settings.solver == "gpu" or states.shape[1] < _LARGE:
        length = 1
    begins = np.arange(0, len(rest), length)
    at_once = _PIECES if length > 1 else _PROVED_AT_ONCE
    for first in range(0, len(begins), at_once):
        begun = begins[first : first + at_once]
        found = oracle.check(states[rest[begun]])
        proofs.put(rest[begun], found)
        for offset in range(1, length):
            inside = begun + offset < len(rest)
            begun = begun[inside]
            here, before = rest[begun + offset], rest[begun + offset - 1]
            found = oracle.check_next(states[here], states[before], found[inside])
            proofs.put(here, found)
