"""Depth-first search with backtracking: the baseline of the paper (section 7.2), preferring moves that free a robot."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework import Direction, Outcome, Task
from falsework.assembly import States
from falsework.errors import InputError
from falsework.search import Guide, Oracle, SearchProgress
from falsework.search.beam.frontier import expand
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.oracle import CountingOracle
from falsework.search.problem.result import Progress, Route, SearchCounters, SearchResult, Stop

_REPORTED_STATES = 64


@dataclass(frozen=True)
class DepthFirstSettings:
    """Settings of a depth-first search."""

    direction: Direction = Direction.DISASSEMBLY
    """Which end to begin at."""
    seed: int = 0
    """Order of moves that are otherwise equal."""
    state_limit: int = 100_000
    """Give up after this many states were entered."""

    def __post_init__(self) -> None:
        if self.state_limit < 1:
            raise InputError(f"a limit of {self.state_limit} states allows no search; give at least 1")


class DepthFirstSearch:
    """Depth-first search with backtracking that can be saved and resumed.

    A state is entered once: one that was left behind without success cannot succeed on another way. Moves that free a
    robot come first, since holding more is nearly always possible and rarely of use by itself.
    """

    def __init__(
        self,
        task: Task,
        oracle: Oracle,
        settings: DepthFirstSettings = DepthFirstSettings(),
        *,
        guide: Guide | None = None,
    ) -> None:
        """Begin at the origin of the direction; the start and the target are taken as stable.

        Args:
            task: rules between start and target.
            oracle: decides stability.
            settings: direction, seed, and when to give up.
            guide: scores actions; without it moves of a kind are tried in random order.
        """
        self.task = task = task.judged_by(oracle)
        self.settings = settings
        self._judge = CountingOracle(oracle)
        self._guide = guide
        self._hash = StateHash.for_parts(task.part_count)
        self._path: list[States] = []
        self._untried: list[list[int]] = []
        self._entered: set[bytes] = set()
        self._candidates = 0
        self._seconds = 0.0
        self._reached = 0
        self._deepest = np.empty((0, task.part_count), dtype=np.uint8)
        self._rejected = np.empty((0, task.part_count), dtype=np.uint8)
        origin = task.origin(settings.direction)
        if task.contains(origin[None])[0]:
            self._enter(origin)

    @property
    def found(self) -> bool:
        """Whether the goal is reached."""
        return len(self._path) == self.task.steps + 1

    @property
    def done(self) -> bool:
        """Whether the goal is reached or every state was tried."""
        return self.found or not self._path

    @property
    def gave_up(self) -> bool:
        """Whether the limit on states is reached."""
        return len(self._entered) >= self.settings.state_limit

    @property
    def counters(self) -> SearchCounters:
        """Work done so far, earlier runs included."""
        return SearchCounters(len(self._entered), self._candidates, self._judge.asked, self._judge.rejected)

    def step(self) -> None:
        """Enter the next state, or go back by one."""
        if self.done:
            return
        state, untried = self._path[-1], self._untried[-1]
        while untried:
            child = self.task.follow(state[None], np.array(untried[-1:]), self.settings.direction)[0]
            if child.tobytes() not in self._entered:
                # The move is crossed out only afterwards, so that an interruption in between does not lose it.
                self._enter(child)
                untried.pop()
                return
            untried.pop()
        self._path.pop()
        self._untried.pop()

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Step until the goal is reached, every state was tried, or something stops it.

        Args:
            progress: called after every step.
            stop: asked before every step; true stops the search, which can then be run on.
        """
        begun = time.perf_counter()
        interrupted = False
        try:
            while not self.done and not self.gave_up:
                if stop is not None and stop():
                    interrupted = True
                    break
                self.step()
                if progress is not None:
                    progress(self._report(time.perf_counter() - begun))
        except KeyboardInterrupt:
            interrupted = True
        self._seconds += time.perf_counter() - begun
        return self._result(interrupted)

    def _enter(self, state: States) -> None:
        """Put a state on the path, with its stable moves in the order in which they are to be tried."""
        level = state[None]
        frontier = expand(self.task, self.settings.direction, level, self._hash)
        candidates = frontier.candidates()
        stable = frontier.free(candidates)
        asked = candidates[~stable]
        if len(asked):
            stable[~stable] = self._judge.stable(frontier.states(asked), frontier.level[frontier.parent(asked)])
        self._candidates += len(frontier)
        rows = candidates[stable]
        rng = np.random.default_rng((self.settings.seed, len(self._entered)))
        preference = self._preference(level, frontier.action(rows))
        # The last of the list is tried first.
        order = np.lexsort((rng.random(len(rows)), preference))
        if len(self._path) > self._reached or not len(self._deepest):
            self._reached, self._deepest = len(self._path), level
            self._rejected = frontier.states(candidates[~stable][:_REPORTED_STATES])
        self._path.append(state)
        self._untried.append(frontier.action(rows[order]).tolist())
        self._entered.add(state.tobytes())

    def _preference(self, level: States, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        if self._guide is not None:
            mask = self.task.moves(level, self.settings.direction)
            return np.asarray(self._guide(level, mask, self.settings.direction), dtype=np.float64)[0, actions]
        return (~self.task.fixes(actions, self.settings.direction)).astype(np.float64)

    def _report(self, seconds: float) -> SearchProgress:
        return SearchProgress(
            self.settings.direction,
            max(len(self._path) - 1, 0),
            self.task.steps,
            len(self._entered),
            0,
            self._judge.asked,
            seconds,
        )

    def _result(self, interrupted: bool) -> SearchResult:
        limit, routes = "", ()
        undecided, sliding = self._judge.undecided, self._judge.sliding
        if self.found:
            outcome, routes = Outcome.FOUND, (self._route(),)
        elif self.done and not interrupted and undecided == 0 and sliding == 0 and not self.task.caveat:
            outcome = Outcome.PROVED_IMPOSSIBLE
        else:
            outcome = Outcome.NOT_FOUND
            if self.gave_up:
                limit = f"gave up after {self.settings.state_limit} states; raise the limit or use a beam search"
            elif undecided:
                limit = f"{undecided} states could be proved neither stable nor unstable"
            elif sliding:
                limit = f"no plan was found in which every state is stable: {sliding} states slide"
            elif self.done and not interrupted:
                limit = self.task.caveat
        return SearchResult(
            outcome=outcome,
            routes=routes,
            direction=self.settings.direction,
            steps=self.task.steps,
            reached=self._reached,
            deepest=self._deepest,
            rejected=self._rejected,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=undecided,
            sliding=sliding,
        )

    def _route(self) -> Route:
        states = np.array(self._path)
        if self.settings.direction is Direction.ASSEMBLY:
            states = states[::-1].copy()
        return Route.from_states(states)
