"""Planner with repeated holds: narrow beams with and without them, wider beams, and exhaustive search."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from falsework.assembly.state import REMOVED, held_count
from falsework.errors import InputError
from falsework.search.planner import Planner
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.plans.route_tests import RouteTests
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Outcome, Progress, Route, SearchCounters, SearchResult, Stop, unstable_end
from falsework.search.problem.task import STAGE, Task
from falsework.search.settings import PlannerSettings
from falsework.search.support.beam import SupportBeam
from falsework.search.support.everywhere import STATE_LIMIT, SupportEverywhere

_WIDENING = 4
"""Each round of beams is so many times wider than the last."""
_FEW_PARTS, _FEW_STATES = 16, 5_000
"""Up to this number of parts, so many states are searched exhaustively before a beam is widened, which decides small
structures."""
_MOST_FALLS = 64
"""Number of routes with a failing replay before a search is given up."""

_Search = SupportBeam | SupportEverywhere | Planner


class SupportPlanner:
    """Planner of a task with repeated holds; it runs, stops and resumes like `Planner`.

    A plan in which every part is held once is a plan here too, so narrow beams for one are among the first. Only
    `SupportEverywhere`, which is exhaustive, can prove that no plan exists.
    """

    def __init__(
        self, task: Task, oracle: Oracle, settings: PlannerSettings = PlannerSettings(), *, guide: Guide
    ) -> None:
        """Begin with nothing.

        Args:
            task: rules between start and target, with `Task.support`.
            oracle: decides stability.
            settings: effort of the search.
            guide: scores actions.

        Raises:
            InputError: more than one plan is asked for, or a judge.
        """
        if settings.judge:
            raise InputError("plans with repeated holds have no judge yet; leave it out")
        if settings.alternatives > 1:
            raise InputError("plans with repeated holds have no alternatives yet; ask for one plan")
        self.task = task.judged_by(oracle)
        self.settings = settings
        self.routes: list[Route] = []
        """The plan, once it is found."""
        self.done = False
        """Whether there is nothing left to do."""
        self._oracle, self._guide = oracle, guide
        self._tests = RouteTests(oracle, settings, task.part_count)
        self._todo = self._searches()
        self._running: _Search | None = None
        self._falls = 0
        self._failure: SearchResult | None = None
        self._counters, self._now = SearchCounters(), SearchCounters()
        self._seconds = 0.0

    @property
    def fallen(self) -> tuple[Route, int] | None:
        """Route whose replay gets farthest before it fails, and the step of assembly at which it fails."""
        return self._tests.fallen

    @property
    def replays(self) -> dict[bytes, PlanReplay]:
        """Replays that come to rest in every state, by the states of the routes."""
        return self._tests.replays

    @property
    def counters(self) -> SearchCounters:
        """Work done so far by all searches."""
        return self._counters + self._now

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until a plan is found, all searches end, or `stop` returns true; then it can be run on.

        Args:
            progress: called after every level of every search.
            stop: called before every level.
        """
        begun, result, interrupted = time.perf_counter(), self._failure, False
        failed = unstable_end(self.task, self._oracle)
        if failed is not None:
            self.done = True
            return failed
        try:
            while not self.done and not interrupted:
                if self._running is None:
                    self._running, self._falls = self._todo.pop(0)(), 0
                result = self._running.run(progress=progress, stop=stop)
                self._now, interrupted = result.counters, result.interrupted
                if result.found:
                    self._take(result.routes[0])
                if not interrupted and not self.routes and (not result.found or self._falls == _MOST_FALLS):
                    self._failed(result)
        except KeyboardInterrupt:
            interrupted = True
        self._seconds += time.perf_counter() - begun
        if self.routes:
            assert result is not None
            result = replace(result, outcome=Outcome.FOUND, routes=tuple(self.routes), limit="")
            interrupted = False
        elif self._failure is not None and (result is None or self.done or _share(self._failure) >= _share(result)):
            result = self._failure
        if result is None:  # interrupted before the first search had a result
            result = SupportEverywhere(self.task, self._oracle).result(interrupted=True)
        return replace(result, counters=self.counters, seconds=self._seconds, interrupted=interrupted)

    def _searches(self) -> list[Callable[[], _Search]]:
        """Return factories of the searches in the order in which they are tried."""
        task, oracle, guide, settings = self.task, self._oracle, self._guide, self.settings

        def once() -> Planner:
            plain = replace(task, support=False)
            return Planner(plain, oracle, replace(settings, width=1), guide=guide)

        def beam(direction, width: int) -> Callable[[], _Search]:
            return lambda: SupportBeam(task, oracle, direction, guide=guide, width=width, seed=settings.seed)

        widths = [_WIDENING**k for k in range(1 + int(np.log(settings.width) / np.log(_WIDENING) + 1e-9))]
        # The other end is tried after a wider beam from the first failed: for most structures it costs more.
        ranks = sorted((i + j, j, i) for i in range(len(widths)) for j in range(len(settings.directions)))
        beams = [beam(settings.directions[j], widths[i]) for _, j, i in ranks]
        if (STAGE[task.target] >= STAGE[task.start]).all():
            beams.insert(min(3, len(beams)), once)
        if int((task.start != REMOVED).sum()) - int(task.boundary.sum()) <= _FEW_PARTS:
            beams.insert(1, lambda: SupportEverywhere(task, oracle, state_limit=_FEW_STATES))
        return [*beams, lambda: SupportEverywhere(task, oracle, state_limit=STATE_LIMIT)]

    def _take(self, route: Route) -> None:
        """Accept a route that passes all tests; else exclude the states in which it fails."""
        excluded = len(self._tests.forbidden)
        if isinstance(self._running, Planner):  # which has tested it
            self.replays.update(self._running.replays)
        elif not self._tests.passes(route):
            self._falls += 1
            if isinstance(self._running, SupportBeam | SupportEverywhere):
                for state in self._tests.forbidden[excluded:]:
                    self._running.forbid(state)
            return
        self.routes, self.done = [route], True

    def _failed(self, result: SearchResult) -> None:
        """Give up a search and continue with the next; a proof ends all of them."""
        if result.found:
            limit = f"{self._falls} plans were found, and in each a state tips or the replay fails"
            result = replace(result, outcome=Outcome.NOT_FOUND, routes=(), limit=limit)
        if isinstance(self._running, Planner):  # which proves nothing about plans with repeated holds
            result = replace(result, outcome=Outcome.NOT_FOUND)
        # Even without a proof, no other search finds a plan after an exhaustive one.
        proved = isinstance(self._running, SupportEverywhere) and not self._running.gave_up and not self._falls
        if proved or self._failure is None or _share(result) >= _share(self._failure):
            self._failure = result
        self._counters, self._now = self.counters, SearchCounters()
        self._running = None
        self.done = proved or not self._todo


def _share(result: SearchResult) -> float:
    return result.reached / max(result.steps, 1)


def planner_for(task: Task, oracle: Oracle, settings: PlannerSettings, *, guide: Guide) -> Planner | SupportPlanner:
    """Return the planner for a task: with repeated holds if they are allowed and can make a difference.

    A single robot that releases a part without removing it returns to the state before the hold. So between states in
    which nothing is held, and without props, repeated holds allow it nothing more.
    """
    nothing_held = not held_count(np.stack([task.start, task.target]), task.boundary).any()
    if not task.support or (task.robots == 1 and not task.prop_limit and nothing_held):
        return Planner(task, oracle, settings, guide=guide)
    return SupportPlanner(task, oracle, settings, guide=guide)
