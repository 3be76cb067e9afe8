"""Rules that the steps of a plan keep: robots, order, exits, and presses."""

from __future__ import annotations

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, States, held_count, undo_actions, undo_mask
from falsework.search.plans.plan import Plan
from falsework.search.problem.support_moves import SupportMoves
from falsework.search.problem.task import Direction, Task


def broken_rule(plan: Plan, assembly: Assembly | None = None) -> tuple[int, str] | None:
    """Return the first state that the rules do not allow, and why; None if all are allowed.

    Args:
        plan: plan to check.
        assembly: needed to check that removed parts have a way out; that is left out without it.
    """
    states, parts, boundary = plan.states, len(plan.boundary), plan.boundary
    held = int(held_count(states[:1], plan.immovable)[0])
    if held > plan.robots:
        return 0, f"{held} parts are held at first, with {plan.robots} robots"
    if plan.support:
        allowed = SupportMoves(_task_of(plan)).legal(states[:-1], Direction.ASSEMBLY)
    else:
        allowed = undo_mask(states[:-1], boundary, plan.robots)
    kept = np.isin(plan.actions % parts, plan.fixed)
    for step, action in enumerate(plan.actions.tolist()):
        if not allowed[step, action]:
            return step + 1, f"step {step + 1} ({plan.words(step + 1)}) is against the rules: {_why(plan, step)}"
        if kept[step]:
            return step + 1, f"step {step + 1} ({plan.words(step + 1)}) touches a fixed part"
    if not np.array_equal(_follow(plan), states[1:]):
        return 1, "the actions do not lead through the states of the plan"
    for step, presses in enumerate(plan.presses):
        wrong = _broken_press(plan, step, [press.part for press in presses]) if presses else ""
        if wrong:
            return step + 1, f"step {step + 1} ({plan.words(step + 1)}) is against the rules: {wrong}"
    if plan.removable_only_if_clear and assembly is not None:
        # The way in is the way out from the state in which the part is there.
        inserts = np.flatnonzero(plan.actions >= parts)
        clear = assembly.clearance.can_leave(states[inserts + 1])
        blocked = inserts[~clear[np.arange(len(inserts)), plan.actions[inserts] - parts]]
        if len(blocked):
            step = int(blocked[0])
            return step + 1, f"step {step + 1} ({plan.words(step + 1)}) finds no straight way past the other parts"
    return None


def _follow(plan: Plan) -> States:
    """Return the states that the actions of a plan lead to, each from the state before."""
    if plan.support:
        return SupportMoves(_task_of(plan)).follow(plan.states[:-1], plan.actions)
    return undo_actions(plan.states[:-1], plan.actions)


def _task_of(plan: Plan) -> Task:
    """Return the task of a plan with repeated holds, without a rule on exits."""
    start, target = plan.states[[-1, 0]]
    return Task.create(
        plan.boundary,
        plan.robots,
        start=start,
        target=target,
        fixed=plan.fixed,
        support=True,
        props=[prop.part for prop in plan.props],
        prop_limit=plan.prop_limit,
    )


def _broken_press(plan: Plan, step: int, pressed: list[int]) -> str:
    """Return why robots cannot press on some parts in a step; empty if they can."""
    before, after = plan.states[step : step + 2]
    held = (before == HELD) & (after == HELD) & ~plan.immovable
    for part in pressed:
        if not held[part]:
            return f"a robot presses {plan.part_names[part]}, which it does not hold"
    if len(set(pressed)) < len(pressed):
        return "a robot presses a part twice"
    return "" if ((before == HELD) & (after == INSTALLED)).any() else "robots press, but no part is released"


def _why(plan: Plan, step: int) -> str:
    action, parts = int(plan.actions[step]), len(plan.boundary)
    part, state = action % parts, plan.states[step]
    if plan.boundary[part]:
        return "it is boundary"
    held = int(held_count(state[None], plan.immovable)[0])
    if part >= parts - len(plan.props):
        return f"{plan.prop_limit} props may stand at a time, each under a part that is there"
    if action >= parts and any(prop.part == part and state[k - len(plan.props)] for k, prop in enumerate(plan.props)):
        return "a prop stands under it"
    takes_robot = plan.support or action >= parts
    if takes_robot and held >= plan.robots and state[part] != HELD:
        return f"all {plan.robots} robots are holding"
    return f"the part is {('removed', 'installed', 'held')[int(state[part])]}"
