"""Exhaustive search with repeated holds: the shortest plan, or a proof that there is none."""

from __future__ import annotations

import time

import numpy as np

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.regrasp_route import RegraspRoute
from falsework.search.problem.result import (
    Outcome,
    Progress,
    SearchCounters,
    SearchProgress,
    SearchResult,
    Stop,
    beam_failure,
    unstable_end,
)
from falsework.search.problem.task import Direction, Task

STATE_LIMIT = 200_000
"""Stable states after which a search gives up by default."""


class ExhaustiveRegraspSearch:
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
        self.parent: dict[bytes, bytes] = {task.start.tobytes(): b""}
        """States found to be stable, each with the one that it was reached from."""
        self.gave_up = False
        """Whether the limit on states was exceeded."""
        self.judge = CountingOracle(oracle)
        self._ring = self._deepest = task.start[None]
        self._last = self._deepest[:0]
        self._refused: set[bytes] = set()
        self._seconds = 0.0

    @property
    def asked(self) -> int:
        """Verdicts requested so far."""
        return self.judge.asked

    @property
    def counters(self) -> SearchCounters:
        """Work done so far."""
        seen = len(self.parent)
        return SearchCounters(seen, seen + len(self._refused), self.judge.asked, self.judge.rejected)

    @property
    def examined_all(self) -> bool:
        """Whether the search came to its end with no state left out: no other finds a plan then."""
        return not len(self._ring) and not self.gave_up and not self.judge.forbidden

    def replay_summary(self) -> None:
        """Return None: no histories are kept."""

    def forbid(self, states: States) -> None:
        """Exclude states, such as one in which a replay fails, and restart; the search then proves nothing."""
        self.judge.forbidden |= {state.tobytes() for state in states}
        self.parent = {self.task.start.tobytes(): b""}
        self._ring = self._deepest = self.task.start[None]
        self._refused = set()

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until the target is reached, every state was examined, the limit is exceeded, or `stop` stops it.

        Args:
            widest: without meaning here, see `falsework.search.strategies.Strategy`.
            progress: called after every ring of states.
            stop: called before every ring; true ends the search, which can then be run on.
        """
        begun, goal, interrupted = time.perf_counter(), self.task.target.tobytes(), False
        failed = unstable_end(self.task, self._oracle)
        if failed is not None:
            return failed
        try:
            while len(self._ring) and goal not in self.parent and not self.gave_up:
                if stop is not None and stop():
                    interrupted = True
                    break
                self._advance()
                if progress is not None:
                    seconds = self._seconds + time.perf_counter() - begun
                    counts = (
                        2 * self._level(self._deepest),
                        2 * self._moves.removals,
                        len(self._ring),
                        0,
                        self.judge.asked,
                    )
                    progress(SearchProgress(Direction.DISASSEMBLY, *counts, seconds))
        except KeyboardInterrupt:
            interrupted = True
        self._seconds += time.perf_counter() - begun
        return self.result(interrupted=interrupted)

    def result(self, *, interrupted: bool = False) -> SearchResult:
        """Return the result so far; `interrupted` if the search was stopped from outside."""
        goal = self.task.target.tobytes()
        found, judge = goal in self.parent, self.judge
        complete = not interrupted and not self.gave_up
        outcome, limit = beam_failure(self._limit, complete, judge.undecided, judge.sliding, self.task.caveat)
        if self.gave_up:
            limit = f"gave up after {self._limit} states with holding again"
        if found:
            outcome, limit = Outcome.FOUND, ""
        return SearchResult(
            outcome=outcome,
            routes=(RegraspRoute.from_parents(goal, self.parent, self.task.part_count),) if found else (),
            direction=Direction.DISASSEMBLY,
            steps=2 * self._moves.removals,
            reached=2 * self._level(self._deepest),
            deepest=self._deepest,
            rejected=self._last,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=judge.undecided,
            sliding=judge.sliding,
        )

    def _level(self, states: States) -> int:
        """Return the largest number of parts removed in some states."""
        return int(self._moves.removed(states).max())

    def _advance(self) -> None:
        """Find the next ring; an interruption leaves the search unchanged."""
        ring, wrong = self._next(self._ring, self.judge, self._refused)
        if len(ring) and self._level(ring) >= self._level(self._deepest):
            self._deepest, self._last = ring[self._moves.removed(ring) == self._level(ring)], wrong
        self._ring = ring
        self.gave_up = len(self.parent) > self._limit

    def _next(self, ring: States, judge: CountingOracle, refused: set[bytes]) -> tuple[States, States]:
        """Return the stable states one move from a ring that were not found before, and those that are not stable."""
        row, action = np.nonzero(self._moves.legal(ring, Direction.DISASSEMBLY))
        after = self._moves.follow(ring[row], action)
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
