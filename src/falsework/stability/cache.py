"""Cache of verdicts, and inference of further verdicts by two monotonicity rules.

Among states with the same parts present, holding more parts preserves equilibrium and holding fewer preserves
instability. The certificates carry over: forces that balance a part balance it whichever other parts are held, and a
velocity that no admissible forces can stop remains one when a held part, which does not move in it, is released.

Under the criterion `contact` only the second rule holds: a held part no longer presses on its neighbours, and one that
leant on it may slide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, States
from falsework.stability.verdict import Verdict


class VerdictCache:
    """Cache of verdicts by the sets of present and of held parts, as bit sets."""

    def __init__(self, limit: int = 2_000_000, *, holds_keep_stable: bool = True) -> None:
        """Create an empty cache.

        Args:
            limit: verdicts kept.
            holds_keep_stable: whether a stable state stays stable when more parts are held.
        """
        self._holds_keep_stable = holds_keep_stable
        self._known: dict[bytes, dict[Verdict, dict[int, float]]] = {}
        self._size = 0
        self._limit = limit

    def __len__(self) -> int:
        return self._size

    def look_up(self, states: States) -> tuple[NDArray[np.int8], NDArray[np.float64], NDArray[np.bool_]]:
        """Return verdicts and residuals of states that are cached or follow from a cached one; 0 and NaN elsewhere.

        Returns:
            Verdict, residual, and whether it follows from a rule; each of shape (batch,).
        """
        verdict = np.zeros(len(states), np.int8)
        residual = np.full(len(states), np.nan)
        by_monotonicity = np.zeros(len(states), bool)
        for row, (present, held) in enumerate(_keys(states)):
            entry = self._known.get(present)
            if entry is None:
                continue
            exact = next((value for value, known in entry.items() if held in known), None)
            if exact is not None:
                verdict[row], residual[row] = exact, entry[exact][held]
                continue
            found, value = None, Verdict.STABLE
            if self._holds_keep_stable:
                found = next((r for h, r in entry.get(value, {}).items() if h & held == h), None)
            if found is None:
                value = Verdict.UNSTABLE
                found = next((r for h, r in entry.get(value, {}).items() if h & held == held), None)
            if found is not None:
                verdict[row], residual[row], by_monotonicity[row] = value, found, True
        return verdict, residual, by_monotonicity

    def store(self, states: States, verdict: NDArray[np.int8], residual: NDArray[np.float64]) -> None:
        """Store decided verdicts; clear the cache first when it is full."""
        if self._size + len(states) > self._limit:
            self._known.clear()
            self._size = 0
        for (present, held), value, left in zip(_keys(states), verdict.tolist(), residual.tolist(), strict=True):
            if value == Verdict.UNDECIDED:
                continue
            entry = self._known.setdefault(present, {})
            for other in entry.values():  # a closer look may have changed the verdict
                self._size -= other.pop(held, None) is not None
            entry.setdefault(Verdict(value), {})[held] = left
            self._size += 1


def _keys(states: States) -> list[tuple[bytes, int]]:
    """Return present parts as bytes and held parts as an integer, for every state."""
    present = np.packbits(states != REMOVED, axis=1)
    held = np.packbits(states == HELD, axis=1)
    return [(p.tobytes(), int.from_bytes(h.tobytes(), "big")) for p, h in zip(present, held, strict=True)]


def unique_rows(states: States) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first row of every distinct state, ascending, and for each row the index of its distinct state."""
    if len(states) == 1:
        return np.zeros(1, np.intp), np.zeros(1, np.intp)
    keys = np.ascontiguousarray(states).view(np.dtype((np.void, states.shape[1]))).ravel()
    _, first, back = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[back]


def root_rows(states: States, near: States, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rows whose near state is none of the others; all if there are none."""
    asked = {states[row].tobytes(): row for row in rows}
    first = [row for row in rows if asked.get(near[row].tobytes(), row) == row]
    return np.array(first, dtype=np.intp) if first else rows
