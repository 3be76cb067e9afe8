"""Beam search over single states, at last without a limit: with several parts in one step, or repeated holds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States, state_of_key
from falsework.errors import InputError
from falsework.search.beam.settings import WIDENING
from falsework.search.beam.state_search import StateSearch
from falsework.search.problem.deadline import PIECE
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import CHUNK
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import (
    REPORTED_STATES,
    Outcome,
    Progress,
    SearchCounters,
    SearchResult,
    Stop,
    beam_failure,
)
from falsework.search.problem.task import Direction, Task
from falsework.search.together.moves import TaskMoves


@dataclass(eq=False)
class _Candidate:
    """State that a step leads to, and how."""

    parent: bytes
    stage: int
    score: float
    """Sum of the guide's scores on the way."""
    fixed: bool
    """Whether a step that only fixes parts leads there from a stable state."""


class StateBeam(StateSearch):
    """Beam over the states of a task in stages: the best of each are kept, and what steps lead to waits for its stage.

    Where each part is held once, a hold counts as one step of a part, and its removal as another, however many parts
    are removed at once; a stage has the states with the same sum of these, which grows with every step. With repeated
    holds a stage has the states that take the same number of moves, and the search begins at the start, without a limit
    and without preference: it finds the shortest plan. A beam that leaves states out and finds no plan is repeated
    wider, at last without a limit; then it has examined every state, none of them twice.
    """

    def __init__(
        self,
        task: Task,
        oracle: Oracle,
        direction: Direction = Direction.DISASSEMBLY,
        *,
        guide: Guide | None = None,
        width: float = np.inf,
        state_limit: int = 200_000,
    ) -> None:
        """Begin at the origin of a direction.

        Args:
            task: rules between start and target.
            oracle: decides stability.
            direction: end to begin at; disassembly with repeated holds.
            guide: scores actions.
            width: states that are kept of a stage at first; all with repeated holds.
            state_limit: give up once more states than this were found.

        Raises:
            InputError: a limit below one.
        """
        if state_limit < 1:
            raise InputError(f"a limit of {state_limit} states allows no search; give at least 1")
        super().__init__(task, oracle, direction)
        self.moves = TaskMoves(self.task, oracle)
        self._guide, self._limit = guide, state_limit
        self._kept = self._seen = 0
        self.gave_up = False
        """Whether the limit on states was exceeded."""
        self._farthest, self._deepest, self._rejected = 0, list[bytes](), list[bytes]()
        self._restart(width)

    def _restart(self, width: float) -> None:
        origin = self.task.origin(self.direction).tobytes()
        self.width = width
        self._forget()
        first = _Candidate(b"", 0, 0.0, True)
        self._candidates = {origin: first}
        self._waiting: dict[int, dict[bytes, _Candidate]] = {0: {origin: first}}
        self._stable[origin] = True
        self._stage, self._queue, self._room = 0, deque[tuple[bytes, _Candidate]](), width
        self._left_out = self._refused = False

    @property
    def steps(self) -> int:
        """With repeated holds two for each part to be removed, which every plan needs at least."""
        again = self.moves.again
        return self.task.steps if again is None else 2 * again.removals

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        return SearchCounters(self._kept, self._seen, self.judge.asked, self.judge.rejected, self.judge.work)

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        nothing_left = self._exhausted and (not self._left_out or bool(np.isinf(self.width)))
        return self.found or self.gave_up or nothing_left

    @property
    def examined_all(self) -> bool:
        """See `Search.examined_all`."""
        return self._exhausted and not (self._left_out or self._refused or self.gave_up or self.judge.forbidden)

    @property
    def _exhausted(self) -> bool:
        """Whether no state waits for its turn."""
        return not self._waiting and not self._queue

    def run(self, widest: int = 1, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`; from `widest` on the beam has no limit."""
        self.moves.stop = stop
        return super().run(widest, progress=progress, stop=stop)

    def step(self) -> bool:
        """Examine some states of the present stage, turn to those of the next, or begin again with a wider beam."""
        if self._queue:
            self._examine()
        elif self._waiting:
            self._stage, self._room = min(self._waiting), self.width
            self._queue.extend(sorted(self._waiting.pop(self._stage).items(), key=lambda item: -item[1].score))
        else:
            wider = self.width * WIDENING
            self._restart(wider if wider <= self._widest else np.inf)
        return True

    def _failure(self) -> tuple[Outcome, str]:
        if self.gave_up:
            again, several = self.moves.again is not None, self.moves.largest > 1
            more = " with holding again" * again + f" with up to {self.moves.largest} parts at once" * several
            return Outcome.NOT_FOUND, f"gave up after {self._limit} states{more}"
        return beam_failure(self._limit, not self._left_out, *self._open(), self.moves.caveat)

    def _farthest_states(self) -> tuple[int, States, States]:
        deepest, rejected = (self._of_keys(keys[:REPORTED_STATES]) for keys in (self._deepest, self._rejected))
        return self._farthest, deepest, rejected

    def _place(self) -> tuple[int, int, int]:
        level = self._stage if self.moves.again is None else self._farthest
        if np.isinf(self.width):
            return level, len(self.parent), 0
        return level, int(self.width - self._room), int(self.width)

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        # Where a disassembly ends, turns or ways in several moves might lead on.
        ends = outcome is Outcome.PROVED_IMPOSSIBLE and self.direction is Direction.DISASSEMBLY and not self._rejected
        told = ends and self.moves.again is None
        return (self.moves.first_motions(state_of_key(self._deepest[0])),) if told else ()

    def _reached(self, states: States) -> NDArray[np.int64]:
        """Return how far states are from the origin, of `steps`; shape (batch,)."""
        if self.moves.again is not None:
            return 2 * self.moves.again.removed(states)
        return np.abs(self.task.steps_done(states) - self.task.steps_done(self.task.origin(self.direction)[None]))

    def _examine(self) -> None:
        """Judge some of the states whose turn it is, best first, and take the steps out of those that are kept."""
        count = int(min(PIECE if self.moves.sets else CHUNK, self._room, len(self._queue)))
        batch = [self._queue[k] for k in range(count)]
        if self.task.holds_keep_stable:
            free = (key for key, candidate in batch if candidate.fixed and key not in self.judge.forbidden)
            self._stable.update(dict.fromkeys(free, True))
        asked = [(key, candidate.parent) for key, candidate in batch if key not in self._stable]
        if asked:
            states, parents = (self._of_keys([pair[k] for pair in asked]) for k in (0, 1))
            stable = self.judge.stable(states, parents)
            self._stable.update({key: bool(good) for (key, _), good in zip(asked, stable, strict=True)})
        states = self._of_keys([key for key, _ in batch])
        good = [self._stable[key] and self._comes_to_rest(key, candidate.parent) for key, candidate in batch]
        kept = np.flatnonzero(good)
        steps = self.moves.after(states[kept], self.direction) if len(kept) else None
        for _ in batch:  # an interruption before leaves them for the next run
            self._queue.popleft()
        for (key, candidate), stands, reached in zip(batch, good, self._reached(states).tolist(), strict=True):
            self._note(key, candidate.parent, reached, stands=stands)
        if steps is not None:
            self._take([batch[k] for k in kept.tolist()], states[kept], *steps)
        if self._room <= 0 and self._queue:
            self._left_out = True
            self._queue.clear()

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

    def _note(self, key: bytes, parent: bytes, reached: int, *, stands: bool) -> None:
        """Keep a state that stands, or note one that does not."""
        if stands:
            self.parent[key] = parent
            self._room -= 1
            self._kept += 1
            self.gave_up = self.gave_up or len(self.parent) > self._limit
        if stands and reached > self._farthest:
            self._farthest, self._deepest, self._rejected = reached, [], []
        if stands and reached == self._farthest:
            self._deepest.append(key)
        elif not stands and reached > self._farthest:
            self._rejected.append(key)

    def _take(
        self,
        kept: list[tuple[bytes, _Candidate]],
        states: States,
        row: NDArray[np.int64],
        after: States,
        actions: NDArray[np.int64],
    ) -> None:
        """Let what steps lead to, shape (steps, parts), from some of the states kept, wait for its stage."""
        scores = self._scores(states, row, actions)
        fixes = ((after == states[row]) | (after == HELD)).all(axis=1)
        stages = self._reached(after) if self.moves.again is None else np.full(len(row), self._stage + 1)
        for origin, state, score, stage, fixed in zip(
            row.tolist(), after, scores.tolist(), stages.tolist(), fixes.tolist(), strict=True
        ):
            (key, candidate), name = kept[origin], state.tobytes()
            total, known = candidate.score + score, self._candidates.get(name)
            if known is None:
                self._seen += 1
                self._candidates[name] = known = _Candidate(key, stage, total, fixed)
                self._waiting.setdefault(stage, {})[name] = known
            elif known.stage > self._stage:
                known.fixed = known.fixed or fixed
                if total > known.score:
                    known.parent, known.score = key, total

    def _scores(self, states: States, row: NDArray[np.int64], actions: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the guide's scores of steps from states; a set counts as the part by which it is named."""
        if self._guide is None:
            return np.zeros(len(actions))
        allowed = np.zeros((len(states), 2 * self.task.part_count), dtype=bool)
        allowed[row, actions] = True
        return np.asarray(self._guide(states, allowed, self.direction))[row, actions].astype(np.float64)
