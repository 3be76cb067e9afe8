"""Ways of the parts of a robot plan: which of their moves each step executes, and what waits meanwhile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from falsework.assembly.state import HELD, INSTALLED
from falsework.geometry.clearance.moves import ExitPath, way_back
from falsework.geometry.paths.waiting import hands_free, lets_go, loose_parts
from falsework.robots.plans.loads import moved_aside
from falsework.robots.plans.robot_plan import RobotPlan, acts
from falsework.search.problem.task import Direction


def in_turn(way: ExitPath) -> bool:
    """Return whether a way has moves of others than the parts that leave, or of some of these alone."""
    return any(set(move.parts) != set(way[-1].parts) for move in way)


def moves_of_steps(plan: RobotPlan) -> tuple[dict[int, ExitPath], list[tuple[int, str]]]:
    """Return the moves that steps execute, in the order of leaving, and what is wrong with the steps of some ways.

    A part that leaves alone makes all moves of its way in the step that removes it. Otherwise each move but the last is
    a transit before that step, and each in which others go back one after it; between them robots take parts that wait,
    and let go of them.
    """
    apart, paths, parts = plan.direction is Direction.DISASSEMBLY, plan.plan.exit_paths, len(plan.plan.boundary)
    order = [*range(len(plan.steps))] if apart else [*range(len(plan.steps))][::-1]
    found, faults, allowed = dict[int, ExitPath](), list[tuple[int, str]](), set[tuple[int, int]]()
    for place, step in enumerate(order):
        if not (paths and acts(plan.steps[step]) and plan.actions[step] >= parts):
            continue
        way = paths[int(plan.rows[step : step + 2].min())]
        if not way or not (in_turn(way) or plan.steps[step].partners):
            found[step] = way
            continue
        back = way_back(way)
        before = _transits(plan, order[:place][::-1], len(way) - 1)[::-1]
        after = _transits(plan, order[place + 1 :], len(back))
        for some, moves in ((before, way[:-1]), ([step], way[-1:]), (after, back)):
            others = [other for other in some if other == step or moved_aside(plan, other)]
            made = [{*moved_aside(plan, other).values()} or {*moves[0].parts} for other in others]
            if made != [set(move.parts) for move in moves]:
                faults.append((step, "its way has other moves than the robots make before and after it"))
            found.update((other, (move,)) for other, move in zip(others, moves, strict=False))
        if plan.plan.waiting:
            run = _Run(plan, way, [*before, step, *after], step)
            allowed.update(run.waits())
            faults += [(step, fault) for fault in run.faults()]
    stray = [step for step in order if moved_aside(plan, step) and step not in found]
    faults += [(step, "it moves a held part aside, which is on no way") for step in stray]
    for k, frame in enumerate(plan.keyframes):
        taken = [part for part in plan.aside(k).values() if plan.states[k, part] == INSTALLED]
        for part in [*taken, *(part for part, _ in frame.waits)]:
            if (k, part) not in allowed:
                name = plan.plan.part_names[part]
                faults.append((min(k, len(plan) - 1), f"{name} waits, or is carried, beside the moves of its way"))
    return found, faults


def _transits(plan: RobotPlan, steps: Sequence[int], moves: int) -> list[int]:
    """Return the first transits among steps, with so many moves of a way."""
    found, made = list[int](), 0
    for step in steps:
        aside = bool(moved_aside(plan, step))
        if not plan.steps[step].transit or (aside and made == moves):
            break
        found.append(step)
        made += aside
    return found


class _Run:
    """Steps of a way on which parts may wait, in the order of leaving."""

    def __init__(self, plan: RobotPlan, way: ExitPath, steps: list[int], removal: int) -> None:
        self.plan, self.leaving, self.removal, self.steps = plan, way[-1].parts, removal, steps
        self.moves = (*way, *way_back(way))
        ends = removal, removal + 1
        self.state, self.later = (
            plan.states[k] for k in (ends if plan.direction is Direction.DISASSEMBLY else ends[::-1])
        )
        self.loose = loose_parts(way, self.state, self.leaving)
        spare = hands_free(self.state, self.leaving, plan.plan.robots, plan.plan.immovable)
        self._goes = [lets_go(move.parts, self.state, self.leaving, spare) for move in way]

    def _goes_for(self, number: int) -> bool:
        """Return whether the part that leaves waits during a move."""
        return 0 <= number < len(self._goes) and self._goes[number]

    def _makes(self, step: int) -> bool:
        return step == self.removal or bool(moved_aside(self.plan, step))

    def waits(self) -> Iterator[tuple[int, int]]:
        """Yield the keyframes within these steps at which parts may wait, or be taken, with these parts."""
        apart, done = self.plan.direction is Direction.DISASSEMBLY, 0
        for step in self.steps[:-1]:
            done += self._makes(step)
            keyframe = step + apart
            for part in self.loose | ({*self.leaving} if self._goes_for(done - 1) or self._goes_for(done) else set()):
                yield keyframe, part

    def faults(self) -> Iterator[str]:
        """Yield what is wrong with the parts that robots have in hand at the moves."""
        apart, leaves = self.plan.direction is Direction.DISASSEMBLY, [*self.leaving]
        made = [step for step in self.steps if self._makes(step)]
        for number, (step, move) in enumerate(zip(made, self.moves, strict=False)):
            state = self.later if number >= len(self._goes) else self.state
            held = {*np.flatnonzero((state == HELD) & ~self.plan.plan.immovable).tolist()}
            wanted = (held - ({*leaves} if self._goes_for(number) else set())) | (self.loose & {*move.parts})
            has = {part for part in self.plan.in_hand(step + (not apart)) if part is not None}
            if has != wanted:
                names = ", ".join(sorted(self.plan.plan.part_names[part] for part in has ^ wanted))
                yield f"in move {number + 1} of its way other parts are held than its states have: {names}"
