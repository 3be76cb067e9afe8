"""Searches over single states, each kept with the one that it was reached from, and with its contact history."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from falsework.assembly.state import States, state_of_key
from falsework.search.beam.settings import MEMORY
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.result import Progress, Route, SearchResult, Stop, unstable_end
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.varied_replay import AnyReplayer


class StateSearch(Search):
    """Search over single states, each kept with the one that it was reached from."""

    width: float
    """States, or sets of parts, that are kept of those equally far away."""

    def __init__(self, task: Task, oracle: Oracle, direction: Direction, *, batch: int = 1024) -> None:
        """Begin at the origin of a direction; of some verdicts that are asked for at once, `batch` are given at a time.

        In the order of assembly, states come with their contact history, and those that do not come to rest are
        dropped.
        """
        self.task, self.direction = task.judged_by(oracle), direction
        self.judge = CountingOracle(oracle, batch=batch)
        self._oracle = oracle
        self._stable: dict[bytes, bool] = {}
        """Verdicts so far."""
        self._forget()

    def _forget(self) -> None:
        """Begin anew without states; verdicts are kept."""
        self.parent: dict[bytes, bytes] = {}
        """States found to be stable, each with the one that it was reached from, empty for the origin."""
        replayer = self._oracle.replayer if self.direction is Direction.ASSEMBLY else None
        self._histories = None if replayer is None else PathHistories(replayer, self.parent)

    @abstractmethod
    def _restart(self, width: float) -> None:
        """Begin again with some width; verdicts are kept."""

    def forbid(self, states: States) -> None:
        """Exclude states and restart; the search then proves nothing. See `Search.forbid`."""
        excluded = [state.tobytes() for state in states]
        self.judge.forbidden.update(excluded)
        self._stable.update(dict.fromkeys(excluded, False))
        self._forget()
        self._restart(self.width)

    def _open(self) -> tuple[int, int]:
        return self.judge.undecided, self.judge.sliding + len(self.judge.forbidden)

    @property
    def found(self) -> bool:
        """See `Search.found`."""
        return self.task.goal(self.direction).tobytes() in self.parent

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`."""
        failed = unstable_end(self.task, self._oracle)
        return failed or super().run(widest, progress=progress, stop=stop)

    def route(self) -> Route:
        """See `Search.route`."""
        return Route.back_from(self.task.goal(self.direction), self.parent, self.direction)

    def states(self) -> States:
        """See `Search.states`."""
        return self._of_keys(list(self.parent))

    def _of_keys(self, keys: Sequence[bytes]) -> States:
        return np.array([state_of_key(key) for key in keys], dtype=np.uint8).reshape(-1, self.task.part_count)


class PathHistories:
    """Contact history of each state, along the path by which it was reached first."""

    def __init__(self, replayer: AnyReplayer, parent: Mapping[bytes, bytes]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            parent: state that each state was reached from, empty for the origin; the search that owns it adds to it.
        """
        self._replayer, self._parent = replayer, parent
        self._known: OrderedDict[bytes, History] = OrderedDict()

    def along(self, origin: bytes, states: Sequence[States]) -> list[History] | None:
        """Return the histories after each of some moves from a state; None where one does not come to rest."""
        history, before = self._of(origin), state_of_key(origin)
        found = []
        for after in states:
            stands, history = (False, None) if history is None else self._replayer.step(history, before, after)
            if not stands or history is None:
                return None
            found.append(history)
            before = after
        return found

    def keep(self, states: Sequence[States], histories: Sequence[History]) -> None:
        """Store the histories of states that were reached for the first time."""
        for state, history in zip(states, histories, strict=True):
            self._known.setdefault(state.tobytes(), history)
        while histories and len(self._known) > max(MEMORY // max(histories[-1].nbytes, 1), 4):
            self._known.popitem(last=False)

    def _of(self, state: bytes) -> History | None:
        """Return the history of a state, along its path from the last state whose history is known."""
        path = [state]
        while path[-1] not in self._known and self._parent[path[-1]]:
            path.append(self._parent[path[-1]])
        first = path.pop()
        if first not in self._known:
            start = self._replayer.replay(state_of_key(first)[None])
            if not start.histories:
                return None
            self._known[first] = start.histories[0]
        states = [state_of_key(key) for key in reversed(path)]
        history = self._known[first]
        if states:
            found = self.along(first, states)
            if found is None:
                return None
            self.keep(states, found)
            history = found[-1]
        return history
