"""Entry point of the search: from an assembly and a task to proven plans."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Unpack, get_args

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_ids
from falsework.assembly.props import without_props
from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.geometry.clearance.protocol import Clearance
from falsework.search.planner import Planner
from falsework.search.planning import Planning
from falsework.search.plans.alternatives import Alternatives, choose_alternatives
from falsework.search.plans.proofs import prove, prove_route
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.guide import Guide, SupportGuide
from falsework.search.problem.hold_bound import HoldBound
from falsework.search.problem.part_sets import InterlockedSets
from falsework.search.problem.result import (
    Outcome,
    Progress,
    Route,
    SearchCounters,
    SearchProgress,
    SearchResult,
    Stop,
)
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings
from falsework.search.task_rules import TaskRules
from falsework.search.together.moves import graph_with_sets
from falsework.search.together.posed_states import PosedStates
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.notebook import or_notebook
from falsework.utils.models import check_options

_SAVE_EVERY = 30.0
"""Seconds between two checkpoints."""
FIRST_SHARE = 0.5
"""Share of a deadline for plans with the reserve; the rest is for plans without, where there are none."""
PLANS = StabilitySettings(reserve=1.1)
"""Stability of plans by default: parts come to rest with friction divided by 1.1, and with the true one."""
RESERVES = {"contact": PLANS.reserve, "equilibrium": 1.0}
"""Reserve of plans by default, by their criterion."""
Backend = Literal["cpu", "cuda"]
"""Device that solves for the verdicts of a search: the processor, or a GPU for those asked for in batches."""
_SHORT = 10_000
"""Poses that a search for a way in several moves tries at first: most without a result go on for long, in vain."""
_CHOICE_SECONDS = 1.0
"""Seconds in which to choose among plans where the deadline leaves less."""


def find_plans(
    assembly: AnyStructure,
    task: Task | None = None,
    *,
    robots: int | None = None,
    oracle: StabilityOracle | None = None,
    stability: StabilitySettings = PLANS,
    settings: PlannerSettings = PlannerSettings(),
    guide: Guide | None = None,
    progress: Progress | None = None,
    stop: Stop | None = None,
    deadline: float | None = None,
    checkpoint: Path | str | None = None,
    forces: bool = True,
    backend: Backend = "cpu",
    **rules: Unpack[TaskRules],
) -> Planning:
    """Find a plan, or several that differ as much as possible, and prove every state of them stable.

    Args:
        assembly: the structure, or its name or path.
        task: rules between start and target, where they are not given by name.
        robots: parts that can be held at a time; 2 where no task says it.
        oracle: decides stability; pass an existing one to reuse its cache.
        stability: criterion, reserve and robots, where no oracle is given. Where no plan keeps the reserve, half of the
            deadline is left to search for a weaker one: first one with the reserve that falls under changed settings,
            if that is what others do (`PlanReplay.varied`), then one that comes to rest under the true friction
            (`Plan.claim` has its reserve). So too where the judge of `settings` accepts none; if no search after it
            finds one that it accepts, the first plan is returned.
        settings: effort of the search, and number of plans.
        guide: scores actions; by default parts with much support are inserted first, and in shells the free edges,
            where `SupportGuide.edges_first` has them of use.
        progress: called after every level of every attempt; notebooks show it if not given.
        stop: called before every level; true ends the search with the plans found so far.
        deadline: seconds after which the search ends with the best that it has; the plans are proved after that.
        checkpoint: file to which the search is saved regularly, and from which it resumes if it exists, with all that
            it has learned; removed at the end. A search without the reserve, which follows, is not saved.
        forces: keep the contact forces that prove each state in the plans.
        backend: `cpu`; or `cuda`: beams are as wide as they may be from the beginning, and a GPU answers verdicts that
            are asked for together. Replays, and few verdicts at a time, stay on the processor.
        rules: see `TaskRules`. Without them the complete structure is disassembled.

    Returns:
        Plans with verdicts and proofs; none if there is none, or none was found.

    Raises:
        InputError: a checkpoint of another task, a task and rules together, rules that the structure cannot keep, a
            deadline of zero or less, no such backend, or no GPU.
        DependencyError: a package that the backend needs is not installed.
    """
    named = [*rules, *(["robots"] if robots is not None else [])]
    if task is not None and named:
        raise InputError(f"a task and {', '.join(named)} were given; put them into the task, or leave the task out")
    check_options(find_plans, rules, TaskRules.__annotations__)
    if backend not in get_args(Backend):
        raise InputError(f"there is no backend {backend!r}; give {' or '.join(get_args(Backend))}")
    assembly, clock = as_assembly(assembly), Deadline(deadline)
    task = task or make_task(assembly, 2 if robots is None else robots, **rules)
    more = settings, guide, or_notebook(progress, "searching"), stop, forces, backend
    if oracle is not None:
        return _find(assembly, task, oracle, clock, checkpoint, *more)
    first = StabilityOracle(assembly, stability)
    if stability.reserve <= 1.0:
        return _find(assembly, task, first, clock, checkpoint, *more)

    def over(found: Planning) -> bool:
        good = found.accepted or (found.found and not settings.judge)
        return good or clock.passed or (found.result.interrupted and not found.deadline_passed)

    def attempt(oracle: StabilityOracle, kept: float, found: Planning | None = None) -> Planning:
        if clock.limited:
            clock.reserve = kept * clock.left
        other = _find(assembly, task, oracle, clock, checkpoint if found is None else None, *more)
        clock.use_reserve()
        return found if found is not None and found.found and not other.accepted else other

    found = attempt(first, FIRST_SHARE)
    if first.replayer is not None and first.replayer.changes and not (found.found or over(found)):
        first.replayer = first.replayer.alone()  # under the settings proper alone
        found = attempt(first, FIRST_SHARE, found)
    if not over(found):
        why = found.reason
        found = attempt(StabilityOracle(assembly, replace(stability, reserve=1.0)), 0.0, found)
        found = replace(found, unreserved=why)
    return found


def _find(
    assembly: Assembly,
    task: Task,
    oracle: StabilityOracle,
    clock: Deadline,
    checkpoint: Path | str | None,
    settings: PlannerSettings,
    guide: Guide | None,
    progress: Progress | None,
    stop: Stop | None,
    forces: bool,
    backend: Backend,
) -> Planning:
    """Find plans with one oracle, see `find_plans`; they may take the reserve of the clock once one stands."""
    if backend == "cuda":
        oracle.use_gpu()
    if task.moves_out > 1 and task.clearance is not None and np.isinf(task.clearance.most) and checkpoint is None:
        quick = replace(task, clearance=task.clearance.within(_SHORT))
        found = _find(assembly, quick, oracle, clock, None, settings, guide, progress, stop, forces, backend)
        if found.found or found.result.interrupted or not (quick.clearance and quick.clearance.were_cut):
            return found
    guide = guide or SupportGuide(assembly)
    how: dict[str, Any] = {"guide": guide, "wide": backend == "cuda"}
    planner = Planner(task, oracle, settings, **how)
    if checkpoint is not None:
        planner.check_saved()
        if Path(checkpoint).exists():
            planner = Planner.load(checkpoint, task, oracle, settings, **how)
    if not settings.judge:
        planner.tests.when_one_stands = clock.use_reserve
        if planner.tests.doubted is not None:  # of a search that is resumed
            clock.use_reserve()
    with clock.interrupts():
        result = _run(planner, assembly, oracle, clock, _saving(planner, checkpoint, progress), stop)
    if checkpoint is not None:
        if result.interrupted:
            planner.save(checkpoint)
        else:
            Path(checkpoint).unlink(missing_ok=True)
    if not result.found:
        fallen = None
        if planner.tests.fallen is not None and not result.interrupted:
            fallen = prove_route(planner.tests.fallen[0], assembly, task, oracle, forces=forces)
        return Planning(result, (), Alternatives.from_routes([]), fallen, result.interrupted and clock.passed)
    late = result.interrupted and clock.passed
    choice = Deadline(max(clock.left, _CHOICE_SECONDS))
    chosen = _choose(planner, result, assembly, oracle, lambda: choice.passed)
    plans = tuple(
        prove_route(
            route, assembly, task, oracle, forces=forces, replay=planner.tests.replays.get(route.states.tobytes())
        )
        for route in chosen.routes
    )
    passed = [k for k, plan in enumerate(plans) if plan.replay is None or plan.replay.stands]
    if len(passed) < len(plans):
        plans, chosen = tuple(plans[k] for k in passed), chosen.keep(passed)
    return Planning(result, plans, chosen, deadline_passed=late)


def make_task(
    assembly: AnyStructure,
    robots: int = 2,
    *,
    start: ArrayLike | None = None,
    target: ArrayLike | None = None,
    fixed: Sequence[int | str] = (),
    missing: Sequence[int | str] = (),
    removable_only_if_clear: bool = False,
    allow_regrasp: bool = False,
    props: int = 0,
    parts_at_once: int = 1,
    moves: int = 1,
    turns: bool = False,
    waiting: bool = False,
) -> Task:
    """Return the task of disassembling a structure; see `TaskRules` for the rules.

    States of a structure with places for props may be given without them.

    Raises:
        InputError: parts, states or places of props that the structure does not have, or numbers that cannot be.
    """
    assembly = as_assembly(assembly)
    if props < 0 or (props and not (allow_regrasp and assembly.props)):
        raise InputError(
            f"props is {props}, which cannot be placed; give a number from 0 on, with allow_regrasp and a structure "
            "with places for props, as with_props(assembly, prop_places(assembly)) makes it"
        )
    start, target = (without_props(state, assembly) for state in (start, target))
    together = None if parts_at_once == 1 else InterlockedSets(assembly, parts_at_once)
    clear = removable_only_if_clear or together is not None or moves != 1 or turns or waiting
    untouched = part_ids(fixed, assembly.names, "fixed")
    return Task.from_rules(
        assembly.boundary,
        robots,
        start=start,
        target=target,
        fixed=untouched,
        missing=part_ids(missing, assembly.names, "missing"),
        clearance=_clearance(assembly, moves, untouched, turns=turns, waiting=waiting) if clear else None,
        contacts=assembly.contacts.parts,
        identity=assembly.identity,
        allow_regrasp=allow_regrasp,
        props=[prop.part for prop in assembly.props],
        prop_limit=props,
        together=together,
    )


def _clearance(assembly: Assembly, moves: int, fixed: Sequence[int], *, turns: bool, waiting: bool) -> Clearance:
    """Return the clearance of parts that leave in up to some number of moves."""
    if waiting and moves == 1:
        raise InputError("a part waits half way out only on a way of several moves; give moves (--moves) above 1")
    if moves == 1 and not turns:
        return assembly.straight_ways
    from falsework.geometry.paths.exit_paths import ExitPaths  # few tasks need it

    still = assembly.immovable.copy()
    still[list(fixed)] = True
    meshes, contacts = assembly.meshes, assembly.contacts
    posed = PosedStates(assembly) if waiting else None
    return ExitPaths(meshes, contacts, assembly.straight_ways, assembly.part_motions, still, moves, turns, posed)


def _choose(
    planner: Planner,
    result: SearchResult,
    assembly: Assembly,
    oracle: StabilityOracle,
    stop: Stop,
) -> Alternatives:
    """Choose the requested number of plans, as different as possible, from all that a planner has found.

    Other plans than those of the planner are tested first, and replaced where one of their states fails.
    """
    settings = planner.settings
    if settings.alternatives == 1:
        return Alternatives.from_routes(list(result.routes))
    task = planner.task.postpone(planner.postponed)
    states = np.concatenate([planner.states, *(route.states for route in planner.routes)])
    known = {route.states.tobytes() for route in planner.routes}
    while True:
        graph = graph_with_sets(task, oracle, states, name=assembly.name)
        found = choose_alternatives(graph, settings.alternatives, given=planner.routes, seed=settings.seed, stop=stop)
        tests = [
            states[:0] if route.states.tobytes() in known else _weak_states(route.states, planner, oracle, stop)
            for route in found.routes
        ]
        weak = {state.tobytes() for failed in tests if failed is not None for state in failed}
        if not weak and all(failed is not None for failed in tests):
            return found
        if stop() or not weak:
            return found.keep([k for k, failed in enumerate(tests) if failed is not None and not len(failed)])
        states = states[[state.tobytes() not in weak for state in states]]


def _weak_states(route: States, planner: Planner, oracle: StabilityOracle, stop: Stop) -> States | None:
    """Return the states of a route, shape (steps + 1, parts), that fail or have no proof; None if time is up before."""
    if oracle.replayer is None:
        return route[~prove(route, oracle, forces=False)[0].stable]
    before = len(planner.tests.forbidden)
    try:
        planner.tests.passes(Route.from_states(route), stop=stop)
    except DeadlineExceeded:
        return None
    except KeyboardInterrupt:
        if not stop():
            raise
        return None
    return planner.tests.forbidden[before:]


def _run(
    planner: Planner,
    assembly: Assembly,
    oracle: StabilityOracle,
    clock: Deadline,
    progress: Progress | None,
    stop: Stop | None,
) -> SearchResult:
    """Run a planner; where it finds nothing for some seconds, first try to refute its number of robots."""
    task, patience, begun, paused = planner.task, planner.settings.bound_after, time.process_time(), False

    def over() -> bool:
        return clock.passed or (stop is not None and stop())

    def halt() -> bool:
        nonlocal paused
        if over():
            return True
        # The bound does not cover props, nor steps of several parts.
        beyond = planner.routes or task.prop_limit or task.together is not None
        paused = not beyond and time.process_time() - begun > patience
        return paused

    result = planner.run(progress=progress, stop=halt)
    if not (paused and result.interrupted):
        return result
    limit = Deadline(max(min(patience / 2, clock.left), 1e-3))
    test, begun = HoldBound(assembly, task, oracle.settings, limit), time.perf_counter()
    try:
        barrier = test.barrier(task.robots)
    except DeadlineExceeded:
        barrier = None
    except KeyboardInterrupt:
        return result
    seconds = time.perf_counter() - begun
    if barrier is None:
        result = planner.run(progress=progress, stop=over)
    else:
        refuted = Outcome.PROVED_IMPOSSIBLE
        result = replace(result, outcome=refuted, interrupted=False, limit="", notes=(barrier.text,))
    counters = result.counters + SearchCounters(asked=test.asked)
    return replace(result, counters=counters, seconds=result.seconds + seconds)


def _saving(planner: Planner, checkpoint: Path | str | None, progress: Progress | None) -> Progress | None:
    if checkpoint is None:
        return progress
    saved = time.perf_counter()

    def report(event: SearchProgress) -> None:
        nonlocal saved
        if time.perf_counter() - saved > _SAVE_EVERY:
            planner.save(checkpoint)
            saved = time.perf_counter()
        if progress is not None:
            progress(event)

    return report
