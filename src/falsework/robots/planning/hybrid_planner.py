"""Hybrid planner: abstract actions and motions together (paper, section 6, algorithm 1).

For robots that move at the same time, a plan for one robot at a time is found first, with straight lines as short as
possible. Order and robots of its steps are then changed so that robots wait less, and its motions overlap as far as
that is proven safe.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.groups import groups_of, join_parts
from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED
from falsework.errors import StateError
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.keyframes.failure_report import Explanation
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import CellScale, stability_in
from falsework.robots.planning.boundary_motions import BoundaryMotions, leading_insertions
from falsework.robots.planning.hybrid_result import HybridResult, HybridSettings, Progress
from falsework.robots.planning.hybrid_search import HybridSearch
from falsework.robots.planning.initial_keyframe import given_keyframe, task_in_cell
from falsework.robots.plans.loose_plan import loose_plan
from falsework.robots.schedule.solver import import_ortools
from falsework.search.find import PLANS, find_plans, make_task
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.guide import Guide
from falsework.search.problem.part_sets import InterlockedSets
from falsework.search.problem.result import Outcome
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.notebook import or_notebook
from falsework.utils.quantity import counted

_SHARE = 0.7
"""Share of the deadline after which the search with short lines is given up."""


def plan_robots(
    assembly: AnyStructure,
    cell: AnyCell,
    *,
    task: Task | None = None,
    concurrent: bool = False,
    configurations: Sequence[ArrayLike] | None = None,
    held: Sequence[int | None] | None = None,
    gripped: Sequence[ArrayLike | None] | None = None,
    oracle: StabilityOracle | None = None,
    stability: StabilitySettings = PLANS,
    guide: Guide | None = None,
    settings: HybridSettings = HybridSettings(),
    progress: Progress | None = None,
    deadline: float | None = None,
    graph: KeyframeGraph | None = None,
    forces: bool = False,
) -> HybridResult:
    """Find a plan with motions for the robots of a cell.

    Where there is one for robots that move in turn, there is one for robots that move at the same time too, unless the
    deadline passes first. The statistics of the latter have `search`: `together`, or `sequential` where only the
    lines of the former led to a plan.

    Args:
        assembly: the structure, or its name or path.
        cell: the robots and their surroundings, or the name or file of the cell.
        task: states and rules; by default the whole structure is assembled. As in all tasks the start state is the one
            with more parts: an assembly begins in the target state. The number of robots is that of the cell, and
            every part needs a free way out, not downwards. Of a task with several parts in one step, one robot carries
            a set, or each part has a robot of its own, at the same instant. The plan is for the structure in which each
            set that one robot carries is one part (`Assembly.groups`), and is checked with loose parts. With an oracle,
            a guide, a graph or a beginning each part has a robot of its own.
        concurrent: robots move at the same time: motions are shortened, steps reordered, and the plan has a schedule.
        configurations: joint values of the robots before the first step that is executed, shape (joints,) each. By
            default they are at home in disassembly, and in assembly where the first motion begins.
        held: the part that each robot holds in place then, or carries; needed in disassembly if the start state has
            held parts.
        gripped: for each robot that carries a part then, which is delivered first, the joint values with which it would
            hold it at its place.
        oracle: decides stability; pass an existing one to reuse its cache.
        stability: criterion, reserve and robots, where no oracle is given. Limits of the cell's grippers hold as well.
            Where no order of the parts keeps the reserve, one is searched for that comes to rest under the true
            friction; `plan.claim` of the result has its reserve.
        guide: action heuristic, such as a trained policy, added to the ease of execution by the arms.
        settings: order of execution, and limits of the search.
        progress: callback, called at intervals; notebooks show it if not given.
        deadline: seconds after which the search ends with what it has.
        graph: keyframe graph of the same structure and cell, whose motions are used again.
        forces: keep the contact forces that prove each state in the plan.

    Raises:
        CellError: a gripper bears less than the weight of a part, no gripper can carry a part that moves, or the cell
            scales the structure, or changes its density, so that other states are stable.
        InputError: configurations that do not fit the robots, or in which something collides.
        StateError: held parts that do not go with the state that is begun with.
        DependencyError: robots are to move at the same time, and OR-Tools is missing.
    """
    if concurrent:
        import_ortools()
    assembly, cell = as_assembly(assembly), as_cell(cell)
    CellScale.from_cell(assembly, cell)  # which refuses a cell in which other states are stable
    begun = any(given is not None for given in (configurations, held, gripped, oracle, guide, graph))
    if task is not None and task.together is not None and begun:  # of which parts are joined is not known
        task = replace(task, together=task.together.held)
    elif task is not None and task.together is not None and task.together.by_one:
        options: dict[str, Any] = {"concurrent": concurrent, "settings": settings, "progress": progress}
        options |= {"stability": stability, "forces": forces}

        def plan(structure: Assembly, task: Task, left: float | None) -> HybridResult:
            return plan_robots(structure, cell, task=task, deadline=left, **options)

        return _plan_sets(plan, assembly, cell, task, stability, Deadline(deadline))
    progress = or_notebook(progress, "planning motions")
    if oracle is None:
        clock = Deadline(deadline)
        given: dict[str, Any] = {"task": task, "configurations": configurations, "held": held, "gripped": gripped}
        given |= {"concurrent": concurrent, "guide": guide, "settings": settings, "progress": progress, "graph": graph}

        def under(reserve: float) -> HybridResult:
            kept = stability_in(cell, assembly, replace(stability, reserve=reserve))
            oracle = StabilityOracle(assembly, kept)
            return plan_robots(assembly, cell, oracle=oracle, deadline=clock.rest, forces=forces, **given)

        result = under(stability.reserve)
        # Where no order of the parts is found with the reserve, there may be one without.
        again = result.no_order and stability.reserve > 1.0 and not clock.passed
        return replace(under(1.0), unreserved=result.reason) if again else result
    now = configurations, held, gripped
    continues = settings.direction is Direction.ASSEMBLY and any(given is not None for given in now)
    clock, needed = Deadline(deadline), dict[str, Any]()
    if task is not None:  # the parts that are ever in place, and those that ever leave
        needed = {"present": task.start != REMOVED, "leaving": task.target == REMOVED if continues else None}

    def search(limits: HybridSettings, graph: KeyframeGraph | None, clock: Deadline) -> HybridResult:
        graph = graph or KeyframeGraph(assembly, cell, settings=limits.keyframes, seed=limits.seed, **needed)
        within = task_in_cell(assembly, cell, task, graph.exits, oracle)
        held_last = np.flatnonzero((within.start == HELD) & ~assembly.immovable)
        if settings.direction is Direction.ASSEMBLY and len(held_last):
            raise StateError(
                f"part {assembly.names[int(held_last[0])]} is held in the state in which the assembly ends, and robots "
                "let go of all parts there; let it be installed"
            )
        if groups_of(assembly) is None:  # parts that are joined may also be carried one by one
            leaving = np.flatnonzero((within.target == REMOVED) & (within.start != REMOVED)).tolist()
            graph.grasp_configurations.check(part for part in leaving if part not in (held or ()))
        # Searches begin at the complete structure, where a continued assembly ends.
        first = given_keyframe(graph, within.start, *((None,) * 3 if continues else now))
        last = given_keyframe(graph, within.target, *now) if continues else None
        result: HybridResult | None = None
        for insert in leading_insertions(last):
            ends = BoundaryMotions(graph)
            root = first if continues or configurations is None else ends.begin(first)
            ends.end_at(last, insert)
            within_ends = (graph, ends.reached(within), oracle, guide, limits, progress, ends, clock)
            result = HybridSearch(*within_ends, concurrent=concurrent, forces=forces).run(root)
            # That a carried part cannot be next is no proof for plans that bring it back.
            if result.explanation is None or (clock.passed and _may_exist(result)):
                break
        assert result is not None
        return result

    return _concurrent(search, settings, graph, clock) if concurrent else search(settings, graph, clock)


def _concurrent(
    search: Callable[[HybridSettings, KeyframeGraph | None, Deadline], HybridResult],
    settings: HybridSettings,
    graph: KeyframeGraph | None,
    clock: Deadline,
) -> HybridResult:
    """Return the result of a search with short lines, or where it finds no plan, of one with those of the settings."""
    lines, kind = settings.keyframes, "together"
    shortest = min(lines.approaches)
    short = replace(
        lines, approaches=tuple(sorted(lines.approaches)), withdrawals=tuple(sorted({shortest, *lines.withdrawals}))
    )
    first = Deadline(_SHARE * clock.left if clock.limited else None)
    result = search(replace(settings, keyframes=short), graph, first)
    if graph is None and _may_exist(result):
        again = search(settings, graph, clock)
        # Without a plan, the longer partial one is kept.
        reached = 0 if result.explanation is None else result.explanation.reached
        if again.explanation is None or again.explanation.reached >= reached:
            result, kind = again, "sequential"
    found = {"search": kind, "seconds": round(clock.seconds, 3)}
    for plan in filter(None, (result.value, result.partial)):
        plan.statistics.update(found)
    return replace(result, statistics=result.statistics | found)


def _may_exist(result: HybridResult) -> bool:
    """Return whether there is no plan so far, but none is proved impossible."""
    return result.explanation is not None and result.explanation.outcome != "proved_impossible"


def _plan_sets(
    plan: Callable[[Assembly, Task, float | None], HybridResult],
    assembly: Assembly,
    cell: Cell,
    task: Task,
    stability: StabilitySettings,
    clock: Deadline,
) -> HybridResult:
    """Find which sets of parts a plan moves at once, and how, then motions.

    Sets that one arm carries come first, then those of which an arm of its own holds each part, then both. Motions are
    those of the structure in which each carried set is one part. A plan counts only if it is good with loose parts,
    too: their states stand, and each group holds together while it is carried.

    `plan` finds motions for a structure and a task, in so many seconds.
    """
    settings = stability_in(cell, assembly, stability)

    def by(rule: InterlockedSets) -> HybridResult:
        """Return the result where sets move by one rule."""
        within = replace(task, robots=cell.robot_count, together=rule)
        found = find_plans(assembly, within, stability=settings, deadline=clock.rest, forces=False)
        if found.value is None:
            proved = found.result.outcome is Outcome.PROVED_IMPOSSIBLE
            outcome = "interrupted" if found.deadline_passed else "proved_impossible" if proved else "not_found"
            return _without(outcome, found.reason, within, no_order=True)
        sets = [step for step in found.value if len(step.parts) > 1]
        carried = tuple(dict.fromkeys(step.parts for step in sets if len(step.robots) == 1))
        joined = join_parts(assembly, carried)
        several = max((len(step.robots) for step in sets), default=1)
        result = plan(joined, _joined_task(within, joined, several if rule.each_held else 1), clock.rest)
        groups = groups_of(joined)
        if groups is None:
            return result
        if result.value is not None:
            own = result.value.plan.claim
            loose = loose_plan(result.value.plan, groups)
            report = validate_plan(loose, assembly, replace(settings, reserve=own.reserve))
            if not report.good:
                return _without("not_found", f"with loose parts the plan is not good: {report.reason}", within)
        return replace(result, structure=joined)

    assert task.together is not None
    results: list[HybridResult] = []
    for rule in (task.together.carried, task.together.held, task.together):
        results.append(by(rule))
        if results[-1].value is not None or clock.passed:
            return results[-1]
    without = [result for result in results if not result.no_order]
    last = (without or results)[-1]
    movable = ~task.boundary & (task.start != REMOVED) & (task.target == REMOVED)
    if any(len(parts) > cell.robot_count for parts in task.together.sets(movable)) and last.explanation is not None:
        most = counted(cell.robot_count, "arm")
        why = (
            f"{last.explanation.text}; {cell.name} has {most}, and parts that leave at the same instant, each held, "
            "need one each: add arms"
        )
        last = replace(last, explanation=replace(last.explanation, text=why))
    return last


def _joined_task(task: Task, joined: Assembly, at_once: int) -> Task:
    """Return a task for the structure with joined parts, of which so many move at the same instant, each held."""
    groups = groups_of(joined)
    start, target, fixed, missing = task.start, task.target, task.fixed, task.missing
    if groups is not None:
        start, target = groups.join(start), groups.join(target)
        fixed, missing = (tuple({int(groups.joined[part]) for part in some}) for some in (fixed, missing))
    found = make_task(
        joined,
        task.robots,
        start=start,
        target=target,
        fixed=fixed,
        missing=missing,
        removable_only_if_clear=True,
        allow_regrasp=task.allow_regrasp,
        parts_at_once=at_once,
        moves=task.moves_out,
        turns=task.turns,
        waiting=task.waiting,
    )
    return found if found.together is None else replace(found, together=found.together.held)


def _without(outcome: str, why: str, task: Task, *, no_order: bool = False) -> HybridResult:
    """Return the result where there is no plan."""
    explanation = Explanation(outcome, 0, task.steps, (), None, (), why)
    return HybridResult(None, None, explanation, {}, no_order=no_order)
