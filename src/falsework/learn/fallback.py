"""What a replanner does where rollouts of the policy are not enough: searches, a slice of time each in turn."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.learn.answer import Decider
from falsework.learn.clock import Clock
from falsework.learn.guide import PolicyGuide
from falsework.learn.job import Job
from falsework.search.beam import BeamSearch, BeamSettings
from falsework.search.exhaustive import ExhaustiveSearch
from falsework.search.find import choose_plans
from falsework.search.guide import Guide
from falsework.search.planner import Planner, PlannerSettings
from falsework.search.result import Outcome, SearchResult, Stop
from falsework.search.task import Direction

SLICE = 0.05
"""Seconds that a search has before it is the turn of another request's."""


class _Search(Protocol):
    def run(self, *, stop: Stop | None = None) -> SearchResult:
        """As of `BeamSearch`."""
        ...


class _Census:
    """A search through all states, run like the others."""

    def __init__(self, search: ExhaustiveSearch) -> None:
        self._search = search

    def run(self, *, stop: Stop | None = None) -> SearchResult:
        return self._search.run(stop=stop).result


class _TimedGuide:
    """A guide whose time is put to the policy's account."""

    def __init__(self, guide: PolicyGuide, clock: Clock) -> None:
        self._guide = guide
        self._clock = clock

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        with self._clock.spend("policy"):
            return self._guide(states, actions, direction)


def search_on(job: Job, guide: Guide, *, alone: bool) -> Iterator[None]:
    """Look for what the rollouts did not find: a plan, later missing parts, other plans; or prove that there is none.

    Args:
        job: what is asked, and what was found.
        guide: of the search without a policy.
        alone: whether no other request waits.

    Yields:
        Whenever it is another request's turn.
    """
    slice_ = None if alone else SLICE
    if job.kit.guide is not None and not job.decided:
        timed = _TimedGuide(job.kit.guide.for_task(job.task), job.clock)
        for width in job.kit.settings.widths:
            settings = BeamSettings(width, Direction.DISASSEMBLY, "none", retries=0, seed=job.request.seed)
            beam = BeamSearch(job.task, job.oracle, settings, guide=timed)
            job.ended((yield from _run(beam, job, slice_)), Decider.GUIDED)
            if job.decided or job.clock.passed:
                break
    wanted = len(job.routes) < job.request.alternatives or job.task.missing
    if job.outcome is not Outcome.PROVED_IMPOSSIBLE and wanted and not job.clock.passed:
        yield from _plan(job, guide, slice_)
    if not job.decided and not job.clock.passed:
        census = _Census(ExhaustiveSearch(job.task, job.oracle, state_limit=job.kit.settings.state_limit))
        job.ended((yield from _run(census, job, slice_)), Decider.EXHAUSTIVE)


def _plan(job: Job, guide: Guide, slice_: float | None) -> Iterator[None]:
    request = job.request
    settings = PlannerSettings(job.kit.settings.width, alternatives=request.alternatives, seed=request.seed)
    planner = Planner(job.task, job.oracle, settings, guide=guide)
    if job.routes:
        planner.begin_with(job.routes[0])
        planner.states = np.concatenate([route.states for route in job.routes])
    job.ended((yield from _run(planner, job, slice_)), Decider.SEARCH)
    if planner.routes:
        job.routes = list(choose_plans(planner, settings, job.kit.assembly.name).routes)


def _run(search: _Search, job: Job, slice_: float | None) -> Generator[None, None, SearchResult]:
    """Run a search to its end or the deadline, a slice of time at once."""
    turn = _Turn(job.clock, slice_)
    while True:
        turn.begin()
        result = search.run(stop=turn.over)
        if not result.interrupted or job.clock.passed:
            return result
        if not turn.told:  # not the clock but somebody at the keyboard
            raise KeyboardInterrupt
        yield


class _Turn:
    """Tells a search when its turn is over."""

    def __init__(self, clock: Clock, seconds: float | None) -> None:
        self.told = False
        """Whether the search was told to stop."""
        self._clock = clock
        self._seconds = np.inf if seconds is None else seconds
        self._end = np.inf

    def begin(self) -> None:
        self.told = False
        self._end = time.perf_counter() + self._seconds

    def over(self) -> bool:
        self.told = self._clock.passed or time.perf_counter() > self._end
        return self.told
