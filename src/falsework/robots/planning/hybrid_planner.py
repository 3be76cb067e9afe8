"""Hybrid planner: abstract actions and motions together (paper, section 6, algorithm 1).

For robots that move at the same time, a plan for one robot at a time is found first, with straight lines as short as
possible. Order and robots of its steps are then changed so that robots wait less, and its motions overlap as far as
that is proven safe.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import stability_in
from falsework.robots.planning.boundary_motions import BoundaryMotions, graph_parts, leading_insertions
from falsework.robots.planning.carried_groups import plan_sets
from falsework.robots.planning.hybrid_result import HybridResult, HybridSettings, Progress
from falsework.robots.planning.hybrid_search import HybridSearch
from falsework.robots.planning.initial_keyframe import given_keyframe, task_in_cell
from falsework.robots.schedule.solver import import_ortools
from falsework.search.find import PLANS
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.notebook import or_notebook

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
            set that one robot carries is one part (`Assembly.groups`), and is checked with loose parts.
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
        CellError: a gripper bears less than the weight of a part.
        InputError: configurations that do not fit the robots, or in which something collides.
        StateError: held parts that do not go with the state that is begun with.
        DependencyError: robots are to move at the same time, and OR-Tools is missing.
    """
    if concurrent:
        import_ortools()
    assembly, cell = as_assembly(assembly), as_cell(cell)
    if task is not None and task.together is not None and task.together.by_one:
        if any(given is not None for given in (configurations, held, gripped, oracle, guide, graph)):
            raise InputError(
                "robots move several parts at once only in whole plans without a policy; leave out what is held, joint "
                "values, oracle, guide and graph, or plan without parts_at_once"
            )
        options: dict[str, Any] = {"concurrent": concurrent, "settings": settings, "progress": progress}
        return plan_sets(
            lambda structure, task, left: plan_robots(
                structure, cell, task=task, deadline=left, stability=stability, forces=forces, **options
            ),
            assembly,
            cell,
            task,
            stability,
            Deadline(deadline),
        )
    progress = or_notebook(progress, "planning motions")
    if oracle is None:
        given: dict[str, Any] = {"task": task, "configurations": configurations, "held": held, "gripped": gripped}
        given |= {"concurrent": concurrent, "guide": guide, "settings": settings, "progress": progress, "graph": graph}
        return _keeping_reserve(
            lambda oracle, left: plan_robots(assembly, cell, oracle=oracle, deadline=left, forces=forces, **given),
            assembly,
            cell,
            stability,
            deadline,
        )
    now = configurations, held, gripped
    continues = settings.direction is Direction.ASSEMBLY and any(given is not None for given in now)
    clock, needed = Deadline(deadline), graph_parts(task, continues=continues)

    def search(limits: HybridSettings, graph: KeyframeGraph | None, clock: Deadline) -> HybridResult:
        graph = graph or KeyframeGraph(assembly, cell, settings=limits.keyframes, seed=limits.seed, **needed)
        within = task_in_cell(assembly, cell, task, graph.exits)
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


def _keeping_reserve(
    search: Callable[[StabilityOracle, float | None], HybridResult],
    assembly: Assembly,
    cell: Cell,
    stability: StabilitySettings,
    deadline: float | None,
) -> HybridResult:
    """Return the result of a search with the reserve, or where it finds no order of the parts, of one without.

    The deadline, seconds, is that of both searches together.
    """
    clock = Deadline(deadline)
    result = search(StabilityOracle(assembly, stability_in(cell, assembly, stability)), deadline)
    if not result.no_order or stability.reserve <= 1.0 or clock.passed:
        return result
    plain = stability_in(cell, assembly, replace(stability, reserve=1.0))
    return search(StabilityOracle(assembly, plain), clock.left if clock.limited else None)


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
