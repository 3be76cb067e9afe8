"""What a replanner does where rollouts of the policy are not enough: searches, a slice of time each in turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.deadline import Clock
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.result import Decider
from falsework.replanning.session import Job
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.exhaustive import ExhaustiveSearch
from falsework.search.planner import Planner
from falsework.search.problem.guide import Guide
from falsework.search.problem.result import Outcome, SearchResult, Stop
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction
from falsework.search.settings import PlannerSettings

_PLAIN_LEVELS = 4
"""Levels of the plain search for each level of the one that the policy guides, which asks a network too. A count, not
a time, so that the same seed gives the same answer."""
_SHARE = 0.5
"""Share of the time before a deadline that the guided search may take."""
_CHOOSING = 0.3
"""Share of the time before a deadline that is kept for choosing among many plans."""
_TURN_LEVELS = 8
"""Levels that a search has before it is the turn of another request, where it searches alone."""


class _Search(Protocol):
    def run(self, *, stop: Stop | None = None) -> SearchResult:
        """As of `BeamSearch`."""
        ...


class _Census:
    """A search through all states, run like the others."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._search = ExhaustiveSearch(job.task, job.oracle, state_limit=job.kit.settings.state_limit)

    def run(self, *, stop: Stop | None = None) -> SearchResult:
        job, census = self._job, self._search.run(stop=stop)
        result, states = census.result, census.graph.states
        while result.found and not job.stands(result.routes[0], Decider.EXHAUSTIVE):
            # Each turn rules a state out, so that there is an end; but a route of one step has none to rule out.
            left = states[~job.oracle.rules_out(states)]
            graph = StateGraph.build(job.task, left)
            route = graph.sample_route(np.random.default_rng(job.request.seed)) if len(left) < len(states) else None
            states = left
            if route is None:
                return replace(result, outcome=Outcome.NOT_FOUND, routes=())
            result = replace(result, routes=(route,))
        return result


class _TimedGuide:
    """A guide whose time is put to the policy's account."""

    def __init__(self, guide: PolicyGuide, clock: Clock) -> None:
        self._guide = guide
        self._clock = clock

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        with self._clock.spend("policy"):
            return self._guide(states, actions, direction)


def search_on(job: Job, guide: Guide) -> Iterator[None]:
    """Look for what the rollouts did not find: a plan, later missing parts, other plans; or prove that there is none.

    A policy that has just failed is no safe guide, so the search that it guides and the plain one take turns.

    Args:
        job: what is asked, and what was found.
        guide: of the search without a policy.

    Yields:
        Whenever it may be another request's turn.
    """
    if not job.routes:
        yield from _first_plan(job, guide)
    if job.routes and not job.settled:
        yield from _better_plans(job, guide)
    if not job.decided and not job.clock.passed:
        yield from _finish([_Turns(_Census(job), Decider.EXHAUSTIVE, _TURN_LEVELS)], job)


def _first_plan(job: Job, guide: Guide) -> Iterator[None]:
    settings = PlannerSettings(job.kit.settings.width, seed=job.request.seed)
    # Later missing parts are looked for once there is a plan.
    task = replace(job.task, missing=(), postponed=())
    rivals = [_Turns(Planner(task, job.oracle, settings, guide=guide), Decider.SEARCH, _PLAIN_LEVELS)]
    policy = job.kit.guide
    if policy is not None and _affordable(job, policy):
        timed = _TimedGuide(policy.for_task(job.task), job.clock)
        rivals.insert(0, _Turns(_Widening(job, timed), Decider.GUIDED, 1))
    yield from _finish(rivals, job)


def _affordable(job: Job, policy: PolicyGuide) -> bool:
    """Whether there is time for a beam that the policy guides beside the plain search."""
    widths = job.kit.settings.widths
    if not widths:
        return False
    return policy.seconds_for(widths[0]) * job.task.steps < _SHARE * (job.clock.left - job.clock.reserve)


def _better_plans(job: Job, guide: Guide) -> Iterator[None]:
    request = job.request
    settings = PlannerSettings(job.kit.settings.width, alternatives=request.alternatives, seed=request.seed)
    planner = Planner(job.task, job.oracle, settings, guide=guide)
    planner.begin_with(job.routes[0])
    planner.states = np.concatenate([route.states for route in job.routes])
    clock, reserve = job.clock, job.clock.reserve
    if clock.limited and request.alternatives > 1:
        clock.reserve += _CHOOSING * (clock.left - reserve)
    yield from _finish([_Turns(planner, Decider.SEARCH, _TURN_LEVELS)], job)
    clock.reserve = reserve
    if request.alternatives == 1:
        job.take(planner.routes)
        return
    states = np.concatenate([planner.states, *(route.states for route in planner.routes)])
    job.take(job.choose(planner.task.postpone(planner.postponed), states, planner.routes))


def _finish(rivals: list[_Turns], job: Job) -> Iterator[None]:
    """Let searches take turns until one finds a plan or proves that there is none, all are at an end, or time is up."""
    while rivals:
        for rival in list(rivals):
            result = rival.take(job)
            if result is not None:
                job.ended(result, rival.decider)
                rivals.remove(rival)
                if job.decided:
                    return
            if job.clock.passed:
                job.busy = True
                try:
                    for rest in rivals:
                        job.ended(rest.search.run(stop=lambda: True), rest.decider)
                finally:
                    job.busy = False
                return
        yield


class _Turns:
    """A search that stops after some levels, to go on in its next turn."""

    def __init__(self, search: _Search, decider: Decider, levels: int) -> None:
        self.search = search
        self.decider = decider
        self._levels = levels
        self._left = 0
        self._told = False
        self._job: Job | None = None

    def take(self, job: Job) -> SearchResult | None:
        """Search for a turn; the result if the search is at its end.

        Raises:
            KeyboardInterrupt: somebody at the keyboard wants an end.
        """
        self._left, self._job, self._told, job.busy = self._levels, job, False, True
        try:
            result = self.search.run(stop=self._over)
        finally:
            job.busy = False
        if not result.interrupted:
            return result
        if not self._told and not job.clock.passed:
            raise KeyboardInterrupt
        return None

    def _over(self) -> bool:
        job = self._job
        if job is not None:
            job.others()
        self._told = self._left == 0 or (job is not None and job.clock.passed)
        self._left -= 1
        return self._told


class _Widening:
    """Beams that the policy guides, each wider than the one before."""

    def __init__(self, job: Job, guide: Guide) -> None:
        self._job = job
        self._guide = guide
        self._number = 0
        self._beam: BeamSearch | None = None

    def run(self, *, stop: Stop | None = None) -> SearchResult:
        widths = self._job.kit.settings.widths
        while True:
            if self._beam is None:
                width, seed = widths[self._number], self._job.request.seed
                settings = BeamSettings(width, Direction.DISASSEMBLY, "none", retries=0, seed=seed)
                self._beam = BeamSearch(self._job.task, self._job.oracle, settings, guide=self._guide)
            result = self._beam.run(stop=stop)
            if result.found and not self._job.stands(result.routes[0], Decider.GUIDED):
                states = result.routes[0].states
                self._beam.forbid(states[self._job.oracle.rules_out(states)])
                if self._beam.found:  # nothing lies between the ends
                    return replace(result, outcome=Outcome.NOT_FOUND, routes=())
                continue
            proved = result.outcome is Outcome.PROVED_IMPOSSIBLE
            if result.interrupted or result.found or proved or self._number == len(widths) - 1:
                return result
            self._number, self._beam = self._number + 1, None
