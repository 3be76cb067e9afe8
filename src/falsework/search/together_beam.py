"""Beam search with several parts in one step."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States, state_of_key
from falsework.search.beam.backjumping import WIDENING
from falsework.search.problem.deadline import PIECE
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.result import (
    REPORTED_STATES,
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
from falsework.search.regrasp.exhaustive import STATE_LIMIT
from falsework.search.regrasp.histories import PathHistories
from falsework.search.together.moves import TogetherMoves


@dataclass(eq=False)
class _Candidate:
    """State that a step leads to, and how."""

    parent: bytes
    score: float
    """Sum of the guide's scores on the way."""
    fixed: bool
    """Whether a step that only fixes parts leads there from a stable state."""


class TogetherBeam(Search):
    """Beam over the states of a task in which steps may move several parts.

    A hold counts as one step of a part, and its removal as another, however many parts are removed at once. States are
    sorted by the sum of these, which grows with every step, and those with the same sum are examined together: the best
    are kept, up to the width, and what steps lead to from them waits for its turn. A beam that leaves states out and
    finds no plan is repeated wider, at last without a limit; then it has examined every state.
    """

    def __init__(
        self, task: Task, oracle: Oracle, direction: Direction, *, guide: Guide | None = None, width: int = 1
    ) -> None:
        """Begin at the origin of a direction.

        Args:
            task: rules between start and target, with `Task.together`.
            oracle: decides stability.
            direction: end to begin at.
            guide: scores actions.
            width: states that are kept at first.
        """
        self.task = task = task.judged_by(oracle)
        self.direction = direction
        self.judge = CountingOracle(oracle)
        self.moves = TogetherMoves(task, oracle)
        self._oracle, self._guide = oracle, guide
        self._stable: dict[bytes, bool] = {}
        self._kept = self._seen = 0
        self.gave_up = False
        """Whether the limit on states was exceeded."""
        self._farthest, self._deepest, self._rejected = 0, list[bytes](), list[bytes]()
        self._begin(float(width))

    def _begin(self, width: float) -> None:
        """Begin anew with a width; verdicts are kept."""
        origin = self.task.origin(self.direction).tobytes()
        self.width = width
        self.parent: dict[bytes, bytes] = {}
        """States kept, each with the one that it was reached from."""
        replayer = self._oracle.replayer if self.direction is Direction.ASSEMBLY else None
        self._histories = None if replayer is None else PathHistories(replayer, self.parent)
        self._waiting: list[dict[bytes, _Candidate]] = [{} for _ in range(self.task.steps + 1)]
        self._waiting[0][origin] = _Candidate(b"", 0.0, True)
        self._stable[origin] = True
        self._stage, self._queue, self._room = -1, deque[tuple[bytes, _Candidate]](), width
        self._left_out = self._refused = False

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        return SearchCounters(self._kept, self._seen, self.judge.asked, self.judge.rejected)

    @property
    def found(self) -> bool:
        """See `Search.found`."""
        return self.task.goal(self.direction).tobytes() in self.parent

    @property
    def _ended_without(self) -> bool:
        """Whether no state waits for its turn."""
        return self._stage == self.task.steps and not self._queue

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        nothing_left = self._ended_without and (not self._left_out or bool(np.isinf(self.width)))
        return self.found or self.gave_up or nothing_left

    @property
    def examined_all(self) -> bool:
        """See `Search.examined_all`."""
        return self._ended_without and not (self._left_out or self._refused or self.gave_up or self.judge.forbidden)

    def forbid(self, states: States) -> None:
        """Exclude states and restart; the search then proves nothing. See `Search.forbid`."""
        for state in states:
            self.judge.forbidden.add(state.tobytes())
            self._stable[state.tobytes()] = False
        self._begin(self.width)

    def run(self, widest: int = 1, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`; from `widest` on the beam has no limit."""
        self.moves.stop = stop
        failed = unstable_end(self.task, self._oracle)
        return failed or super().run(widest, progress=progress, stop=stop)

    def step(self) -> bool:
        """Examine some states of the present sum, turn to those of the next, or begin again with a wider beam."""
        if self._ended_without:
            wider = self.width * WIDENING
            self._begin(wider if wider <= self._widest else np.inf)
        elif self._queue and self._room > 0:
            self._examine()
        else:
            self._next_stage()
        return True

    def route(self) -> Route:
        """See `Search.route`."""
        return Route.back_from(self.task.goal(self.direction), self.parent, self.direction)

    def states(self) -> States:
        """See `Search.states`."""
        return np.stack([state_of_key(key) for key in self.parent])

    def _failure(self) -> tuple[Outcome, str]:
        if self.gave_up:
            return (
                Outcome.NOT_FOUND,
                f"gave up after {STATE_LIMIT} states with up to {self.moves.largest} parts at once",
            )
        return beam_failure(STATE_LIMIT, not self._left_out, *self._open(), self.moves.caveat)

    def _farthest_states(self) -> tuple[int, States, States]:
        deepest, rejected = (
            np.array([state_of_key(key) for key in keys[:REPORTED_STATES]], dtype=np.uint8)
            for keys in (self._deepest, self._rejected)
        )
        parts = self.task.part_count
        return self._farthest, deepest.reshape(-1, parts), rejected.reshape(-1, parts)

    def _place(self) -> tuple[int, int, int]:
        kept = int(self.width - self._room) if np.isfinite(self.width) else len(self.parent)
        return max(self._stage, 0), kept, int(min(self.width, STATE_LIMIT))

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        # Where a disassembly ends, turns or ways in several moves might lead on.
        ends = outcome is Outcome.PROVED_IMPOSSIBLE and self.direction is Direction.DISASSEMBLY and not self._rejected
        return (self.moves.first_motions(state_of_key(self._deepest[0])),) if ends else ()

    def _next_stage(self) -> None:
        """Turn to the states of the next sum."""
        self._left_out = self._left_out or bool(self._queue)
        self._stage, self._room = self._stage + 1, self.width
        waiting, self._waiting[self._stage] = self._waiting[self._stage], {}
        self._queue = deque(sorted(waiting.items(), key=lambda item: -item[1].score))

    def _examine(self) -> None:
        """Judge some of the states whose turn it is, best first, and take the steps out of those that are kept."""
        count = int(min(PIECE, self._room, len(self._queue)))
        batch = [self._queue[k] for k in range(count)]
        asked = [(key, candidate.parent) for key, candidate in batch if key not in self._stable]
        if self.task.holds_keep_stable:
            free = {key for key, candidate in batch if candidate.fixed and key not in self.judge.forbidden}
            asked = [(key, parent) for key, parent in asked if key not in free]
            self._stable.update(dict.fromkeys(free, True))
        if asked:
            states, parents = (np.stack([state_of_key(pair[k]) for pair in asked]) for k in (0, 1))
            stable = self.judge.stable(states, parents)
            self._stable.update({key: bool(good) for (key, _), good in zip(asked, stable, strict=True)})
        for key, candidate in batch:
            good = self._stable[key] and self._comes_to_rest(key, candidate.parent)
            steps = self.moves.after(state_of_key(key), self.direction) if good else None
            self._queue.popleft()  # an interruption before leaves it for the next run
            if steps is not None:
                self._take(key, candidate, *steps)
            elif self._stage > self._farthest:
                self._rejected.append(key)

    def _comes_to_rest(self, key: bytes, parent: bytes) -> bool:
        """Return whether a stable state is at rest with its contact history too, and keep that."""
        if self._histories is None or not parent:
            return True
        found = self._histories.along(parent, [state_of_key(key)])
        if found is None:
            self._refused = True
            self.judge.sliding += 1
            return False
        self._histories.keep([state_of_key(key)], found)
        return True

    def _take(self, key: bytes, candidate: _Candidate, after: States, actions: NDArray[np.int64]) -> None:
        """Keep a state, and let what steps lead to, shape (steps, parts), wait for its turn."""
        self.parent[key] = candidate.parent
        self._room -= 1
        self._kept += 1
        self.gave_up = self.gave_up or len(self.parent) > STATE_LIMIT
        if self._stage > self._farthest:
            self._farthest, self._deepest, self._rejected = self._stage, [], []
        if self._stage == self._farthest:
            self._deepest.append(key)
        if not len(after):
            return
        self._seen += len(after)
        state = state_of_key(key)
        scores = self._scores(state, actions)
        stages = np.abs(self.task.steps_done(after) - self.task.steps_done(self.task.origin(self.direction)[None]))
        fixes = ((after == state) | (after == HELD)).all(axis=1)
        for row, score, stage, fixed in zip(after, scores, stages.tolist(), fixes.tolist(), strict=True):
            waiting, name = self._waiting[stage], row.tobytes()
            total, known = candidate.score + float(score), waiting.get(name)
            if known is None:
                waiting[name] = _Candidate(key, total, fixed)
                continue
            known.fixed = known.fixed or fixed
            if total > known.score:
                known.parent, known.score = key, total

    def _scores(self, state: States, actions: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the guide's scores of steps from a state; a set counts as the part by which it is named."""
        if self._guide is None:
            return np.zeros(len(actions))
        allowed = np.zeros((1, 2 * len(state)), dtype=bool)
        allowed[0, actions] = True
        return np.asarray(self._guide(state[None], allowed, self.direction))[0, actions]
