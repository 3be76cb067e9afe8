"""Search: what can be paused, run on and told of states to leave out; all strategies of a planner are of this kind."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from falsework.assembly.state import States
from falsework.search.problem.result import (
    Outcome,
    Progress,
    Route,
    SearchCounters,
    SearchProgress,
    SearchResult,
    Stop,
)
from falsework.search.problem.task import Direction, Task

if TYPE_CHECKING:
    from falsework.search.problem.oracle import CountingOracle
    from falsework.search.problem.plan_replay import PlanReplay
    from falsework.stability.contact.history import Presses


class Search(ABC):
    """Search for a way from one end of a task to the other, step by step."""

    task: Task
    direction: Direction
    """End at which it begins."""
    judge: CountingOracle
    """Asked for verdicts."""
    _seconds = 0.0
    _widest = 0
    """Width beyond which the present run does not restart."""
    _stop: Stop | None = None
    """Of the present run."""
    _over = False
    """Whether nothing is left to try within the width of the present run."""

    @property
    @abstractmethod
    def found(self) -> bool:
        """Whether the goal is reached."""

    @property
    @abstractmethod
    def done(self) -> bool:
        """Whether the goal is reached or nothing is left to try within the width of the present run."""

    @property
    @abstractmethod
    def counters(self) -> SearchCounters:
        """Work done so far, earlier runs included; takes time with the levels, unlike `asked`."""

    @property
    def asked(self) -> int:
        """Verdicts requested so far, earlier runs included."""
        return self.judge.asked

    @property
    def effort(self) -> float:
        """Verdicts so far; failed replays count by their iterations, in units of the mean of steps at rest."""
        return self.asked

    @property
    def work(self) -> int:
        """Work of verdicts so far, earlier runs included, see `CountingOracle.work`; 0 where replays decide."""
        return self.judge.work

    @property
    def level(self) -> int:
        """Step at which the search is."""
        return self._place()[0]

    @abstractmethod
    def step(self) -> bool:
        """Take the next step; False if it led nowhere. An interruption leaves the search as it was before."""

    @abstractmethod
    def forbid(self, states: States) -> None:
        """Rule states out from now on, shape (count, parts), and go back to where none of them is on the way."""

    @abstractmethod
    def go_back(self, state: States) -> None:
        """Go back to where a state, shape (parts,), is not on the way yet: what leads there is to be tried anew."""

    @abstractmethod
    def route(self) -> Route:
        """Return the way found, in disassembly order; only once `found`."""

    @abstractmethod
    def _failure(self) -> tuple[Outcome, str]:
        """Return the outcome of a search that found nothing, and the limit that it met, if any."""

    @abstractmethod
    def _farthest_states(self) -> tuple[int, States, States]:
        """Return how many steps the search came, some of the states there, and some that were rejected beyond."""

    @abstractmethod
    def _place(self) -> tuple[int, int, int]:
        """Return the step at which the search is, the number of states kept there, and its width, 0 without limit."""

    def states(self) -> States:
        """Return the stable states that it keeps, shape (count, parts), from which alternatives are chosen."""
        return self.route().states

    @property
    def examined_all(self) -> bool:
        """Whether the search came to its end with no state left out, under all rules: no other finds a plan then."""
        return False

    @property
    def steps(self) -> int:
        """Steps of a whole plan, as the search counts them."""
        return self.task.steps

    def replay_summary(self) -> PlanReplay | None:
        """Return the replay of the route found; None where it is not known."""
        return None

    def built(self) -> tuple[States, Presses] | None:
        """Return the states on the way to the best state so far, in assembly order, and the presses of these steps.

        Returns:
            Shape (steps + 1, parts), and one entry a state; None where the search does not replay what it builds.
        """
        return None

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until the goal is reached, nothing is left, or `stop` or the keyboard interrupts the search.

        Args:
            widest: width beyond which a search that restarts wider does not; run again with a larger one to go on.
            progress: called after every step.
            stop: asked before every step, of several processes in all alike; true stops the search, which can then be
                run on.

        Returns:
            A found route, or how far the search came; `interrupted` after an interruption.
        """
        begun, interrupted = time.perf_counter(), False
        self._widest, self._stop, self._over = widest, stop, False
        try:
            while not self.done:
                if stop is not None and stop():
                    interrupted = True
                    break
                self.step()
                if progress is not None:
                    (level, kept, width), seconds = self._place(), self._seconds + time.perf_counter() - begun
                    progress(SearchProgress(self.direction, level, self.steps, kept, width, self.asked, seconds))
        except KeyboardInterrupt:
            interrupted = True
        self._seconds += time.perf_counter() - begun
        return self.result(interrupted=interrupted)

    def result(self, *, interrupted: bool = False) -> SearchResult:
        """Return the result so far; `interrupted` if the search was stopped from outside."""
        outcome, limit = (Outcome.FOUND, "") if self.found else (Outcome.NOT_FOUND, "")
        if not self.found and not interrupted:
            outcome, limit = self._failure()
        reached, deepest, rejected = self._farthest_states()
        undecided, sliding = self._open()
        return SearchResult(
            outcome=outcome,
            routes=(self.route(),) if self.found else (),
            direction=self.direction,
            steps=self.steps,
            reached=reached,
            deepest=deepest,
            rejected=rejected,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=undecided,
            sliding=sliding,
            notes=self._notes(outcome),
        )

    def _open(self) -> tuple[int, int]:
        """Return how many rejected states are undecided, and how many slide."""
        return self.judge.undecided, self.judge.sliding

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        """Return what else is to be said of a result."""
        return ()
