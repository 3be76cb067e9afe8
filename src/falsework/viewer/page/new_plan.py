"""Answer of the page to a replanning request, in words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from falsework.replanning.plan_diff import difference
from falsework.replanning.since import with_places
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.replanning.result import ReplanResult
    from falsework.search.plans.plan import Plan


@dataclass(frozen=True, eq=False)
class NewPlan:
    """Result of a replanning request."""

    words: str
    """Deciding stage, time taken, when late parts are needed, and differences from the old plan; or the reason for
    none."""
    plan: Plan | None = None


def new_plan(answer: ReplanResult, assembly: Assembly, seconds: float, old: Plan | None, before: int) -> NewPlan:
    """Describe the answer to a request.

    Args:
        before: steps that are done and not in the new plan, with which its numbers go on.
    """
    decided = answer.decided_by.value
    if answer.value is None:
        kind = "there is no plan" if answer.outcome.value == "proved_impossible" else "no plan was found"
        return NewPlan(f"{kind} ({seconds:.2f} s, {decided}): {answer.reason}")
    plan = answer.value
    texts = [f"{counted(len(plan) - answer.built, 'step')} in {seconds:.2f} s, decided by {decided}."]
    placed = int((plan.actions[: answer.built] >= len(plan.boundary)).sum())
    for need in plan.needs:
        name, others = plan.part_names[need.part], need.after_parts - placed
        after = f"after {counted(others, 'other part')}" if others else "before any other part"
        texts.append(f"{name} is needed at step {before + need.after_steps + 1}, {after}.")
    if answer.open_replay:
        texts.append(f"{answer.open_replay[:1].upper()}{answer.open_replay[1:]}.")
    texts += [f"No plan was found that keeps the reserve: {answer.unreserved}."] if answer.unreserved else []
    texts += [] if old is None else _weaker(plan, old)
    if old is None:
        texts.append("There was no plan before.")
    else:
        text = difference(with_places(old, assembly), plan, answer.direction, answer.built).text
        texts.append(f"{text[:1].upper()}{text[1:]}.")
        if plan.source is None:
            plan = replace(plan, source=old.source)
    return NewPlan(" ".join(texts), plan)


def _weaker(plan: Plan, old: Plan) -> list[str]:
    """Return in what a plan promises less than the one before."""
    kept, before = plan.claim.reserve, old.claim.reserve
    found = [f"It keeps a reserve of {kept:g}, not {before:g} as before."] if kept < before else []
    if old.replay is not None and old.replay.varied and not (plan.replay is not None and plan.replay.varied):
        found.append("It was not tried under changes of settings, as the one before was.")
    return found
