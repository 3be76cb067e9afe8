"""Check of claimed margins, such as those of a plan file, without a new search for the bounds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.margins.brackets import ACCURACY
from falsework.stability.margins.conditions import Answer, Condition
from falsework.stability.margins.margins import DIRECTIONS, LARGEST_SHARE, MarginFinder
from falsework.stability.margins.prober import Prober

_WITHIN = [1.0, 1.0 + ACCURACY / 4, 1.0 + ACCURACY / 2]
"""Factors by which a state may miss a claimed bound: numbers are rounded, and not exact."""


class MarginClaims:
    """Checker of claimed margins of states of one structure."""

    def __init__(self, prober: Prober) -> None:
        """Take the structure and its criterion from a prober."""
        self._finder = MarginFinder(prober)

    def holds(self, state: States, kind: str, value: float | None) -> bool:
        """Return whether a state is stable at a claimed margin, within 1 %.

        Args:
            state: shape (parts,).
            kind: `friction`, `tilt`, `horizontal` or `push`.
            value: the margin, SI units; None claims that it is unbounded.
        """
        prober = self._finder.prober
        if kind == "friction":
            tried = ((value or 0.0) * factor for factor in _WITHIN)
            return any(prober.ask(state, Condition(friction, prober.own().extra)).stands for friction in tried)
        near = start = prober.ask(state, prober.own())
        if not start.stands:
            return False
        for load in self._loads(state, kind, value):
            for factor in _WITHIN:
                condition = Condition(start.condition.friction, load / factor)
                answer = prober.ask(state, condition, near)
                if not answer.stands and near is not start:
                    answer = prober.ask(state, condition, start)
                if not answer.stands and not prober.convex:
                    answer = self._continuation(state, condition, start)
                if answer.stands:
                    near = answer
                    break
            else:
                return False
        return True

    def _continuation(self, state: States, condition: Condition, start: Answer) -> Answer:
        """Return the answer under a load that is increased, by half of what is left each time."""
        answer = start
        left = 1.0
        while left > 0.0:
            left = left / 2 if left > ACCURACY else 0.0
            step = Condition(condition.friction, (1.0 - left) * condition.extra)
            answer = self._finder.prober.ask(state, step, answer if answer.stands else start, coarse=left > 0.0)
        return answer

    def _loads(self, state: States, kind: str, value: float | None) -> Iterator[NDArray[np.float64]]:
        """Yield the loads of a margin at a value, shape (parts, 6) each: N and Nm."""
        finder = self._finder
        if kind == "push":
            pushes = finder.pushes
            most = LARGEST_SHARE * finder.prober.problem.weight if value is None else value
            yield from most * pushes.loads(pushes.exposed(state), len(state))
            return
        for row in range(DIRECTIONS):
            if kind == "tilt" and value is not None:
                yield finder.tilt_load(row, value)
            else:
                share = LARGEST_SHARE if value is None else value
                yield share * finder.sideways[row]
