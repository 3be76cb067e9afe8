"""Exhaustive search with repeated holds: the shortest plan, or a proof that there is none."""

from __future__ import annotations

import numpy as np

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.result import (
    Outcome,
    Progress,
    Route,
    SearchCounters,
    SearchResult,
    Stop,
    beam_failure,
    unstable_end,
)
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task
from falsework.search.together.moves import TogetherMoves

STATE_LIMIT = 200_000
"""Stable states after which a search gives up by default."""


class ExhaustiveRegraspSearch(Search):
    """Breadth-first search from the start through all stable states that repeated holds can reach.

    Nothing is omitted and no state is visited twice, so if it ends without the target there is no plan. Steps are
    counted as two for each part to be removed, which every plan needs at least.
    """

    def __init__(self, task: Task, oracle: Oracle, *, state_limit: int = STATE_LIMIT) -> None:
        """Begin at the start of the task.

        Args:
            task: rules between start and target, with `Task.allow_regrasp`.
            oracle: decides stability.
            state_limit: give up once more states than this were found.

        Raises:
            InputError: a limit below one.
        """
        if state_limit < 1:
            raise InputError(f"a limit of {state_limit} states allows no search; give at least 1")
        self.task = task = task.judged_by(oracle)
        self._moves, self._oracle, self._limit = RegraspMoves(task), oracle, state_limit
        self._sets = None if task.together is None else TogetherMoves(task, oracle)
        self.parent: dict[bytes, bytes] = {task.start.tobytes(): b""}
        """States found to be stable, each with the one that it was reached from."""
        self.gave_up = False
        """Whether the limit on states was exceeded."""
        self.judge = CountingOracle(oracle)
        self._ring = self._deepest = task.start[None]
        self._last = self._deepest[:0]
        self._refused: set[bytes] = set()

    direction = Direction.DISASSEMBLY

    @property
    def found(self) -> bool:
        """See `Search.found`."""
        return self.task.target.tobytes() in self.parent

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return not len(self._ring) or self.found or self.gave_up

    @property
    def steps(self) -> int:
        """Two for each part to be removed, which every plan needs at least."""
        return 2 * self._moves.removals

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        seen = len(self.parent)
        return SearchCounters(seen, seen + len(self._refused), self.judge.asked, self.judge.rejected)

    @property
    def examined_all(self) -> bool:
        """See `Search.examined_all`."""
        return not len(self._ring) and not self.gave_up and not self.judge.forbidden

    def forbid(self, states: States) -> None:
        """Exclude states and restart; the search then proves nothing. See `Search.forbid`."""
        self.judge.forbidden |= {state.tobytes() for state in states}
        self.parent = {self.task.start.tobytes(): b""}
        self._ring = self._deepest = self.task.start[None]
        self._refused = set()

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`."""
        failed = unstable_end(self.task, self._oracle)
        return failed or super().run(widest, progress=progress, stop=stop)

    def route(self) -> Route:
        """See `Search.route`."""
        return Route.back_from(self.task.target, self.parent, self.direction)

    def _failure(self) -> tuple[Outcome, str]:
        outcome, limit = beam_failure(self._limit, not self.gave_up, *self._open(), self._caveat)
        return outcome, f"gave up after {self._limit} states with holding again" if self.gave_up else limit

    @property
    def _caveat(self) -> str:
        return self.task.caveat if self._sets is None else self._sets.caveat

    def _farthest_states(self) -> tuple[int, States, States]:
        return 2 * self._level(self._deepest), self._deepest, self._last

    def _place(self) -> tuple[int, int, int]:
        return 2 * self._level(self._deepest), len(self._ring), 0

    def _level(self, states: States) -> int:
        """Return the largest number of parts removed in some states."""
        return int(self._moves.removed(states).max())

    def step(self) -> bool:
        """Find the next ring of states."""
        ring, wrong = self._next(self._ring, self.judge, self._refused)
        if len(ring) and self._level(ring) >= self._level(self._deepest):
            self._deepest, self._last = ring[self._moves.removed(ring) == self._level(ring)], wrong
        self._ring = ring
        self.gave_up = len(self.parent) > self._limit
        return len(ring) > 0

    def _next(self, ring: States, judge: CountingOracle, refused: set[bytes]) -> tuple[States, States]:
        """Return the stable states one move from a ring that were not found before, and those that are not stable."""
        row, action = np.nonzero(self._moves.legal(ring, Direction.DISASSEMBLY))
        after = self._moves.follow(ring[row], action)
        if self._sets is not None:
            several = [(number, to) for number, state in enumerate(ring) for to, _ in self._sets.removals(state)]
            row = np.concatenate([row, np.array([number for number, _ in several], dtype=row.dtype)])
            after = np.concatenate([after, *(to[None] for _, to in several)])
        fresh: dict[bytes, int] = {}
        for number, state in enumerate(after):
            key = state.tobytes()
            if key not in self.parent and key not in refused:
                fresh.setdefault(key, number)
        rows = np.array(list(fresh.values()), dtype=np.int64)
        before, after = ring[row[rows]], after[rows]
        stable = np.ones(len(after), dtype=bool)
        asked = ~(self._moves.fixes(before, after) & self.task.holds_keep_stable)
        stable[asked] = judge.stable(after[asked], before[asked])
        for key, good, origin in zip(fresh, stable.tolist(), before, strict=True):
            if good:
                self.parent[key] = origin.tobytes()
            else:
                refused.add(key)
        return after[stable], after[~stable]
