"""From an assembly and a task to plans: what the command line and the README call."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from falsework.assembly.model import Assembly
from falsework.search.planner import Planner
from falsework.search.plans.alternatives import Alternatives, choose_alternatives
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.problem.guide import Guide, SupportGuide
from falsework.search.problem.result import Outcome, Progress, Route, SearchProgress, SearchResult, Stop
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings
from falsework.stability.oracle import Stability
from falsework.stability.verdict import Verdicts

_PROVED_AT_ONCE = 64
"""States whose contact forces are in memory together, unless they are kept."""
_SAVE_EVERY = 30.0
"""Seconds between two checkpoints."""


@dataclass(frozen=True, eq=False)
class Planning:
    """What came out of `find_plans`."""

    result: SearchResult
    """How the search ended, and if it found nothing, how far it came."""
    plans: tuple[Plan, ...]
    """Plans for disassembly, the first one first; `Plan.reverse` gives those for assembly."""
    alternatives: Alternatives
    """How much the plans differ; its routes are those of `plans`."""
    fallen: Plan | None = None
    """Where no plan was found whose replay stands: the one that comes farthest, with where it falls."""

    @property
    def found(self) -> bool:
        """Whether there is at least one plan."""
        return self.result.outcome is Outcome.FOUND


def find_plans(
    assembly: Assembly,
    task: Task | None = None,
    *,
    oracle: Stability | None = None,
    settings: PlannerSettings = PlannerSettings(),
    guide: Guide | None = None,
    progress: Progress | None = None,
    stop: Stop | None = None,
    checkpoint: Path | str | None = None,
    forces: bool = True,
) -> Planning:
    """Find a plan, or several that differ as much as possible, and prove every state of them stable.

    Args:
        assembly: the structure.
        task: rules between start and target; by default two robots take the complete structure apart.
        oracle: decides stability; hand in the one you have, for it remembers what it was asked.
        settings: how hard to look, and how many plans.
        guide: scores actions; by default parts with much support go in first.
        progress: called after every level of every attempt.
        stop: asked before every level; true ends the search with what was found so far.
        checkpoint: file that the search is saved to now and then and resumed from if it is there; removed at the end.
        forces: keep the contact forces that prove each state in the plans; for a thousand parts half a gigabyte a plan.

    Returns:
        Plans with verdicts and proofs; none if there is none, or none was found.

    Raises:
        InputError: a checkpoint of another task.
    """
    oracle = oracle or Stability(assembly)
    task = task or task_of(assembly)
    guide = guide or SupportGuide(assembly)
    planner = _resume(checkpoint, task, oracle, settings, guide)
    result = planner.run(progress=_saving(planner, checkpoint, progress), stop=stop)
    if checkpoint is not None:
        if result.interrupted:
            planner.save(checkpoint)
        else:
            Path(checkpoint).unlink(missing_ok=True)
    if not result.found:
        fallen = None
        if planner.fallen is not None and not result.interrupted:
            fallen = plan_of(planner.fallen[0], assembly, task, oracle, forces=forces)
        return Planning(result, (), Alternatives.of([]), fallen)
    chosen = choose_plans(planner, settings, assembly.name)
    plans = tuple(plan_of(route, assembly, task, oracle, forces=forces) for route in chosen.routes)
    standing = [k for k, plan in enumerate(plans) if plan.replay is None or plan.replay.stands]
    if len(standing) < len(plans):
        plans, chosen = tuple(plans[k] for k in standing), chosen.keep(standing)
    return Planning(result, plans, chosen)


def task_of(assembly: Assembly, robots: int = 2) -> Task:
    """Task of taking the complete structure apart."""
    return Task.create(assembly.boundary, robots, identity=assembly.identity)


def plan_of(route: Route, assembly: Assembly, task: Task, oracle: Stability, *, forces: bool = True) -> Plan:
    """Plan along a route, each state proved stable anew with a proof that the certificate checker accepts.

    Under the criterion `contact` the plan is replayed as well; what came of it is in `Plan.replay`.

    Args:
        route: states and actions.
        assembly: the structure.
        task: what the route was found for.
        oracle: proves the states.
        forces: keep the forces in the plan, under `contact` the displacements too.

    Raises:
        PlanError: a state that cannot be proved stable.
    """
    points, contact = len(assembly.contacts.points), oracle.settings.criterion == "contact"
    verdicts = Verdicts.blank(
        len(route.states),
        points=points if forces else None,
        parts=assembly.part_count if forces and contact else None,
        displaced=contact,
    )
    for begin in range(0, len(route.states), _PROVED_AT_ONCE):
        rows = np.arange(begin, min(begin + _PROVED_AT_ONCE, len(route.states)))
        verdicts.put(rows, oracle.check(route.states[rows]))
    plan = Plan.of(route, assembly, task, verdicts, oracle.settings.claim)
    if oracle.replayer is None:
        return plan
    return replace(plan, replay=PlanReplay.of(oracle.replayer.replay(plan.assembly_states)))


def choose_plans(
    planner: Planner, settings: PlannerSettings, name: str = "", *, stop: Stop | None = None
) -> Alternatives:
    """Of all that a planner has found, as many plans as the settings ask for, as different as possible.

    Args:
        planner: with at least one route.
        settings: how many, and the seed.
        name: of the structure, for the state graph.
        stop: asked before every choice; true ends the work with what was chosen so far.
    """
    if settings.alternatives == 1:
        return Alternatives.of(planner.routes)
    task = planner.task.postpone(planner.postponed)
    graph = StateGraph.build(
        task, np.concatenate([planner.states, *(route.states for route in planner.routes)]), name=name
    )
    return choose_alternatives(graph, settings.alternatives, given=planner.routes, seed=settings.seed, stop=stop)


def _resume(
    checkpoint: Path | str | None, task: Task, oracle: Stability, settings: PlannerSettings, guide: Guide
) -> Planner:
    if checkpoint is not None and Path(checkpoint).exists():
        return Planner.load(checkpoint, task, oracle, settings, guide=guide)
    return Planner(task, oracle, settings, guide=guide)


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
