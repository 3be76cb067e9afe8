"""Replays of the candidates of a beam, several at a time in large structures."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Level, PackedLevel
from falsework.search.beam.histories import Histories
from falsework.utils.cores import core_count

if TYPE_CHECKING:
    from falsework.stability.contact.replay import History
    from falsework.stability.contact.varied_replay import AnyReplayer

_MANY_PARTS = 128
"""Parts from which replays run side by side; in smaller structures each takes a few milliseconds."""
_Result = tuple[bool, "History | None"]
"""Whether a candidate comes to rest, and its history then."""


class Replays:
    """Replays of the candidates of a beam, and the contact histories of its states."""

    def __init__(self, replayer: AnyReplayer, levels: list[Level | PackedLevel]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            levels: of the beam; the list that the beam itself changes.
        """
        self.histories, self._levels, self._replayer = Histories(replayer, levels), levels, replayer
        large = replayer.problem.parts >= _MANY_PARTS
        self._cores = (replayer.settings.cpu.threads or core_count()) if large else 1
        self._pool = ThreadPoolExecutor(self._cores)
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
        stands = np.zeros(len(rows), dtype=bool)
        found = self._replay(parent, states)
        for i, (row, (good, history)) in enumerate(zip(rows.tolist(), found, strict=True)):
            if good and history is not None:
                stands[i], self._next[row] = True, history
        return stands

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Take over the histories of the candidates that became the last level, shape (kept,)."""
        level = len(self._levels) - 1
        for place, row in enumerate(rows.tolist()):
            if row in self._next:
                self.histories.put(level, place, self._next[row])
        self._next = {}
        self.histories.drop_oldest()

    def rewind(self, level: int) -> None:
        """Forget all levels after `level`."""
        self._next = {}
        self.histories.rewind(level)

    def _replay(self, parent: NDArray[np.int64], states: States) -> list[_Result]:
        """Return whether candidates come to rest when reached from rows of the last level, and their histories."""
        level, found = len(self._levels) - 1, list[_Result]()
        for first in range(0, len(states), self._cores):
            origins = parent[first : first + self._cores].tolist()
            histories = [self.histories.of(level, origin) for origin in origins]
            before = self._levels[level].states[origins]
            steps = list(zip(histories, before, states[first : first + self._cores], strict=True))
            beside = [self._pool.submit(_step, self._replayer.unlimited(), *step) for step in steps[1:]]
            found += [_step(self._replayer, *steps[0]), *(later.result() for later in beside)]
        return found


def _step(replayer: AnyReplayer, history: History | None, before: States, after: States) -> _Result:
    return (False, None) if history is None else replayer.step(history, before, after)
