"""Steps of a plan: what is done to which parts, by which robots, and the state that it leads to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, Mask, States
from falsework.stability.holds import Press, RobotNames, robot_number
from falsework.stability.verdict import Verdict
from falsework.utils.quantity import format_quantity

NO_ROBOT = -1


class Action(StrEnum):
    """What a step does to its part."""

    INSERT = "insert"
    """Bring the part to its place and hold it there."""
    RELEASE = "release"
    """Let go of the part, which stays."""
    HOLD = "hold"
    """Hold a part that stands: in plans with repeated holds, and in disassembly."""
    REMOVE = "remove"
    """Take away a part that is held: a prop, or in disassembly any part."""

    @property
    def undone(self) -> Action:
        """The action that undoes this one."""
        return _UNDONE[self]


_UNDONE = {
    Action.INSERT: Action.REMOVE,
    Action.REMOVE: Action.INSERT,
    Action.HOLD: Action.RELEASE,
    Action.RELEASE: Action.HOLD,
}


@dataclass(frozen=True, eq=False)
class PlanStep:
    """One step of a plan."""

    number: int
    """From 1, in the order of assembly; the same in every output, also where a plan is shown in disassembly."""
    action: Action
    part: int
    """The part; of several that move together, the first that a robot holds."""
    name: str
    """Name of the part; of several `a and b` where a robot holds each, `a with b` where the robot holds only `a`."""
    robot: int | None
    """Robot that does it, from 0; None for a prop, which no robot holds."""
    state: States
    """State after the step, shape (parts,)."""
    verdict: Verdict
    """Verdict on that state."""
    presses: tuple[Press, ...] = ()
    """Presses of other robots while this one lets go of its part."""
    pressed: tuple[tuple[int, str], ...] = ()
    """Robots that press, from 0, and what they do, such as `presses block-25 with 3.9 kN`."""
    parts: tuple[int, ...] = ()
    """All parts that move, those that robots hold first: one, except where several move together."""
    robots: tuple[int, ...] = ()
    """Robots of those that are held, in the same order."""

    @property
    def words(self) -> str:
        """What is done, such as `insert keystone`, with the presses of robots."""
        return self.words_by(robot_number)

    def words_by(self, names: RobotNames) -> str:
        """Return `words` by the names of the robots."""
        return self._told("", names)

    def by(self, names: RobotNames = robot_number) -> str:
        """Return the names of the robots that do it, such as `R1, R2`; empty for a prop."""
        return ", ".join(map(names, self.robots))

    def told(self, names: RobotNames) -> str:
        """Describe the step with its robots, such as `insert keystone (R1)`, by the names of the robots."""
        return self._told(f" ({self.by(names)})" if self.robots else "", names)

    def _told(self, by: str, names: RobotNames) -> str:
        return "; ".join(
            (f"{self.action} {self.name}{by}", *(f"{names(robot)} {what}" for robot, what in self.pressed))
        )

    def __str__(self) -> str:
        return self.told(robot_number)

    def __repr__(self) -> str:
        return f"<PlanStep {self.number}: {self}>"


def steps_of(
    states: States,
    actions: NDArray[np.int64],
    who: NDArray[np.int64],
    verdicts: tuple[Verdict, ...],
    names: tuple[str, ...],
    presses: tuple[tuple[Press, ...], ...],
) -> tuple[PlanStep, ...]:
    """Return the steps between the states of a plan.

    Args:
        states: in the order of assembly, shape (steps + 1, parts).
        actions: as in `Plan.actions`, shape (steps,).
        who: robot that holds each part in each state, shape (steps + 1, parts).
        verdicts: one a state.
        presses: one entry a step, or none.
    """
    parts, found = states.shape[1], []
    for number, action in enumerate(actions.tolist(), 1):
        part, before = action % parts, int(states[number - 1, action % parts])
        if action >= parts:
            does = Action.INSERT if before == REMOVED else Action.REMOVE
        else:
            does = Action.RELEASE if before == HELD else Action.HOLD
        moved, held = moved_parts(states[number - 1], states[number])
        by = tuple(max(int(who[number - 1, one]), int(who[number, one])) for one in moved[:held])
        robots = tuple(robot for robot in by if robot != NO_ROBOT)
        pressing = presses[number - 1] if presses else ()
        found.append(
            PlanStep(
                number,
                does,
                part,
                name_together([names[one] for one in moved], held),
                robots[0] if robots else None,
                states[number],
                verdicts[number],
                pressing,
                tuple(
                    (int(who[number, press.part]), f"presses {names[press.part]} with {_newtons(press)}")
                    for press in pressing
                ),
                moved,
                robots,
            )
        )
    return tuple(found)


def _newtons(press: Press) -> str:
    return format_quantity(press.force, "force")


def moved_parts(before: States, after: States) -> tuple[tuple[int, ...], int]:
    """Return the parts that a step between two states moves, those that robots hold first, and how many these are."""
    changed = before != after
    held = changed & ((before == HELD) | (after == HELD))
    first, rest = np.flatnonzero(held).tolist(), np.flatnonzero(changed & ~held).tolist()
    return (*first, *rest), len(first)


def inserts_several(states: States) -> bool:
    """Return whether a step between consecutive states, shape (steps + 1, parts), moves more than one part."""
    return bool(((states[1:] != states[:-1]).sum(axis=1) > 1).any())


def name_together(names: list[str], held: int) -> str:
    """Return the names of parts that move together: `a and b` if all are held, `a with b` if only the first is."""
    lists = [
        ", ".join(some[:-1]) + " and " * (len(some) > 1) + some[-1] for some in (names[:held], names[held:]) if some
    ]
    return " with ".join(lists)


def undone(steps: tuple[PlanStep, ...], first: States, verdict: Verdict) -> tuple[PlanStep, ...]:
    """Return steps as they are undone, the last one first.

    A step keeps its number and robot, but holds where it released, and removes where it inserted. Robots do not press.

    Args:
        steps: in the order of assembly.
        first: state before the first of them, shape (parts,).
    """
    before = [(first, verdict), *((step.state, step.verdict) for step in steps)]
    return tuple(
        replace(step, action=step.action.undone, state=state, verdict=known, presses=(), pressed=())
        for step, (state, known) in zip(reversed(steps), reversed(before[:-1]), strict=True)
    )


def holders(states: States, immovable: Mask) -> NDArray[np.int64]:
    """Return the robot that holds each part in each state, `NO_ROBOT` for none; it stays the same during a hold.

    Args:
        states: states one action apart, shape (steps + 1, parts).
        immovable: parts that no robot holds, shape (parts,).

    Returns:
        Shape (steps + 1, parts).
    """
    robots = np.full(states.shape, NO_ROBOT, dtype=np.int64)
    for step, state in enumerate(states):
        held = np.flatnonzero((state == HELD) & ~immovable)
        before = robots[step - 1] if step else np.full(len(state), NO_ROBOT)
        robots[step, held] = before[held]
        free = [robot for robot in range(len(held)) if robot not in robots[step, held]]
        for part, robot in zip([part for part in held if robots[step, part] == NO_ROBOT], free, strict=False):
            robots[step, part] = robot
    return robots


def no_such_step(step: int | str, count: int) -> str:
    """Return the message on a step that a plan with so many steps does not have."""
    steps = f"the plan has the steps 1 to {count}, and 0 is the start" if count else "there are no steps"
    return f"step {step} does not exist; {steps}"
