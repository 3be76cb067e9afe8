"""Ways of the parts of a robot plan: which of their moves each step executes."""

from __future__ import annotations

from falsework.geometry.clearance.moves import ExitPath, way_back
from falsework.robots.plans.loads import moved_aside
from falsework.robots.plans.robot_plan import RobotPlan, acts
from falsework.search.problem.task import Direction


def in_turn(way: ExitPath) -> bool:
    """Return whether a way has moves of others than the parts that leave, or of some of these alone."""
    return any(set(move.parts) != set(way[-1].parts) for move in way)


def moves_of_steps(plan: RobotPlan) -> tuple[dict[int, ExitPath], list[tuple[int, str]]]:
    """Return the moves that steps execute, in the order of leaving, and what is wrong with the steps of some ways.

    A part that leaves alone makes all moves of its way in the step that removes it. Otherwise each move but the last is
    a transit before that step, and each in which others go back one after it.
    """
    apart, paths, parts = plan.direction is Direction.DISASSEMBLY, plan.plan.exit_paths, len(plan.plan.boundary)
    order = [*range(len(plan.steps))] if apart else [*range(len(plan.steps))][::-1]
    found, faults = dict[int, ExitPath](), list[tuple[int, str]]()
    for place, step in enumerate(order):
        if not (paths and acts(plan.steps[step]) and plan.actions[step] >= parts):
            continue
        way = paths[int(plan.rows[step : step + 2].min())]
        if not way or not (in_turn(way) or plan.steps[step].partners):
            found[step] = way
            continue
        found[step], back = way[-1:], way_back(way)
        before = order[max(place + 1 - len(way), 0) : place]
        after = [other for other in order[place + 1 :] if moved_aside(plan, other)][: len(back)]
        for others, moves in ((before, way[:-1]), (after, back)):
            if [{*moved_aside(plan, other).values()} for other in others] != [set(move.parts) for move in moves]:
                faults.append((step, "its way has other moves than the robots make before and after it"))
            found.update((other, (move,)) for other, move in zip(others, moves, strict=False))
    stray = [step for step in order if moved_aside(plan, step) and step not in found]
    return found, [*faults, *((step, "it moves a held part aside, which is on no way") for step in stray)]
