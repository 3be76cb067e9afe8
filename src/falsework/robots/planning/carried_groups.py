"""Robot plans in which several parts move at once: each group that an arm carries is planned for as one part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from falsework.assembly.groups import groups_of, join_parts
from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED
from falsework.robots.keyframes.failure_report import Explanation
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import stability_in
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.loose_plan import loose_plan
from falsework.search.find import find_plans, make_task
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.part_sets_rule import Together
from falsework.search.problem.result import Outcome
from falsework.search.problem.task import Task
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import counted


def plan_sets(
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

    Args:
        plan: finds motions for a structure and a task, in so many seconds.
        assembly, cell, stability: as in `plan_robots`.
        task: with `Task.together`.
        clock: runs until the deadline.
    """
    assert task.together is not None
    results: list[HybridResult] = []
    for rule in (task.together.carried, task.together.held, task.together):
        within = replace(task, robots=cell.robot_count, together=rule)
        results.append(_plan_by(rule, plan, assembly, cell, within, stability, clock))
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


def _plan_by(
    rule: Together,
    plan: Callable[[Assembly, Task, float | None], HybridResult],
    assembly: Assembly,
    cell: Cell,
    task: Task,
    stability: StabilitySettings,
    clock: Deadline,
) -> HybridResult:
    """Return the result where sets move by one rule."""
    settings = stability_in(cell, assembly, stability)
    left = clock.left if clock.limited else None
    found = find_plans(assembly, task, stability=settings, deadline=left, forces=False)
    if found.value is None:
        proved = found.result.outcome is Outcome.PROVED_IMPOSSIBLE
        outcome = "interrupted" if found.deadline_passed else "proved_impossible" if proved else "not_found"
        return _without(outcome, found.reason, task, no_order=True)
    sets = [step for step in found.value if len(step.parts) > 1]
    carried = tuple(dict.fromkeys(step.parts for step in sets if len(step.robots) == 1))
    joined = join_parts(assembly, carried)
    several = max((len(step.robots) for step in sets), default=1)
    within = _joined_task(task, joined, several if rule.each_held else 1)
    result = plan(joined, within, clock.left if clock.limited else None)
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
