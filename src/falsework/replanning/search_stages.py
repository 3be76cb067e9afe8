"""Search stages of a replanner, interleaved in time slices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.result import Stage
from falsework.replanning.session import ReplanSession
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.exhaustive import ExhaustiveSearch
from falsework.search.planner import Planner
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.guide import Guide
from falsework.search.problem.result import Outcome, Progress, SearchProgress, SearchResult, Stop
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction
from falsework.search.settings import PlannerSettings
from falsework.utils.interruption import interrupted_by

_PLAIN_LEVELS = 4
"""Levels of the plain search for each level of the policy-guided one, which evaluates a network as well. A count, not
a time, so that the same seed gives the same answer."""
_SHARE = 0.5
"""Share of the time before a deadline that the guided search may take."""
_CHOOSING = 0.3
"""Share of the time before a deadline that is kept for choosing among many plans."""
_TURN_LEVELS = 8
"""Levels that a search has before it is the turn of another request, where it searches alone."""


class _ReachabilityStage:
    """Exhaustive search that goes on where the replay of a route fails."""

    def __init__(self, session: ReplanSession) -> None:
        self._session = session
        self._search = ExhaustiveSearch(session.task, session.oracle, state_limit=session.context.settings.state_limit)

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        session, census = self._session, self._search.run(progress=progress, stop=stop)
        result, states = census.result, census.graph.states
        while result.found and not session.stands(result.routes[0], Stage.EXHAUSTIVE):
            # Each turn excludes a state, so that the loop ends; but a route of one step has none to exclude.
            left = states[~session.oracle.rules_out(states)]
            graph = StateGraph.from_states(session.task, left)
            route = graph.sample_route(np.random.default_rng(session.request.seed)) if len(left) < len(states) else None
            states = left
            if route is None:
                return replace(result, outcome=Outcome.NOT_FOUND, routes=())
            result = replace(result, routes=(route,))
        return result


class _GuidedBeams:
    """Beams that the policy guides, each wider than the one before, until the replay of a route succeeds."""

    def __init__(self, session: ReplanSession, guide: Guide) -> None:
        self._session, self._guide = session, guide
        self._widths = iter(session.context.settings.widths)
        self._search = self._beam(next(self._widths))

    def _beam(self, width: int) -> BeamSearch:
        settings = BeamSettings(width, Direction.DISASSEMBLY, "none", seed=self._session.request.seed)
        return BeamSearch(self._session.task, self._session.oracle, settings, guide=self._guide)

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        session = self._session
        while True:
            result = self._search.run(progress=progress, stop=stop)
            if result.found and not session.stands(result.routes[0], Stage.GUIDED):
                states = result.routes[0].states
                self._search.forbid(states[session.oracle.rules_out(states)])
                if self._search.found:  # nothing lies between the ends
                    return replace(result, outcome=Outcome.NOT_FOUND, routes=())
                continue
            ended = result.interrupted or result.found or result.outcome is Outcome.PROVED_IMPOSSIBLE
            wider = None if ended else next(self._widths, None)
            if wider is None:
                return result
            self._search = self._beam(wider)


def _timed(guide: PolicyGuide, clock: Deadline) -> Guide:
    """Return an action heuristic whose time counts as the policy's."""

    def scores(states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        with clock.timed("policy"):
            return guide(states, actions, direction)

    return scores


def search_on(session: ReplanSession, guide: Guide) -> Iterator[None]:
    """Search for a plan, later missing parts or alternatives, or prove that there is no plan.

    A policy that has just failed is not a reliable guide, so the search that it guides and the plain one take turns.

    Yields:
        Whenever it may be another request's turn.
    """
    if not session.routes:
        yield from _first_plan(session, guide)
    if session.routes and not session.done:
        yield from _better_plans(session, guide)
    task = session.task  # searches that hold parts again, or move several, end by examining every state themselves
    if not (session.decided or session.clock.passed or task.allow_regrasp or task.together is not None):
        yield from _finish([TimeSlices(_ReachabilityStage(session).run, Stage.EXHAUSTIVE, _TURN_LEVELS)], session)


def _first_plan(session: ReplanSession, guide: Guide) -> Iterator[None]:
    settings = PlannerSettings(session.context.settings.width, seed=session.request.seed)
    # Later missing parts are looked for once there is a plan.
    task = replace(session.task, missing=(), postponed=())
    rivals = [TimeSlices(Planner(task, session.oracle, settings, guide=guide).run, Stage.SEARCH, _PLAIN_LEVELS)]
    policy = session.context.guide
    if policy is not None and not task.allow_regrasp and _affordable(session, policy):
        guided = _GuidedBeams(session, _timed(policy.for_task(session.task), session.clock))
        rivals.insert(0, TimeSlices(guided.run, Stage.GUIDED, 1))
    yield from _finish(rivals, session)


def _affordable(session: ReplanSession, policy: PolicyGuide) -> bool:
    """Return whether there is time for a beam that the policy guides beside the plain search."""
    widths = session.context.settings.widths
    if not widths:
        return False
    return policy.seconds_for(widths[0]) * session.task.steps < _SHARE * (session.clock.left - session.clock.reserve)


def _better_plans(session: ReplanSession, guide: Guide) -> Iterator[None]:
    request = session.request
    settings = PlannerSettings(session.context.settings.width, alternatives=request.alternatives, seed=request.seed)
    planner = Planner(session.task, session.oracle, settings, guide=guide)
    planner.begin_with(session.routes[0])
    planner.states = np.concatenate([route.states for route in session.routes])
    clock, reserve = session.clock, session.clock.reserve
    if clock.limited and request.alternatives > 1:
        clock.reserve += _CHOOSING * (clock.left - reserve)
    yield from _finish([TimeSlices(planner.run, Stage.SEARCH, _TURN_LEVELS)], session)
    clock.reserve = reserve
    if request.alternatives == 1:
        session.take(planner.routes)
        return
    states = np.concatenate([planner.states, *(route.states for route in planner.routes)])
    session.take(session.choose(session.task.postpone(planner.postponed), states, planner.routes))


def _finish(rivals: list[TimeSlices], session: ReplanSession) -> Iterator[None]:
    """Let searches take turns until one finds a plan or proves that there is none, all are at an end, or time is up."""
    while rivals:
        for rival in list(rivals):
            result = rival.take(session)
            if result is not None:
                session.ended(result, rival.decider)
                rivals.remove(rival)
                if session.decided:
                    return
            if session.clock.passed:
                session.busy = True
                try:
                    for rest in rivals:
                        if (last := rest.run(lambda: True)) is not None:
                            session.ended(last, rest.decider)
                finally:
                    session.busy = False
                return
        yield


class TimeSlices:
    """Search that runs some levels per turn."""

    def __init__(self, search: Callable[..., SearchResult], decider: Stage, levels: int) -> None:
        self._search = search
        self.decider = decider
        self._levels = levels
        self._left = 0
        self._told = False
        self._session: ReplanSession | None = None

    def take(self, session: ReplanSession) -> SearchResult | None:
        """Search for a turn; the result if the search is at its end.

        Raises:
            KeyboardInterrupt: interrupted from the keyboard.
        """
        self._left, self._session, self._told, session.busy = self._levels, session, False, True
        try:
            with interrupted_by(session.clock.check):
                result = self.run(self._over)
        finally:
            session.busy = False
        if result is None or not result.interrupted:
            return result
        if not self._told and not session.clock.passed:
            raise KeyboardInterrupt
        return None

    def run(self, stop: Stop) -> SearchResult | None:
        """Run the search; None if the deadline passed before it had anything to report."""
        try:
            return self._search(progress=self._count, stop=stop)
        except DeadlineExceeded:
            return None

    def _over(self) -> bool:
        session = self._session
        if session is not None:
            session.clock.between()
        self._told = self._left <= 0 or (session is not None and session.clock.passed)
        return self._told

    def _count(self, _: SearchProgress) -> None:
        self._left -= 1
