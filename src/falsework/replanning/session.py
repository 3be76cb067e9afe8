"""Session of one replanning request: its task, its deadline, and the candidates found so far."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States
from falsework.errors import InputError, PlanError
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.proving import Prover
from falsework.replanning.request import Request
from falsework.replanning.request_replayer import RequestReplayer
from falsework.replanning.result import ReplanResult, Stage
from falsework.replanning.session_oracle import SessionOracle
from falsework.search.plans.alternatives import Alternatives, choose_alternatives
from falsework.search.plans.plan import Plan
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.result import Outcome, Route, SearchResult
from falsework.search.problem.task import Direction, Task
from falsework.search.together.moves import graph_with_sets
from falsework.stability.verdict import Verdict, Verdicts

_SAMPLES_GPU, _SAMPLES_CPU = 16, 4
"""Sampled rollouts where the settings give no number, see `ReplanSettings.samples`."""
_SAFETY = 1.3
"""Safety factor on the expected time of a proof."""
_PROVING = 0.25
"""Share of a deadline that is kept for it at most."""
_LOOKED_AT = 16
"""Largest number of states where a search stopped whose motions are examined."""


@dataclass(frozen=True)
class ReplanSettings:
    """Effort of a replanner in each stage."""

    samples: int | None = None
    """Rollouts drawn from the probabilities of the policy, 0 for none. If not given, 16 on a GPU, which takes as long
    for one, and 4 on the processor, where more would take longer than the search that they are to save."""
    widths: tuple[int, ...] = (4, 16, 64)
    """Of the beams that the policy guides, in turn."""
    width: int = 256
    """Of the widest beam of the search without a policy."""
    state_limit: int = 20_000
    """States after which the search through all of them gives up."""
    forces: bool = False
    """Keep the contact forces that prove each state in the plans."""

    def __post_init__(self) -> None:
        if self.samples is not None and self.samples < 0:
            raise InputError("a replanner draws 0 or more samples")
        if self.width < 1 or self.state_limit < 1 or any(width < 1 for width in self.widths):
            raise InputError("beams and searches of a replanner keep at least 1 state")


@dataclass(frozen=True, eq=False)
class ReplanContext:
    """Context shared by all requests for one structure."""

    assembly: Assembly
    prover: Prover
    guide: PolicyGuide | None
    settings: ReplanSettings

    @property
    def samples(self) -> int:
        """Rollouts that are drawn for each request."""
        if self.guide is None:
            return 0
        if self.settings.samples is not None:
            return self.settings.samples
        return _SAMPLES_GPU if self.guide.device.type == "cuda" else _SAMPLES_CPU


class ReplanSession:
    """Session of one request."""

    def __init__(self, request: Request, context: ReplanContext, clock: Deadline) -> None:
        """Check the request; its deadline runs already."""
        self.clock = clock
        self.request = request
        self.context = context
        self.task = request.task(context.assembly).judged_by(context.prover.oracle)
        self.direction = request.resolved_direction(context.assembly)
        done = request.done(context.assembly)
        self.built = done if self.direction is Direction.ASSEMBLY else None
        """Steps that are done, with which the plans begin; plans that take the structure apart begin anew."""
        replayer, history = context.prover.oracle.replayer, None if self.built is None else self.built.history
        self.replayer = None  # under the settings alone: changed ones would take as long again
        if replayer is not None:
            own = replayer.alone() if replayer.varies else replayer
            self.replayer = RequestReplayer(own, self.clock, history)
        self.oracle = SessionOracle(context.prover.oracle, self.clock, self.replayer)
        needed = _SAFETY * context.prover.seconds_for(self.task.steps + 1)
        self.clock.reserve = min(needed, _PROVING * request.deadline) if request.deadline is not None else 0.0
        self.routes: list[Route] = []
        """The best one first."""
        self.busy = False
        """Whether a search, a replay or the answer is under way, which ends by itself when the clock has run out."""
        self.decided_by = Stage.NONE
        self.outcome = Outcome.NOT_FOUND
        self.result: SearchResult | None = None
        self.prefix = self.task.start[None]
        """States from the start on that are known to be stable, along the policy's most probable actions."""
        self.infeasible = False
        """Whether start or target is not stable, so that no plan exists."""
        self._chosen = False
        self._fell_by: dict[bytes, Stage] = {}
        """Stages that proposed the routes whose replays failed."""
        self._unstable: States | None = None
        self._why = ""

    @property
    def done(self) -> bool:
        """Whether the work is complete, or no time is left."""
        enough = bool(self.routes) and self.request.alternatives == 1 and not self.task.missing
        return enough or self.infeasible or self.outcome is Outcome.PROVED_IMPOSSIBLE or self.clock.passed

    @property
    def decided(self) -> bool:
        """Whether there is a plan or a proof that there is none."""
        return self.outcome is not Outcome.NOT_FOUND

    def found(self, routes: list[Route], by: Stage) -> None:
        """Add plans whose replays succeed; the first are those that need missing parts latest."""
        routes = [route for route in routes if self.stands(route, by)]
        if not routes:
            return
        if not self.routes:
            self.decided_by = by
        known = {route.states.tobytes() for route in self.routes}
        routes = [*self.routes, *(route for route in routes if route.states.tobytes() not in known)]
        self.routes = sorted(routes, key=lambda route: route.insertion_steps(self.task), reverse=True)
        self.outcome = Outcome.FOUND

    def stands(self, route: Route, by: Stage = Stage.SEARCH) -> bool:
        """Return whether a replay of a route succeeds, as far as there is time for it.

        The state in which it fails is excluded: the oracle of this session counts it as sliding from then on.
        """
        if self.replayer is None:
            return True
        before, self.busy = self.busy, True  # no answer while the route is not among those that are known
        try:
            stands = self.replayer.replay_in_time(route.states[::-1]).stands is not False
            if not stands:
                self._fell_by[route.states[::-1].tobytes()] = by
            return stands
        finally:
            self.busy = before

    def choose(self, task: Task, states: States, given: Sequence[Route]) -> list[Route]:
        """Choose the requested number of diverse routes through some states whose replays succeed.

        Args:
            states: stable, shape (count, parts).
        """
        count = len(states) + 1
        while True:
            given = [route for route in given if self.stands(route)]
            states = states[~self.oracle.rules_out(states)]
            every = np.concatenate([states, *(route.states for route in given)])
            graph = graph_with_sets(task, self.context.prover.oracle, every)
            chosen = choose_alternatives(
                graph,
                self.request.alternatives,
                given=given,
                seed=self.request.seed,
                stop=lambda: self.clock.passed,
            ).routes
            standing = [route for route in chosen if self.stands(route)]
            # A state on a route that succeeds stays in the graph, even if another route fails there.
            if len(standing) == len(chosen) or len(states) == count or self.clock.passed:
                return standing
            count = len(states)

    def take(self, chosen: list[Route]) -> None:
        """Put the plans that were chosen among many before all others that are known."""
        known = {route.states.tobytes() for route in chosen}
        self.routes = [*chosen, *(route for route in self.routes if route.states.tobytes() not in known)]
        self._chosen = True

    def ended(self, result: SearchResult, by: Stage) -> None:
        """Take the end of a search."""
        self.result = result
        cut = None if self.replayer is None else self.replayer.falls.unfinished
        if result.found:
            self.found(list(result.routes), by)
        elif cut is not None and by is Stage.SEARCH and not self.routes:
            self.found([self._route(cut)], by)
        elif result.outcome is Outcome.PROVED_IMPOSSIBLE and not self.routes:
            # A search that omitted nothing was exhaustive, whatever its settings.
            self.outcome, self.decided_by = result.outcome, Stage.EXHAUSTIVE

    def check_ends(self, verdicts: Verdicts) -> None:
        """Take the verdicts on start and target from rest."""
        ends = np.stack([self.task.start, self.task.target])
        verdicts = replace(verdicts, verdict=self.oracle.as_replayed(ends, verdicts))
        builds = self.replayer is not None and self.direction is Direction.ASSEMBLY
        if builds and (verdicts.depends_on_path & ~self.oracle.rules_out(ends))[0]:
            verdicts.verdict[0] = Verdict.STABLE  # the target, which may stand as it is built
        if not verdicts.stable.all():
            row = int(np.argmin(verdicts.stable))
            proved = bool(verdicts.unstable[row])
            name = "state" if (row == 0) == (self.direction is Direction.DISASSEMBLY) else "target"
            self._unstable = ends[row][None]
            words = "is not stable" if proved else verdicts.kinds[row].words
            self._why = f"the {name} {words}{self.context.prover.oracle.settings.under}"
            if proved:
                self.outcome, self.decided_by = Outcome.PROVED_IMPOSSIBLE, Stage.RULES
            self.infeasible = True
            return
        falls_at = None if self.replayer is None else self.replayer.executed_fails_at()
        if falls_at is not None:
            self._why = f"the steps that are done do not come to rest in a replay, after step {falls_at}"
            self.infeasible = True
        elif self.task.is_done:
            self.found([Route(self.task.start[None].copy(), np.zeros(0, dtype=np.int64))], Stage.RULES)
        elif self.built is not None and (rest := self.built.rest(self.task)) is not None:
            self._go_on_with(rest)

    def _go_on_with(self, rest: Route) -> None:
        """Take the rest of the plan that is carried out, if it still stands and there is time to see that."""
        with suppress(DeadlineExceeded):
            stable = self.replayer is not None or self.oracle.verdicts(rest.states).stable.all()
            if stable and self.oracle.keeps(rest.states).all():
                self.found([rest], Stage.PLAN)

    def answer(self) -> ReplanResult:
        """Prove the plans found and return the result."""
        plans: tuple[Plan, ...]
        self.busy = True
        fallen = None if self.replayer is None else self.replayer.falls.fallen
        if not self.routes and fallen is not None and self.clock.passed:
            # Every state of it is stable, and there was no time for another one; the answer says that its replay fails.
            self.routes = [self._route(fallen)]
            self.outcome, self.decided_by = Outcome.FOUND, self._fell_by.get(fallen.tobytes(), Stage.SEARCH)
        plans, chosen = (), self._choose()
        late = self.clock.passed
        if self.routes:
            with self.clock.timed("proofs"):
                try:
                    prover, forces = self.context.prover, self.context.settings.forces
                    for route in chosen.routes:
                        whole, task = route, self.task
                        if self.built is not None:
                            whole, task = self.built.extended(route), self.built.whole_task(self.task)
                        left = self.clock.left
                        plan = prover.plan(whole, task, self.replayer, built=self._done, forces=forces, seconds=left)
                        plans = (*plans, plan if self.built is None else self.built.with_ways(plan))
                except PlanError as error:
                    self._why = str(error) if fallen is None and not late else ""
                    self.outcome, self.decided_by = Outcome.NOT_FOUND, Stage.NONE
        moving = () if plans else self._moving()
        replayer = self.replayer
        replays = [] if replayer is None else [replayer.replay_in_time(plan.states[self._done :]) for plan in plans]
        return ReplanResult(
            plans=plans,
            outcome=self.outcome,
            decided_by=self.decided_by,
            direction=self.direction,
            built=self._done,
            steps=self.task.steps,
            reached=self.task.steps if plans else self._reached(),
            seconds=self.clock.seconds,
            spent=dict(self.clock.spent),
            verdicts=self.oracle.asked,
            deadline_passed=late,
            reason="" if plans else self._reason(),
            moving=moving,
            distance=chosen.distance,
            confidences=tuple(self._confidence(plan.states[self._done :]) for plan in plans)
            if self.request.confidences
            else (),
            criterion=self.context.prover.oracle.settings.criterion,
            replays=tuple(replays),
            search=self.result,
        )

    @property
    def _done(self) -> int:
        return 0 if self.built is None else self.built.steps

    def _route(self, states: States) -> Route:
        """Return the route through states in the order of assembly."""
        return Route.from_states(states[::-1].copy())

    def _choose(self) -> Alternatives:
        """Choose the requested number of the plans found."""
        wanted, routes = self.request.alternatives, self.routes
        if wanted == 1 or len(routes) <= wanted or self._chosen or self.task.missing:
            return Alternatives.from_routes(routes[:wanted])
        states = np.concatenate([route.states for route in routes])
        return Alternatives.from_routes(self.choose(self.task, states, routes[:1]))

    def _reached(self) -> int:
        result = self.result
        greedy = len(self.prefix) - 1 if self.direction is Direction.DISASSEMBLY else 0
        return max(greedy, result.reached if result is not None and result.direction is self.direction else 0)

    def _reason(self) -> str:
        if self._why:
            return self._why
        if self.outcome is Outcome.PROVED_IMPOSSIBLE:
            return "every reachable state was examined"
        if self.replayer is not None and self.replayer.falls.fallen is not None:
            return (
                "no plan was found whose replay in the order of assembly succeeds: in the best of "
                f"{self._done + self.task.steps} steps the structure collapses after step "
                f"{self._done + self.replayer.falls.failed_after}"
            )
        if self.clock.passed:
            return "the deadline passed; more time may find a plan"
        return self.result.limit if self.result is not None and self.result.limit else "the search was limited"

    def _moving(self) -> tuple[int, ...]:
        """Return parts that move where the search stopped; not computed after the deadline."""
        rejected = self._unstable
        if rejected is None and self.result is not None:
            rejected = self.result.rejected[:_LOOKED_AT]
        if rejected is None or len(rejected) == 0 or self.clock.passed:
            return ()
        verdicts = self.context.prover.oracle.verdicts(rejected, require_certificate=True)
        count: Counter[int] = Counter()
        for row in np.flatnonzero(verdicts.unstable):
            if verdicts.velocity is not None:
                speed = np.abs(verdicts.velocity[row]).max(axis=1)
                count.update(np.flatnonzero(speed > 0.05 * speed.max()).tolist())
        return tuple(part for part, _ in count.most_common())

    def _confidence(self, states: States) -> np.ndarray:
        guide = self.context.guide
        if guide is None:
            return np.zeros((0, 2 * self.task.part_count), dtype=np.float32)
        legal: Mask = self.task.moves(states, Direction.DISASSEMBLY)
        targets = np.broadcast_to(self.task.target, states.shape)
        with self.clock.timed("policy"):
            return np.exp(guide.for_task(self.task).log_probabilities(states, legal, targets)).astype(np.float32)
