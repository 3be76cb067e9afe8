"""Replanner: a policy proposes plans, searches complement it, and every state of a plan is proven stable.

First the policy's most probable actions, then actions drawn from its probabilities, then beam searches that it guides,
then the search that needs no policy, finally an exhaustive search. The output of a policy is never trusted: the result
is a plan of proven states, a proof that there is none, or the statement that none was found yet.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.props import whole_state
from falsework.errors import InputError
from falsework.replanning.named_state import StateLike
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.policy_stages import follow_greedily, follow_samples, of_one_kind, with_time
from falsework.replanning.proving import Prover
from falsework.replanning.request import Request as Request
from falsework.replanning.result import ReplanResult as ReplanResult
from falsework.replanning.result import Stage as Stage
from falsework.replanning.search_stages import search_on
from falsework.replanning.session import ReplanContext, ReplanSession
from falsework.replanning.session import ReplanSettings as ReplanSettings
from falsework.replanning.since import SiteSteps
from falsework.search.find import FIRST_SHARE, PLANS
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_file import is_plan_file, load_plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.guide import Guide, SupportGuide
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.models import check_options

_END = object()
Finished = Callable[[int, ReplanResult], None]


class Replanner:
    """Replanner of one structure; kernels, verdicts and proofs are cached for later requests.

    One object serves one structure and one policy; requests of several threads wait for each other. Pass
    concurrent requests to `replan_many`, which evaluates network and oracle for all of them together.
    """

    def __init__(
        self,
        assembly: AnyStructure,
        policy: Any = None,
        oracle: StabilityOracle | None = None,
        *,
        settings: ReplanSettings = ReplanSettings(),
    ) -> None:
        """Load what the first request would otherwise wait for.

        Args:
            assembly: the structure, or its name or path.
            policy: proposes actions, a `torch.nn.Module` as of `falsework.learn.networks.policy`; None searches alone.
            oracle: decides stability; pass an existing one to reuse its cache.

        Raises:
            DependencyError: a policy without torch.
            InputError: a policy or an oracle of another structure, or a policy and a structure with props.
        """
        assembly = as_assembly(assembly)
        oracle = oracle or StabilityOracle(assembly)
        if policy is not None and assembly.props:
            raise InputError(f"{assembly.name} has props, which policies do not know; leave the policy out")
        if oracle.assembly.identity != assembly.identity:
            raise InputError(f"the oracle is of {oracle.assembly.name}, not of {assembly.name}; make one of the latter")
        guide = None if policy is None else PolicyGuide(policy)
        self.assembly = assembly
        self.policy = policy
        self.oracle = oracle
        self._context = ReplanContext(assembly, Prover(assembly, oracle), guide, settings)
        self._support = SupportGuide(assembly)
        self._lock = threading.Lock()
        self._warm()

    def replan(self, state: StateLike | None = None, **options: Any) -> ReplanResult:
        """Answer one request; the options are the other fields of `Request`, such as plan and step instead of a state.

        Raises:
            InputError: the request makes no sense for this structure; the message says what to do.
        """
        check_options(self.replan, options, Request.__dataclass_fields__)
        return self.replan_many([Request(state, **options)])[0]

    def replan_many(self, requests: Sequence[Request], *, finished: Finished | None = None) -> list[ReplanResult]:
        """Answer several requests together.

        The policy is followed in lock-step for all that have as many robots; those that need a search then take turns.

        Args:
            requests: any mixture; check each with `Request.task` first if a bad one must not fail the rest.
            finished: called with number and answer of each request as soon as it is there.

        Returns:
            An answer for each request.

        Raises:
            InputError: a request that makes no sense for this structure.
        """
        clocks = [Deadline(request.deadline) for request in requests]
        with self._lock:
            sessions = [
                ReplanSession(request, self._context, clock) for request, clock in zip(requests, clocks, strict=True)
            ]
            return _Round(sessions, self._context, self._support, finished).run()

    def _warm(self) -> None:
        """Load and compile everything, and measure how long a proof takes."""
        state = whole_state(self.assembly)[None]
        self.oracle.verdicts(state, near=state)
        self.oracle.verdicts(state, require_certificate=True)
        if self.oracle.replayer is not None:
            self.oracle.replayer.replay(state)
        self._context.prover.warm_up()
        if self._context.guide is not None:
            for _ in range(2):  # the time of the first call includes loading
                self._context.guide.warm_up(state[0], self._context.samples)


class _Round:
    """Requests answered together until all have their results."""

    def __init__(
        self, sessions: Sequence[ReplanSession], context: ReplanContext, support: Guide, finished: Finished | None
    ) -> None:
        self._sessions = sessions
        self._context = context
        self._support = support
        self._finished = finished
        self._answers: dict[int, ReplanResult] = {}
        for session in sessions:
            session.clock.between = self._answer_overdue  # others need not wait beyond their deadlines

    def run(self) -> list[ReplanResult]:
        """Follow the policy for all in lock-step, then let searches take turns."""
        if not self._sessions:
            return []
        self._check_ends()
        if self._context.guide is not None:
            # Sessions whose deadline leaves no time for rollouts are searched at once.
            patient = with_time([(session, 1) for session in self._open()], self._context.guide)
            self._search([number for number, session in enumerate(self._sessions) if session not in patient])
            for follow in (follow_greedily, follow_samples):
                for some in of_one_kind(self._open()):
                    follow(some, self._context)
        self._search(range(len(self._sessions)))
        return [self._answers[number] for number in range(len(self._sessions))]

    def _open(self) -> list[ReplanSession]:
        """Return the sessions in progress; the others get their answers."""
        for number, session in enumerate(self._sessions):
            if session.done:
                self._answer(number)
        return [session for number, session in enumerate(self._sessions) if number not in self._answers]

    def _search(self, numbers: Iterable[int]) -> None:
        """Let the searches of some sessions take turns until all have their answers, the most urgent session first."""
        self._open()
        searches = {number: search_on(self._sessions[number], self._support) for number in numbers}
        while searches := {number: search for number, search in searches.items() if number not in self._answers}:
            for number in sorted(searches, key=lambda number: self._sessions[number].clock.left):
                if number not in self._answers and next(searches[number], _END) is _END:
                    self._answer(number)

    def _answer_overdue(self) -> None:
        """Answer sessions whose clocks ran out while another one was worked on."""
        for number, session in enumerate(self._sessions):
            if session.clock.passed and not session.busy:
                self._answer(number)

    def _answer(self, number: int) -> None:
        if number not in self._answers:
            self._answers[number] = self._sessions[number].answer()
            if self._finished is not None:
                self._finished(number, self._answers[number])

    def _check_ends(self) -> None:
        """Check start and target of all sessions."""
        ends = np.concatenate([[session.task.start, session.task.target] for session in self._sessions])
        verdicts = self._context.prover.oracle.verdicts(ends)
        for number, session in enumerate(self._sessions):
            session.check_ends(verdicts[2 * number : 2 * number + 2])


def replan(
    subject: AnyStructure | Plan,
    state: StateLike | None = None,
    *,
    step: int | None = None,
    since: SiteSteps = SiteSteps(),
    structure: AnyStructure | None = None,
    policy: Any = None,
    oracle: StabilityOracle | None = None,
    stability: StabilitySettings | None = None,
    settings: ReplanSettings = ReplanSettings(),
    **options: Any,
) -> ReplanResult:
    """Plan anew from a state, or from a step of a plan; a `Replanner` answers many requests about one structure.

    Args:
        subject: the structure, or its name or path; or a plan that is being carried out, or its file.
        state: current state of the structure, shape (parts,), or as `named_state` reads it.
        step: last step of the plan that is done, 0 for none. The new plan then begins with the steps that are done, so
            that steps keep their numbers, and its replay with their history.
        since: props placed, parts held and released on site after that step; they are the next steps of the new plan.
        structure: structure of the plan, instead of the one that the plan names.
        policy: proposes actions, a `torch.nn.Module` as of `load_policy`; None searches alone.
        oracle: decides stability; pass an existing one to reuse its cache.
        stability: criterion, reserve and robots, where no oracle is given; by default those of the plan, else `PLANS`.
            Where no plan keeps the reserve, half of the deadline is left to look for one without; `Plan.claim` of the
            answer has its reserve.
        options: the other fields of `Request`, such as target, robots, missing and deadline; robots are those of the
            plan if not given. Loading the structure into the solver comes on top of a deadline; a `Replanner` has done
            that already.

    Returns:
        Proven plans, or the reason for none.

    Raises:
        InputError: the request makes no sense for this structure; the message says what to do.
        DependencyError: a policy without torch.
    """
    check_options(replan, options, Request.__dataclass_fields__)
    plan, assembly = _subject(subject, structure)
    if since:
        if plan is None or step is None:
            raise InputError("steps done since (since) follow a step of a plan; give plan and step")
        plan, assembly = since.after(plan, step, assembly, options.get("robots"))
        step = len(plan)
    if plan is not None:
        options = {"robots": plan.robots, **options, "plan": plan}
    request = Request(state, step=step, **options)
    stability = stability or (PLANS if plan is None else StabilitySettings.from_claim(plan.claim))
    request.task(assembly)  # bad input is refused before anything is loaded

    if oracle is not None:
        return Replanner(assembly, policy, oracle, settings=settings).replan_many([request])[0]

    def replanner(stability: StabilitySettings) -> Replanner:
        return Replanner(assembly, policy, StabilityOracle(assembly, stability), settings=settings)

    return replan_with_reserve([request], stability, replanner)[0]


def replan_with_reserve(
    requests: Sequence[Request],
    stability: StabilitySettings,
    replanner: Callable[[StabilitySettings], Replanner],
    *,
    finished: Finished | None = None,
) -> list[ReplanResult]:
    """Answer requests with the reserve that is asked for, and those for which no plan keeps it once more without.

    Half of each deadline is left for that; loading a replanner does not count.

    Args:
        requests: as for `Replanner.replan_many`.
        replanner: makes a replanner, with the reserve or without, or returns one that was made before.
        finished: as for `Replanner.replan_many`.
    """
    if stability.reserve == 1.0:
        return replanner(stability).replan_many(requests, finished=finished)
    answers: dict[int, ReplanResult] = {}
    again: dict[int, Request] = {}
    keeping = replanner(stability)
    begun = time.perf_counter()

    def first(number: int, answer: ReplanResult) -> None:
        deadline = requests[number].deadline
        stands = answer.found and all(replayed.stands is not False for replayed in answer.replays)
        answers[number] = answer
        if not stands and (deadline is None or answer.seconds < deadline):
            again[number] = requests[number]
        elif finished is not None:
            finished(number, answer)

    hurried = [
        replace(request, deadline=None if request.deadline is None else FIRST_SHARE * request.deadline)
        for request in requests
    ]
    keeping.replan_many(hurried, finished=first)
    if not again:
        return [answers[number] for number in range(len(requests))]
    numbers, passed = list(again), time.perf_counter() - begun

    def second(place: int, answer: ReplanResult) -> None:
        number = numbers[place]
        before = answers[number]
        best = answer if answer.found or not before.found else before
        answers[number] = replace(best, seconds=before.seconds + answer.seconds, unreserved=before.reason)
        if finished is not None:
            finished(number, answers[number])

    rest = [
        replace(request, deadline=None if request.deadline is None else max(request.deadline - passed, 1e-3))
        for request in again.values()
    ]
    replanner(replace(stability, reserve=1.0)).replan_many(rest, finished=second)
    return [answers[number] for number in range(len(requests))]


def _subject(subject: AnyStructure | Plan, structure: AnyStructure | None) -> tuple[Plan | None, Assembly]:
    """Return the plan, if there is one, and the structure."""
    file = subject if isinstance(subject, (str, Path)) and is_plan_file(subject) else None
    if file is not None:
        subject = load_plan(file)
    if isinstance(subject, Plan):
        return subject, structure_of_plan(subject, file, structure)
    if structure is not None:
        raise InputError("structure names that of a plan; give a plan, or the structure alone")
    return None, as_assembly(subject)
