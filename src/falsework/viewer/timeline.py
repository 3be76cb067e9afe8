"""Timeline of a plan: states, holders, and the displacement of each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import HELD, REMOVED, Mask, States, as_states, describe_step
from falsework.search.plans.plan_check import check_identity
from falsework.search.problem.task import Direction
from falsework.stability.holds import Press, describe_presses

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Array = NDArray[np.float64]

NO_ROBOT = -1
EXACT_UP_TO = 150
"""Parts up to which exit directions are taken from the clearance table; above, computing it takes too long for a
viewer."""
UPWARDS = 0.35
"""Upward component of an estimated exit direction."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """States one action apart, with the data that a picture of them needs.

    Everything is kept in the order of disassembly; `at` turns a place in the order shown into one here.
    """

    assembly: Assembly
    states: States
    """In the order of disassembly, shape (steps + 1, parts)."""
    actions: NDArray[np.int64]
    """Of disassembly, shape (steps,)."""
    holders: NDArray[np.int64]
    """Robot that holds each part in each state, `NO_ROBOT` where none does, shape (steps + 1, parts)."""
    direction: Direction
    """Order in which it is shown."""
    robots: int
    """Robots that there are."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of robots in each step as it is done in assembly, one entry a step; empty where there are none."""

    @classmethod
    def of(
        cls,
        plan: Plan,
        assembly: Assembly,
        direction: Direction | None = None,
        who: NDArray[np.int64] | None = None,
    ) -> Timeline:
        """Return the timeline of a plan.

        Args:
            plan: the plan.
            assembly: its structure.
            direction: order in which it is shown; that of the plan if not given.
            who: robot that holds each part in each state, in the order of disassembly; given out if not given.

        Raises:
            PlanError: the plan is for another structure.
        """
        check_identity(plan, assembly)
        apart = plan if plan.direction is Direction.DISASSEMBLY else plan.reverse()
        # Robots are given out in the order of the plan, so that no held part changes robots on the way.
        if who is None:
            who = holders(plan.states, assembly.immovable)
            who = who if plan.direction is Direction.DISASSEMBLY else who[::-1]
        shown = plan.direction if direction is None else direction
        return cls(assembly, apart.states, apart.actions, who, shown, plan.robots, apart.presses)

    @classmethod
    def from_state(cls, assembly: Assembly, state: ArrayLike, robots: int = 2) -> Timeline:
        """Return the timeline of one state, shape (parts,), in which nothing happens."""
        states = as_states(state, assembly.boundary)[:1]
        who = holders(states, assembly.immovable)
        return cls(assembly, states, np.empty(0, dtype=np.int64), who, Direction.ASSEMBLY, robots)

    def __len__(self) -> int:
        return len(self.actions)

    def turned(self, direction: Direction) -> Timeline:
        """Return the same, shown in the order of assembly or disassembly."""
        return replace(self, direction=direction)

    def at(self, position: float) -> float:
        """Return steps of disassembly done at a place in the order shown; whole numbers are states."""
        position = min(max(float(position), 0.0), float(len(self)))
        return position if self.direction is Direction.DISASSEMBLY else len(self) - position

    def row(self, position: float) -> int:
        """Return the state shown at a place: the last one reached."""
        if self.direction is Direction.DISASSEMBLY:
            return int(np.floor(self.at(position)))
        return int(np.ceil(self.at(position)))

    def presses_at(self, place: int) -> tuple[Press, ...]:
        """Return the presses of the step that leads to a place; robots press in the order of assembly alone."""
        if not self.presses or self.direction is Direction.DISASSEMBLY or not 0 < place <= len(self):
            return ()
        return self.presses[self.row(place)]

    def words(self, step: int) -> str:
        """Describe a step, counted from 0 in the order shown, such as `hold block-3`, with the presses of robots."""
        before, after = self.states[self.row(step)], self.states[self.row(step + 1)]
        names = self.assembly.names
        presses = describe_presses(self.presses_at(step + 1), names)
        return "; ".join(filter(None, (describe_step(before, after, names), presses)))

    def robot_of(self, step: int) -> int:
        """Return the robot that holds the part of a step before or after it, counted from 0; `NO_ROBOT` if none."""
        row, other = self.row(step), self.row(step + 1)
        part = int(self.actions[min(row, other)]) % self.assembly.part_count
        return max(int(self.holders[row, part]), int(self.holders[other, part]))

    @cached_property
    def removal_step(self) -> NDArray[np.int64]:
        """Step of disassembly that removes each part; -1 if none does, -2 if it was never there. Shape (parts,)."""
        parts = self.assembly.part_count
        step = np.where(self.states[0] == REMOVED, -2, -1).astype(np.int64)
        removals = np.flatnonzero(self.actions >= parts)
        step[self.actions[removals] - parts] = removals
        return step

    @cached_property
    def ways(self) -> Array:
        """Unit vector along which each part leaves, zero for those that stay. Shape (parts, 3)."""
        ways = np.zeros((self.assembly.part_count, 3))
        for part in np.flatnonzero(self.removal_step >= 0):
            ways[part] = way_out(self.assembly, self.states[self.removal_step[part]], int(part))
        return ways

    def held_when(self, part: int) -> list[tuple[int, int, int]]:
        """Return robot, first and last state, in the order shown, of every time that the part is held."""
        column = self.holders[:, part]
        if self.direction is Direction.ASSEMBLY:
            column = column[::-1]
        spans: list[tuple[int, int, int]] = []
        for position, robot in enumerate(column.tolist()):
            if robot == NO_ROBOT:
                continue
            if spans and spans[-1][0] == robot and spans[-1][2] == position - 1:
                spans[-1] = (robot, spans[-1][1], position)
            else:
                spans.append((robot, position, position))
        return spans


def holders(states: States, boundary: Mask) -> NDArray[np.int64]:
    """Return the robot that holds each part in each state, `NO_ROBOT` for none; it stays the same during a hold.

    Args:
        states: states one action apart, shape (steps + 1, parts).
        boundary: shape (parts,).

    Returns:
        Shape (steps + 1, parts).
    """
    robots = np.full(states.shape, NO_ROBOT, dtype=np.int64)
    for step, state in enumerate(states):
        held = np.flatnonzero((state == HELD) & ~boundary)
        before = robots[step - 1] if step else np.full(len(state), NO_ROBOT)
        robots[step, held] = before[held]
        free = [robot for robot in range(len(held)) if robot not in robots[step, held]]
        for part, robot in zip([part for part in held if robots[step, part] == NO_ROBOT], free, strict=False):
            robots[step, part] = robot
    return robots


def way_out(assembly: Assembly, state: States, part: int) -> Array:
    """Return the unit vector along which a part can leave a state; shape (3,).

    From the clearance table, or if that is not computed (many parts) or has no direction: away from the parts that it
    touches.
    """
    if assembly.part_count <= EXACT_UP_TO:
        way = assembly.clearance.exit_direction(state, part)
        if way is not None:
            return way
    contacts = assembly.contacts
    present = state != REMOVED
    away = np.zeros(3)
    for side, sign in ((0, -1.0), (1, 1.0)):
        mine = (contacts.parts[:, side] == part) & present[contacts.parts[:, 1 - side]]
        away += sign * (contacts.normals[mine] * contacts.areas[mine, None]).sum(axis=0)
    size = float(np.linalg.norm(away))
    away = away / size if size > 0 else away
    away[2] += UPWARDS
    size = float(np.linalg.norm(away))
    return away / size if size > 1e-9 else np.array([0.0, 0.0, 1.0])


def interesting(timeline: Timeline, frames: int) -> Sequence[int]:
    """Return places spread evenly, each moved to a neighbour where robots press, or else where they hold most."""
    steps = len(timeline)
    chosen = set()
    for position in np.linspace(0, steps, min(frames, steps + 1)).round().astype(int).tolist():
        near = (
            [p for p in (position, position - 1, position + 1) if 0 < p < steps] if 0 < position < steps else [position]
        )
        chosen.add(max(near, key=lambda p: (len(timeline.presses_at(p)), _held(timeline, p))))
    return sorted(chosen)


def _held(timeline: Timeline, place: int) -> int:
    return int((timeline.holders[timeline.row(place)] != NO_ROBOT).sum())
