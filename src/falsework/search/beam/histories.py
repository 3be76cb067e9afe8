"""Contact histories of the states of a beam in the order of assembly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from falsework.search.beam.frontier import Level, PackedLevel
from falsework.stability.holds import Press

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.varied_replay import AnyReplayer

ReplaySummary = tuple[float, int, None, tuple[tuple[Press, ...], ...]]
"""Replay of a route that comes to rest: the largest movement of a part in m, that part, no state at which it fails, and
the presses of the step to each state, as `PlanReplay` takes them."""
_HISTORY_BYTES = 256 << 20
"""Memory for histories; the earliest are computed anew where they are needed again."""


def histories_in_memory(history: History) -> int:
    """Return how many contact histories of the size of one a search keeps."""
    return _HISTORY_BYTES // max(history.nbytes, 1)


class Histories:
    """Contact histories of the states of a beam, computed on demand."""

    def __init__(self, replayer: AnyReplayer, levels: list[Level | PackedLevel]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            levels: of the beam; the list that the beam itself changes.
        """
        self.replayer = replayer
        self._levels = levels
        self._most: float = np.inf
        self._known: list[dict[int, History | None]] = []
        self._known_steps: list[dict[int, tuple[float, int, tuple[Press, ...]]]] = []
        """Of the states at rest: the largest movement of a part, that part, and the presses of the step."""

    def get(self, level: int, row: int) -> History | None:
        """Return the history of a state of a level; None where the way to it does not stand.

        Args:
            level: index of the level.
            row: of the state in the level.
        """
        replayer = self.replayer
        path = self._path(level, row)
        first = level + 1 - len(path)
        history = self._known[first].get(path[-1])
        if history is None and first == 0 and path[-1] not in self._known[0]:
            start = replayer.replay(self._levels[0].states[path[-1]][None])
            history = start.histories[0] if start.histories else None
            self.put(0, path[-1], history)
        for at in range(first + 1, level + 1):
            before, after = path[level + 1 - at], path[level - at]
            if history is not None:
                states = self._levels[at - 1].states[before], self._levels[at].states[after]
                stands, history = replayer.step(history, *states)
                history = history if stands else None
            self.put(at, after, history)
        return history

    def put(self, level: int, row: int, history: History | None) -> None:
        """Remember the history of a state, None where the way to it does not stand."""
        self._fit(level + 1)
        self._known[level][row] = history
        if history is not None:
            self._most = histories_in_memory(history)
            self._known_steps[level][row] = history.moved, history.part, history.presses

    def drop_oldest(self) -> None:
        """Forget the histories of the earliest levels where they take too much memory."""
        count = sum(map(len, self._known))
        for known in self._known[1:-1]:
            if count <= self._most:
                return
            count -= len(known)
            known.clear()

    def rewind(self, level: int) -> None:
        """Forget all levels after `level`."""
        del self._known[level + 1 :], self._known_steps[level + 1 :]

    def summary(self, row: int) -> ReplaySummary | None:
        """Return the replay of the way to a state of the last level.

        Returns:
            How far a part moves at most, m, that part, None since no state falls, and the presses of the step to each
            state, as `PlanReplay` takes them; None where a state on the way does not come to rest.
        """
        level = len(self._levels) - 1
        if self.get(level, row) is None:
            return None
        most, presses = (0.0, -1), list[tuple[Press, ...]]()
        for number in range(level, -1, -1):
            moved, part, pressed = self._known_steps[number][row]
            most = max(most, (moved, part))
            presses.append(pressed)
            row = int(self._levels[number].parent[row])
        return most[0], most[1], None, tuple(presses[::-1])

    def _path(self, level: int, row: int) -> list[int]:
        """Return the rows, level by level, from a state back to one whose history is known, or to the first level."""
        self._fit(len(self._levels))
        path = [row]
        while path[-1] not in self._known[level + 1 - len(path)] and len(path) <= level:
            path.append(int(self._levels[level + 1 - len(path)].parent[path[-1]]))
        return path

    def _fit(self, count: int) -> None:
        """Make room for the histories of `count` levels."""
        self._known.extend({} for _ in range(count - len(self._known)))
        self._known_steps.extend({} for _ in range(count - len(self._known_steps)))
