"""Replays of the candidates of a beam."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Level, PackedLevel
from falsework.search.beam.histories import Histories

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.varied_replay import AnyReplayer


class Replays:
    """Replays of the candidates of a beam, and the contact histories of its states."""

    def __init__(self, replayer: AnyReplayer, levels: list[Level | PackedLevel]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            levels: of the beam; the list that the beam itself changes.
        """
        self.histories, self._levels, self._replayer = Histories(replayer, levels), levels, replayer
        self._next: dict[int, History] = {}

    def comes_to_rest(self, rows: NDArray[np.int64], parent: NDArray[np.int64], states: States) -> Mask:
        """Return whether each candidate comes to rest when reached from its parent in the last level.

        Args:
            rows: numbers of the candidates, by which `keep` names them, shape (rows,).
            parent: row of the last level that each comes from, shape (rows,).
            states: shape (rows, parts).

        Returns:
            Shape (rows,).
        """
        stands, level = np.zeros(len(rows), dtype=bool), len(self._levels) - 1
        for i, (row, origin, state) in enumerate(zip(rows.tolist(), parent.tolist(), states, strict=True)):
            history = self.histories.get(level, origin)
            if history is not None:
                stands[i], after = self._replayer.step(history, self._levels[level].states[origin], state)
                if stands[i]:
                    self._next[row] = after
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
