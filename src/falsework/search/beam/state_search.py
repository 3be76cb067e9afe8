"""Best-first search over single states: with several parts in one step, or repeated holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush, heapreplace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States, state_of_key
from falsework.errors import InputError
from falsework.search.beam.nogoods import Jumps
from falsework.search.beam.paths import PathHistories
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.result import (
    REPORTED_STATES,
    Outcome,
    Progress,
    Route,
    SearchCounters,
    SearchResult,
    Stop,
    beam_failure,
)
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task
from falsework.search.together.moves import TaskMoves
from falsework.utils.interruption import PIECE


@dataclass(eq=False)
class _Steps:
    """Steps from a state to others with as many parts, best first, stored as what they change."""

    origin: bytes
    """The state; empty where there is none before."""
    part: NDArray[np.int32]
    """Parts that change, those of one step after those of another."""
    value: NDArray[np.uint8]
    """Their values after it."""
    begin: NDArray[np.int32]
    """Place of the first part of each step, and the number of all, shape (steps + 1,)."""
    fixes: Mask
    """Which steps only fix parts, shape (steps,)."""
    rank: NDArray[np.float64]
    """What decides their order, the least first, shape (steps, keys)."""
    at: int = 0
    """The first that waits."""

    @classmethod
    def from_states(cls, origin: States, after: States, fixes: Mask, rank: NDArray[np.float64]) -> _Steps:
        """Return the steps from a state, shape (parts,), to others, shape (steps, parts)."""
        row, part = np.nonzero(after != origin)
        begin = np.searchsorted(row, np.arange(len(after) + 1)).astype(np.int32)
        return cls(origin.tobytes(), part.astype(np.int32), after[row, part], begin, fixes, rank)

    @property
    def state(self) -> States:
        """State that the first step leads to, shape (parts,)."""
        state = state_of_key(self.origin).copy() if self.origin else np.zeros(len(self.part), np.uint8)
        changes = slice(self.begin[self.at], self.begin[self.at + 1])
        state[self.part[changes]] = self.value[changes]
        return state

    @property
    def worth(self) -> tuple[float, ...]:
        """Rank of the first step."""
        return tuple(self.rank[self.at].tolist())


_Heap = list[tuple[tuple[float, ...], int, _Steps]]


class StateSearch(Search):
    """Best-first search over single states, until none is left.

    A state is the better the more parts are removed, or in assembly placed; then the smaller `RegraspMoves.burden`, and
    then by the guide's score of the step that leads to it. The best one is judged, and the states that steps lead to
    from it wait for their turns. None is judged twice. Where none is left of those with the most parts removed, the
    search jumps back over levels as `BeamSearch` does over choices; the states that it leaves out come last. So a
    search that ends has examined every state.
    """

    def __init__(
        self,
        task: Task,
        oracle: Oracle,
        direction: Direction = Direction.DISASSEMBLY,
        *,
        guide: Guide | None = None,
        state_limit: int = 200_000,
    ) -> None:
        """Begin at the origin of a direction; the start and the target are taken as stable.

        In the order of assembly states come with their contact history, and those that do not come to rest are
        dropped.

        Args:
            state_limit: give up once more states than this were found.

        Raises:
            InputError: a limit below one.
        """
        if state_limit < 1:
            raise InputError(f"a limit of {state_limit} states allows no search; give at least 1")
        self.task, self.direction = task.judged_by(oracle), direction
        self.judge = CountingOracle(oracle)
        self._replayer = oracle.replayer if direction is Direction.ASSEMBLY else None
        if self._replayer is not None:
            self.judge.replayed = True
            self.task = replace(self.task, holds_keep_stable=True)  # a part that is fixed changes no force
        self.moves = TaskMoves(self.task, oracle)
        self._counts = RegraspMoves(self.task)
        self._guide, self._limit = guide, state_limit
        self._stable: dict[bytes, bool] = {}
        """Verdicts so far."""
        self._kept = self._seen = 0
        self._farthest, self._deepest, self._rejected = 0, list[bytes](), list[bytes]()
        self._begin()

    def _begin(self) -> None:
        """Begin anew without states; verdicts are kept."""
        origin = self.task.origin(self.direction)
        self.parent: dict[bytes, bytes] = {}
        """States found to be stable, each with the one that it was reached from, empty for the origin."""
        self._histories = None
        if self._replayer is not None:
            self._histories = PathHistories(self._replayer, lambda key: self.parent[key] or None, state_of_key)
        self._stable[origin.tobytes()] = True
        ends = np.array([0, len(origin)], np.int32)
        first = _Steps(b"", np.arange(len(origin), dtype=np.int32), origin, ends, np.ones(1, bool), np.zeros((1, 0)))
        self._waiting: dict[int, _Heap] = {0: [((), 0, first)]}
        """By the parts removed, or placed: states that wait for their turns."""
        self._left_out: list[tuple[int, _Heap]] = []
        """Of these, those that jumps left out."""
        self._jumps, self._level = Jumps(), 0
        self._refused = False
        """Whether a state did not come to rest on the path by which it was reached."""

    def forbid(self, states: States) -> None:
        """Exclude states and restart; the search then proves nothing. See `Search.forbid`."""
        excluded = [state.tobytes() for state in states]
        self.judge.forbidden.update(excluded)
        self._stable.update(dict.fromkeys(excluded, False))
        self._begin()

    def go_back(self, state: States) -> None:
        """Restart. See `Search.go_back`."""
        self._begin()

    @property
    def found(self) -> bool:
        """See `Search.found`."""
        return self.task.goal(self.direction).tobytes() in self.parent

    @property
    def gave_up(self) -> bool:
        """Whether the limit on states was exceeded."""
        return len(self.parent) > self._limit

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return self.found or self.gave_up or not self._waiting

    @property
    def examined_all(self) -> bool:
        """See `Search.examined_all`."""
        return not (self._waiting or self._as_built or self.gave_up or self.judge.forbidden)

    @property
    def _as_built(self) -> bool:
        """Whether states were rejected as they are built, which may stand otherwise."""
        return self._refused or (self.judge.replayed and self.judge.rejected > 0)

    @property
    def steps(self) -> int:
        """With repeated holds two for each part to be removed, which every plan needs at least."""
        return self.task.steps if self.moves.again is None else 2 * self._counts.removals

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        return SearchCounters(self._kept, self._seen, self.judge.asked, self.judge.rejected, self.judge.work)

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`."""
        self.moves.stop = stop
        return super().run(widest, progress=progress, stop=stop)

    def step(self) -> bool:
        """Judge the best states up to the first that stands, a few at most."""
        return any(self._examine() for _ in range(PIECE) if self._waiting)

    def route(self) -> Route:
        """See `Search.route`."""
        return Route.back_from(self.task.goal(self.direction), self.parent, self.direction)

    def replay_summary(self) -> PlanReplay | None:
        """See `Search.replay_summary`."""
        goal = self.task.goal(self.direction).tobytes()
        return self._histories.summary(goal) if self.found and self._histories is not None else None

    def states(self) -> States:
        """See `Search.states`."""
        return self._of_keys(list(self.parent))

    def _of_keys(self, keys: Sequence[bytes]) -> States:
        return np.array([state_of_key(key) for key in keys], dtype=np.uint8).reshape(-1, self.task.part_count)

    def _failure(self) -> tuple[Outcome, str]:
        if self.gave_up:
            again, several = self.moves.again is not None, self.moves.largest > 1
            more = " with holding again" * again + f" with up to {self.moves.largest} parts at once" * several
            return Outcome.NOT_FOUND, f"gave up after {self._limit} states{more}"
        outcome, limit = beam_failure(0, True, *self._open(), self.moves.caveat)
        if self._as_built and not limit:
            return Outcome.NOT_FOUND, "states were examined as they are built, which proves nothing of others"
        return outcome, limit

    def _open(self) -> tuple[int, int]:
        return self.judge.undecided, self.judge.sliding + len(self.judge.forbidden)

    def _farthest_states(self) -> tuple[int, States, States]:
        deepest, rejected = (self._of_keys(keys[:REPORTED_STATES]) for keys in (self._deepest, self._rejected))
        return self._farthest, deepest, rejected

    def _place(self) -> tuple[int, int, int]:
        return 2 * self._level, len(self.parent), 0

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        # Where a disassembly ends, turns or ways in several moves might lead on.
        ends = outcome is Outcome.PROVED_IMPOSSIBLE and self.direction is Direction.DISASSEMBLY and not self._rejected
        told = ends and self.moves.again is None
        return (self.moves.first_motions(state_of_key(self._deepest[0])),) if told else ()

    def _moved(self, states: States) -> NDArray[np.int64]:
        """Return how many parts are removed, or in assembly placed, shape (batch,)."""
        removed = self._counts.removed(states)
        return removed if self.direction is Direction.DISASSEMBLY else self._counts.removals - removed

    def _reached(self, state: States) -> int:
        """Return how far a state, shape (parts,), is from the origin, of `steps`."""
        if self.moves.again is not None:
            return 2 * int(self._moved(state))
        return abs(int(self.task.steps_done(state) - self.task.steps_done(self.task.origin(self.direction))))

    def _examine(self) -> bool:
        """Judge the best state that waits; where it stands, have the steps out of it wait. Return whether it does."""
        self._level = level = max(self._waiting)
        _, number, steps = self._waiting[level][0]
        state, before = steps.state, steps.origin
        key = state.tobytes()
        new = key not in self.parent and self._stable.get(key, True)
        stands = new and self._stands(key, before, fixed=bool(steps.fixes[steps.at]))
        following = self._following(state) if stands else []
        # An interruption before leaves the state to the next run.
        steps.at += 1
        if steps.at < len(steps.fixes):
            heapreplace(self._waiting[level], (steps.worth, number, steps))
        else:
            heappop(self._waiting[level])
        if new:
            self._note(key, before, self._reached(state), stands=stands)
        for to, some in following:
            self._seen += len(some.fixes)
            heappush(self._waiting.setdefault(to, []), (some.worth, self._seen, some))
        if not self._waiting[level]:
            del self._waiting[level]
            if max(self._waiting, default=-1) < level:
                self._jump_back(level)
        return stands

    def _jump_back(self, level: int) -> None:
        """Leave out the levels before one of which no state is left, as many as `Jumps` says; at last take them up."""
        back = level - self._jumps.distance(level)
        self._jumps.since += 1
        self._left_out += [(number, self._waiting.pop(number)) for number in [*self._waiting] if number > back]
        if not self._waiting:
            for number, heap in self._left_out:
                self._waiting.setdefault(number, []).extend(heap)
            for heap in self._waiting.values():
                heapify(heap)
            self._left_out, self._jumps = [], Jumps()

    def _stands(self, key: bytes, before: bytes, *, fixed: bool) -> bool:
        """Return whether a state reached from another is stable, and at rest with its contact history too."""
        state = state_of_key(key)[None]
        if key not in self._stable:
            free = fixed and self.task.holds_keep_stable
            self._stable[key] = free or bool(self.judge.stable(state, state_of_key(before)[None])[0])
        if not self._stable[key] or self._histories is None or not before:
            return self._stable[key]
        history = self._histories.step(before, state[0])
        if history is not None:
            self._histories.keep(key, history)
            return True
        self._refused = True
        self.judge.sliding += 1
        return False

    def _note(self, key: bytes, before: bytes, reached: int, *, stands: bool) -> None:
        """Keep a state that stands, or note one that does not."""
        if stands:
            self.parent[key] = before
            self._kept += 1
        if stands and reached > self._farthest:
            self._farthest, self._deepest, self._rejected = reached, [], []
        if stands and reached == self._farthest:
            self._deepest.append(key)
        elif not stands and reached > self._farthest:
            self._rejected.append(key)

    def _following(self, state: States) -> list[tuple[int, _Steps]]:
        """Return the steps from a state that lead to new ones, by how many parts are removed or placed after them."""
        _, after, actions = self.moves.after(state[None], self.direction)
        new = np.array([one.tobytes() not in self.parent for one in after], dtype=bool)
        after, actions, counts = after[new], actions[new], self._counts
        moved = self._moved(after)
        lacking = (after != self.task.goal(self.direction)).sum(axis=1)
        burden = np.where(moved == counts.removals, lacking, counts.burden(after))
        rank = np.stack([burden, -self._scores(state, actions)], axis=1)
        fixes = ((after == state) | (after == HELD)).all(axis=1)
        order, found = np.lexsort(rank.T[::-1]), []
        for level in np.unique(moved).tolist():
            rows = order[moved[order] == level]
            found.append((level, _Steps.from_states(state, after[rows], fixes[rows], rank[rows])))
        return found

    def _scores(self, state: States, actions: NDArray[np.int64]) -> NDArray[np.floating]:
        """Return the guide's scores of steps from a state; a set counts as the part by which it is named."""
        if self._guide is None:
            return np.zeros(len(actions))
        allowed = np.zeros((1, 2 * self.task.part_count), dtype=bool)
        allowed[0, actions] = True
        return np.asarray(self._guide(state[None], allowed, self.direction))[0, actions].astype(np.float64)
