"""Contact histories of the states of a beam in the order of assembly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Level, PackedLevel

if TYPE_CHECKING:
    from falsework.stability.contact.replay import History
    from falsework.stability.contact.varied_replay import AnyReplayer
    from falsework.stability.problem import Problem

_HISTORY_BYTES = 256 << 20
"""Memory for histories; the earliest are computed anew where they are needed again."""


def histories_in_memory(problem: Problem) -> int:
    """Return how many contact histories of a structure a search keeps."""
    displacements_and_springs = 8 * (6 * problem.parts + 3 * problem.points)
    torn_and_age = (1 + 4) * problem.points
    return _HISTORY_BYTES // (displacements_and_springs + torn_and_age)


class Histories:
    """Contact histories of the states of a beam, computed on demand."""

    def __init__(self, replayer: AnyReplayer, levels: list[Level | PackedLevel]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            levels: of the beam; the list that the beam itself changes.
        """
        self._replayer = replayer
        self._levels = levels
        self._most = histories_in_memory(replayer.problem)
        self._known: list[dict[int, History | None]] = []
        self._moved: list[dict[int, tuple[float, int]]] = []
        """Of the states at rest: the largest movement of a part, and that part."""
        self._next: dict[int, History] = {}

    def standing(self, rows: NDArray[np.int64], parent: NDArray[np.int64], states: States) -> Mask:
        """Return whether each candidate comes to rest when reached from its parent in the last level.

        Args:
            rows: numbers of the candidates, by which `keep` names them, shape (rows,).
            parent: row of the last level that each comes from, shape (rows,).
            states: shape (rows, parts).

        Returns:
            Shape (rows,).
        """
        level = len(self._levels) - 1
        stands = np.zeros(len(rows), dtype=bool)
        for i, (row, origin) in enumerate(zip(rows.tolist(), parent.tolist(), strict=True)):
            history = self._history(level, origin)
            if history is not None:
                stands[i], after = self._replayer.step(history, self._levels[level].states[origin], states[i])
                if stands[i]:
                    self._next[row] = after
        return stands

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Take over the histories of the candidates that became the last level, shape (kept,)."""
        self._fit(len(self._levels) - 1)
        level = len(self._known)
        self._fit(level + 1)
        for i, row in enumerate(rows.tolist()):
            if row in self._next:
                self._store(level, i, self._next[row])
        self._next = {}
        self._drop_oldest()

    def rewind(self, level: int) -> None:
        """Forget all levels after `level`."""
        del self._known[level + 1 :], self._moved[level + 1 :]
        self._next = {}

    def largest_movement(self, row: int) -> tuple[float, int] | None:
        """Return how far a part has moved at most on the way to a state of the last level, m, and that part.

        Returns:
            None where a state on the way does not come to rest.
        """
        level = len(self._levels) - 1
        if self._history(level, row) is None:
            return None
        most = (0.0, -1)
        for number in range(level, -1, -1):
            most = max(most, self._moved[number][row])
            row = int(self._levels[number].parent[row])
        return most

    def _history(self, level: int, row: int) -> History | None:
        """Return the history of a state of a level; None where the way to it does not stand."""
        self._fit(len(self._levels))
        way = [row]
        while way[-1] not in self._known[level + 1 - len(way)] and len(way) <= level:
            way.append(int(self._levels[level + 1 - len(way)].parent[way[-1]]))
        first = level + 1 - len(way)
        history = self._known[first].get(way[-1])
        if history is None and first == 0 and way[-1] not in self._known[0]:
            start = self._replayer.replay(self._levels[0].states[way[-1]][None])
            history = start.histories[0] if start.histories else None
            self._store(0, way[-1], history)
        for at in range(first + 1, level + 1):
            before, after = way[level + 1 - at], way[level - at]
            if history is not None:
                states = self._levels[at - 1].states[before], self._levels[at].states[after]
                stands, history = self._replayer.step(history, *states)
                history = history if stands else None
            self._store(at, after, history)
        return history

    def _store(self, level: int, row: int, history: History | None) -> None:
        """Remember the history of a state, None where the way to it does not stand."""
        self._known[level][row] = history
        if history is not None:
            self._moved[level][row] = history.moved, history.part

    def _fit(self, count: int) -> None:
        """Make room for the histories of `count` levels."""
        self._known.extend({} for _ in range(count - len(self._known)))
        self._moved.extend({} for _ in range(count - len(self._moved)))

    def _drop_oldest(self) -> None:
        """Forget the histories of the earliest levels where they take too much memory."""
        count = sum(map(len, self._known))
        for known in self._known[1:-1]:
            if count <= self._most:
                return
            count -= len(known)
            known.clear()
