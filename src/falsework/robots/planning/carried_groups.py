"""Robot plans in which an arm carries a group of parts: each group is planned for as one part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from falsework.assembly.groups import groups_of, join_parts
from falsework.assembly.model import Assembly
from falsework.robots.keyframes.failure_report import Explanation
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import stability_in
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.loose_plan import loose_plan
from falsework.search.find import find_plans
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.result import Outcome
from falsework.search.problem.task import Task
from falsework.stability.settings import StabilitySettings


def plan_groups(
    plan: Callable[[Assembly, Task, float | None], HybridResult],
    assembly: Assembly,
    cell: Cell,
    task: Task,
    stability: StabilitySettings,
    clock: Deadline,
) -> HybridResult:
    """Find which groups a plan carries, then motions for the structure in which each of them is one part.

    The plan that is found counts only if it is good with loose parts, too: their states stand, and each group holds
    together while it is carried.

    Args:
        plan: finds motions for a structure and a task, in so many seconds.
        assembly, cell, stability: as in `plan_robots`.
        task: with `Task.together`.
        clock: runs until the deadline.
    """
    assert task.together is not None
    within = replace(task, robots=cell.robot_count, together=task.together.carried)
    settings = stability_in(cell, assembly, stability)
    left = clock.left if clock.limited else None
    found = find_plans(assembly, within, stability=settings, deadline=left, forces=False)
    if found.value is None:
        proved = found.result.outcome is Outcome.PROVED_IMPOSSIBLE
        outcome = "interrupted" if found.deadline_passed else "proved_impossible" if proved else "not_found"
        return _without(outcome, found.reason, task, no_order=True)
    sets = tuple(dict.fromkeys(step.parts for step in found.value if len(step.parts) > 1))
    joined = join_parts(assembly, sets)
    result = plan(joined, _joined_task(within, joined), clock.left if clock.limited else None)
    groups = groups_of(joined)
    if groups is None:
        return result
    if result.value is None:
        return replace(result, structure=joined)
    own = result.value.plan.claim
    loose = loose_plan(result.value.plan, groups)
    report = validate_plan(loose, assembly, replace(settings, reserve=own.reserve))
    if report.good:
        return replace(result, structure=joined)
    return _without("not_found", f"with loose parts the plan is not good: {report.reason}", task)


def _joined_task(task: Task, joined: Assembly) -> Task:
    """Return a task for the structure with joined parts."""
    groups = groups_of(joined)
    start, target, fixed, missing = task.start, task.target, task.fixed, task.missing
    if groups is not None:
        start, target = groups.join(start), groups.join(target)
        fixed, missing = (tuple({int(groups.joined[part]) for part in some}) for some in (fixed, missing))
    return Task.from_rules(
        joined.boundary,
        task.robots,
        start=start,
        target=target,
        fixed=fixed,
        missing=missing,
        clearance=joined.clearance,
        identity=joined.identity,
        allow_regrasp=task.allow_regrasp,
    )


def _without(outcome: str, why: str, task: Task, *, no_order: bool = False) -> HybridResult:
    """Return the result where there is no plan."""
    explanation = Explanation(outcome, 0, task.steps, (), None, (), why)
    return HybridResult(None, None, explanation, {}, no_order=no_order)
