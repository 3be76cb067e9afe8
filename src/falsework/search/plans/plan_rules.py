"""Rules that the steps of a plan keep: robots, order, exits, and presses."""

from __future__ import annotations

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, held_count, undo_actions, undo_mask
from falsework.errors import AssemblyError
from falsework.geometry.clearance.locked import LARGEST, PartSet
from falsework.geometry.paths.waiting import hands_free, has_hands, loose_parts, stages
from falsework.search.plans.plan import Plan
from falsework.search.plans.steps import moved_parts
from falsework.search.problem.part_sets import holds_together
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.task import Direction, Task
from falsework.search.together.posed_states import PosedStates
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import counted


def broken_rule(plan: Plan, assembly: Assembly, settings: StabilitySettings) -> tuple[int, str] | None:
    """Return the first state that the rules do not allow, and why; None if all are allowed.

    Args:
        assembly: the structure, in which parts must have ways out.
        settings: of what must stand while parts wait half way out, or robots carry groups.
    """
    states, parts, boundary = plan.states, len(plan.boundary), plan.boundary
    held = int(held_count(states[:1], plan.immovable)[0])
    if held > plan.robots:
        return 0, f"{counted(held, 'part')} held at first, with {counted(plan.robots, 'robot')}"
    if plan.allow_regrasp:
        moves = RegraspMoves(_task_of(plan))
        allowed, led_to = moves.legal(states[:-1], Direction.ASSEMBLY), moves.follow(states[:-1], plan.actions)
    else:
        allowed, led_to = undo_mask(states[:-1], boundary, plan.robots), undo_actions(states[:-1], plan.actions)
    for step, action in enumerate(plan.actions.tolist()):
        place = f"step {step + 1} ({plan.words(step + 1)})"
        changed = np.flatnonzero(states[step] != states[step + 1])
        if not allowed[step, action]:
            return step + 1, f"{place} is against the rules: {_why(plan, step)}"
        if np.isin([*changed, action % parts], plan.fixed).any():
            return step + 1, f"{place} touches a fixed part"
        if len(changed) > 1:
            wrong = broken_together(plan, step, assembly, settings)
            if wrong:
                return step + 1, f"{place} {wrong}"
        elif not np.array_equal(led_to[step], states[step + 1]):
            return step + 1, f"{place} does not lead to the next state of the plan"
    for step, presses in enumerate(plan.presses):
        wrong = _broken_press(plan, step, [press.part for press in presses]) if presses else ""
        if wrong:
            return step + 1, f"step {step + 1} ({plan.words(step + 1)}) is against the rules: {wrong}"
    if plan.removable_only_if_clear:
        # The way in is the way out from the state in which the part is there.
        alone = (states[1:] != states[:-1]).sum(axis=1) == 1
        inserts = np.flatnonzero((plan.actions >= parts) & alone)
        clear = assembly.clearance.can_leave(states[inserts + 1])
        for step in inserts[~clear[np.arange(len(inserts)), plan.actions[inserts] - parts]].tolist():
            wrong = _broken_way(plan, step, assembly, settings, (int(plan.actions[step]) - parts,))
            if wrong:
                return step + 1, f"step {step + 1} ({plan.words(step + 1)}) {wrong}"
    return None


def _broken_way(plan: Plan, step: int, assembly: Assembly, settings: StabilitySettings, leaving: PartSet) -> str:
    """Return what is wrong with how a step inserts parts that have no straight way, as the end of a sentence."""
    moves = plan.exit_paths[step] if plan.exit_paths else ()
    state = plan.states[step + 1]
    if not moves:
        return "finds no straight way past the other parts"
    if len(moves) > plan.moves:
        return f"is against the rules: its way has {len(moves)} moves, and {plan.moves} are allowed"
    if any(move.turns for move in moves) and not plan.turns:
        return "is against the rules: its way has a turn, and none is allowed"
    if set(moves[-1].parts) != set(leaving):
        only = "the part alone" if len(leaving) == 1 else "its parts together"
        return f"is against the rules: the last move of its way is not that of {only}"
    if len(leaving) > 1 and any(move.turns for move in moves):
        return "is against the rules: parts that leave together do not turn"
    carried = [move for move in moves if (state[list(leaving)] != HELD).any() and set(move.parts) & set(leaving)]
    if len(leaving) > 1 and any(not set(leaving) <= set(move.parts) for move in carried):
        return "is against the rules: parts that one robot carries do not move as one body"
    moved = sorted({one for move in moves for one in move.parts})
    still = [one for one in moved if plan.immovable[one] or one in plan.fixed]
    loose = sorted(loose_parts(moves, state, leaving))
    if still or (loose and (not plan.waiting or len(leaving) > 1)):
        name = plan.part_names[(still or loose)[0]]
        return f"is against the rules: its way moves {name}, which no robot holds"
    spare = hands_free(state, leaving, plan.robots, plan.immovable)
    handless = next((move for move in moves if not has_hands(move.parts, state, leaving, spare)), None)
    if handless:
        return (
            f"is against the rules: no robot is free to carry {', '.join(plan.part_names[k] for k in handless.parts)}"
        )
    wrong = assembly.part_motions.leaves(moves, state != REMOVED)
    if wrong:
        return f"is against the rules: on its way out, {wrong}"
    if loose:
        posed, oracle = PosedStates(assembly), StabilityOracle(assembly, settings)
        for stage, poses in stages(moves, state, leaving, spare, out=True):
            if not posed.stands(oracle, stage, poses):
                names = ", ".join(plan.part_names[one] for one in sorted(poses) if stage[one]) or "no part"
                return f"is against the rules: on its way, with {names} half way out, the other parts do not stand"
    elif moved != list(leaving):
        rest = state.copy()
        rest[moved] = REMOVED
        if not StabilityOracle(assembly, settings).verdicts(rest[None]).stable[0]:
            names = ", ".join(plan.part_names[one] for one in moved)
            return f"is against the rules: while {names} move, the other parts do not stand"
    return ""


def broken_together(plan: Plan, step: int, assembly: Assembly, settings: StabilitySettings) -> str:
    """Return what is wrong with a step that inserts several parts, as the end of a sentence; empty if nothing is.

    Args:
        plan, assembly, settings: as for `broken_rule`.
    """
    before, after = plan.states[step : step + 2]
    moved, held = moved_parts(before, after)
    names, rows = [plan.part_names[part] for part in moved], list(moved)
    robots = int(held_count(after[None], plan.immovable)[0])
    most = min(plan.parts_at_once, LARGEST)
    if len(moved) > most:
        return f"is against the rules: it moves {len(moved)} parts, and at most {most} can move at once"
    if (before[rows] != REMOVED).any() or held not in (1, len(moved)) or (after[rows[held:]] != INSTALLED).any():
        return "is against the rules: several parts can only be inserted, each held by a robot, or all carried by one"
    if int(plan.actions[step]) != len(before) + moved[0]:
        return "is named after a part that no robot holds"
    if robots > plan.robots:
        return f"is against the rules: it needs {counted(robots, 'robot')}, and the plan has {plan.robots}"
    together = tuple(sorted(moved))
    straight = assembly.clearance_of_sets.leave_together(together, after[None], apart=held == len(moved))[0]
    if not straight and plan.exit_paths and plan.exit_paths[step]:
        wrong = _broken_way(plan, step, assembly, settings, together)
        if wrong:
            return wrong
    elif not straight:
        alone = "no straight way past the other parts, or fewer of them have one"
        return f"is against the rules: {', '.join(names)} do not leave together: there is {alone}"
    if held < len(moved):
        try:
            if not holds_together(assembly, together, moved[0], settings):
                return f"is against the rules: {', '.join(names[1:])} fall while a robot carries them by {names[0]}"
        except AssemblyError as error:
            return f"is against the rules: {error}"
    return ""


def _task_of(plan: Plan) -> Task:
    """Return the task of a plan with repeated holds, without a rule on exits."""
    start, target = plan.states[[-1, 0]]
    return Task.from_rules(
        plan.boundary,
        plan.robots,
        start=start,
        target=target,
        fixed=plan.fixed,
        allow_regrasp=True,
        props=[prop.part for prop in plan.props],
        prop_limit=plan.prop_limit,
    )


def _broken_press(plan: Plan, step: int, pressed: list[int]) -> str:
    """Return why robots cannot press on some parts in a step; empty if they can."""
    if not plan.claim.presses:
        return "robots press, which those of the plan never do"
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
    takes_robot = plan.allow_regrasp or action >= parts
    if takes_robot and held >= plan.robots and state[part] != HELD:
        return "every robot is holding"
    return f"the part is {('removed', 'installed', 'held')[int(state[part])]}"
