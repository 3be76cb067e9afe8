"""Replays of the candidates of a beam, on another core than the verdicts."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event
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
"""Parts from which replays run beside verdicts; in smaller structures both take a few milliseconds."""
_PATIENCE = 0.002
"""Seconds after which such a replay begins: by then most unstable states are recognized, whose replay is not needed."""
_FEW_STEPS = 8
"""Steps to the history that such a replay begins with, at most: it does not look at the deadline."""

_Result = tuple[bool, "History | None"]
"""Whether a candidate comes to rest, and its history then."""


class _Ahead:
    """Replay of a candidate in another thread."""

    def __init__(self, row: int) -> None:
        """Begin without a verdict on a candidate, given by its number."""
        self.row = row
        self.decided = Event()
        """There is a verdict ..."""
        self.wanted = True
        """... and the result is of use."""
        self.result: Future[_Result | None] = Future()


class Replays:
    """Replays of the candidates of a beam, and the contact histories of its states.

    In a large structure, and with more than one core, the replay of a candidate begins while the verdict on it is
    sought. That changes the time of a search, and nothing else.
    """

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
        self._ahead: _Ahead | None = None
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
        begun = self._begun(int(rows[0])) if len(rows) == 1 else None
        found = self._replay(parent, states) if begun is None else [begun]
        for i, (row, (good, history)) in enumerate(zip(rows.tolist(), found, strict=True)):
            if good and history is not None:
                stands[i], self._next[row] = True, history
        return stands

    @property
    def run_ahead(self) -> bool:
        """Whether a replay that begins while the verdict is sought saves time."""
        return self._cores > 1

    def expect(self, row: int, parent: int, state: States) -> None:
        """Begin the replay of a candidate while the verdict on it is sought.

        Args:
            row: number of the candidate.
            parent: row of the last level that it comes from.
            state: shape (parts,).
        """
        self.dismiss()
        self._ahead = ahead = _Ahead(row)
        ahead.result = self._pool.submit(self._replay_ahead, ahead, len(self._levels) - 1, parent, state)

    def dismiss(self) -> None:
        """Give up the replay that `expect` began; its thread reads no level from now on."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            ahead.wanted = False
            ahead.decided.set()
            ahead.result.cancel()
            with self.histories.lock:  # its thread may be on its way to the first history
                return

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
        self.dismiss()
        self._next = {}
        self.histories.rewind(level)

    def _begun(self, row: int) -> _Result | None:
        """Return the result of the replay that was begun for a candidate; None where there is none."""
        ahead = self._ahead
        if ahead is None or ahead.row != row:
            return None
        self._ahead = None
        ahead.decided.set()
        # Behind replays that were given up it has not begun.
        return None if ahead.result.cancel() else ahead.result.result()

    def _replay_ahead(self, ahead: _Ahead, level: int, parent: int, state: States) -> _Result | None:
        """Replay a candidate in another thread; None where that is not wanted any more, or would take too long."""
        ahead.decided.wait(_PATIENCE)
        replayer = self._replayer.unlimited()
        with self.histories.lock:
            if not ahead.wanted or self.histories.steps_to(level, parent) > _FEW_STEPS:
                return None
            history, before = self.histories.of(level, parent, replayer), self._levels[level].states[parent]
        return _step(replayer, history, before, state)

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
