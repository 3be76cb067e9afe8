"""Plans with motions for robots that move at the same time.

The planner for one robot at a time searches, with straight lines as short as possible. Order and robots of its plan are
then changed so that robots wait less, and its motions overlap as far as that is proven safe. For three robots or more,
unless there are many parts, a second plan from another seed is found beside it, and the one with the shorter makespan
is taken. Where waits for space cost much of the makespan, motions are planned anew around those of other robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.interleaving.search import is_worth_more
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.model.cell import Cell
from falsework.robots.planning.around_neighbours import plan_around_neighbours
from falsework.robots.planning.end_motions import parts_of
from falsework.robots.planning.hybrid_planner import plan_robots
from falsework.robots.planning.hybrid_result import HybridResult, HybridSettings, Progress
from falsework.robots.planning.reserve import keeping_reserve
from falsework.robots.planning.second_search import SecondSearch
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.schedule.solver import import_ortools
from falsework.search.find import PLANS
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import Stability
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.notebook import or_notebook

_APPROACHES = (0.4, 1.0, 1.8)
_WITHDRAWALS = (0.4, 1.0, 2.0, 4.0)
"""As in `KeyframeSettings`, short ones first: an arm comes to rest at both ends of a line."""
_SHARE = 0.7
"""Share of the deadline after which the search with short lines is given up."""
_LEAST_SECONDS = 1e-3
"""Least time that is left to the search for one robot at a time."""
_OTHER_SEED = 1_000_003
"""Added to the seed for the second plan."""


def plan_together(
    assembly: AnyStructure,
    cell: AnyCell,
    *,
    task: Task | None = None,
    configurations: Sequence[ArrayLike] | None = None,
    held: Sequence[int | None] | None = None,
    gripped: Sequence[ArrayLike | None] | None = None,
    oracle: Stability | None = None,
    stability: StabilitySettings = PLANS,
    guide: Guide | None = None,
    settings: HybridSettings = HybridSettings(),
    progress: Progress | None = None,
) -> HybridResult:
    """Find a plan with motions and schedule them for robots that move at the same time.

    Where `plan_robots` finds a plan, there is one here too, unless the deadline passes first. The statistics have
    `search`: `together`, or `sequential` where only the lines of `plan_robots` led to a plan.

    Args:
        assembly, cell, task, configurations, held, gripped, oracle, stability, guide, settings, progress: as in
            `plan_robots`.

    Raises:
        CellError: a gripper bears less than the weight of a part.
        InputError: configurations that do not fit the robots, or in which something collides.
        StateError: held parts that do not go with the state that is begun with.
        DependencyError: OR-Tools is missing.
    """
    import_ortools()
    assembly, cell = as_assembly(assembly), as_cell(cell)
    progress = or_notebook(progress, "planning motions")
    now = {"configurations": configurations, "held": held, "gripped": gripped}
    start: dict[str, Any] = {"task": task, **now}
    if oracle is None:
        start |= {"guide": guide, "progress": progress}
        return keeping_reserve(
            lambda oracle, limits: plan_together(assembly, cell, oracle=oracle, settings=limits, **start),
            assembly,
            cell,
            stability,
            settings,
        )
    clock = Deadline(settings.deadline)
    lines = replace(settings.keyframes, approaches=_APPROACHES, withdrawals=_WITHDRAWALS)
    short = replace(settings, together=True, keyframes=lines)
    continues = settings.direction is Direction.ASSEMBLY and any(given is not None for given in now.values())
    needed = parts_of(task, continues=continues)
    graph = KeyframeGraph(assembly, cell, settings=short.keyframes, seed=settings.seed, **needed)

    def search(limits: HybridSettings, graph: KeyframeGraph, seconds: float) -> HybridResult:
        # Even where a long motion has used the time up, a search ends by itself, with what it has.
        left = max(seconds - clock.seconds, _LEAST_SECONDS) if clock.limited else None
        limits = replace(limits, deadline=left)
        return plan_robots(
            assembly, cell, oracle=oracle, guide=guide, settings=limits, progress=progress, graph=graph, **start
        )

    limit = np.inf if settings.deadline is None else settings.deadline
    kind, second = "together", None
    leaving = ~assembly.boundary if task is None else (task.start != REMOVED) & (task.target == REMOVED)
    if guide is not None or not is_worth_more(cell.robot_count, int(leaving.sum())):
        result = search(short, graph, _SHARE * limit)
    else:
        # Both plans get one attempt, so that how long one takes tells nothing about which one is taken.
        once = replace(short, attempts=1)
        limits = replace(once, seed=settings.seed + _OTHER_SEED, deadline=_SHARE * limit if clock.limited else None)
        given = {"assembly": assembly, "cell": cell, "stability": oracle.settings, "settings": limits, **start}
        with SecondSearch(second_plan, given) as beside:
            result = search(once, graph, _SHARE * limit)
            if result.found or _may_exist(result):
                second = beside.plan(clock.left)
        if second is not None and (result.plan is None or second.makespan < result.plan.makespan):
            second.statistics["seed"] = settings.seed
            result = HybridResult(second, None, None, second.statistics)
        elif _may_exist(result):
            result = search(short, graph, _SHARE * limit)
    if _may_exist(result):
        keyframes, seed = settings.keyframes, settings.seed
        graph = KeyframeGraph(assembly, cell, settings=keyframes, seed=seed, parts=graph.parts, **needed)
        again = search(replace(settings, together=True), graph, limit)
        # Without a plan, the longer partial one is kept.
        if again.explanation is None or again.explanation.reached >= _reached(result):
            result, kind = again, "sequential"

    if result.plan is not None:
        done = plan_around_neighbours(result.plan, graph.world, seed=settings.seed, stop=lambda: clock.passed)
        result = replace(result, plan=done, statistics=done.statistics)

    for plan in filter(None, (result.plan, result.partial)):
        plan.statistics.update(search=kind, second_plan=second is not None, seconds=round(clock.seconds, 3))
    statistics = {**result.statistics, "search": kind, "seconds": round(clock.seconds, 3)}
    return replace(result, statistics=statistics)


def second_plan(
    assembly: Assembly, cell: Cell, *, stability: StabilitySettings, settings: HybridSettings, **start: Any
) -> RobotPlan | None:
    """Return the plan of another process, or None."""
    return plan_robots(assembly, cell, oracle=Stability(assembly, stability), settings=settings, **start).plan


def _reached(result: HybridResult) -> int:
    """Return the steps that the partial plan of a failed search has done."""
    return 0 if result.explanation is None else result.explanation.reached


def _may_exist(result: HybridResult) -> bool:
    """Return whether there is no plan so far, but none is proved impossible."""
    return result.explanation is not None and result.explanation.outcome != "proved_impossible"
