"""Timeline of a plan: states, holders, and the displacement of each part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import REMOVED, States, as_states
from falsework.geometry.clearance.moves import ExitPath, PathMove, on_the_way, part_way
from falsework.search.plans.plan_check import check_identity
from falsework.search.plans.steps import NO_ROBOT, PlanStep, holders, moved_parts, steps_of, undone
from falsework.search.problem.task import Direction
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.holds import HoldLoad, Press, describe_loads, robot_number
from falsework.stability.verdict import Verdict

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Array = NDArray[np.float64]

EXACT_UP_TO = 150
"""Parts up to which exit directions are taken from the clearance table; above, computing it takes too long for a
viewer."""
UPWARDS = 0.35
"""Upward component of an estimated exit direction."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """States one action apart, with the data that a picture of them needs.

    Everything is in the order of assembly. A place is the number of steps that are done, in whichever order the steps
    are shown; between whole numbers a step is under way.
    """

    assembly: Assembly
    states: States
    """In the order of assembly, shape (steps + 1, parts)."""
    actions: NDArray[np.int64]
    """As in `Plan.actions`, shape (steps,)."""
    holders: NDArray[np.int64]
    """Robot that holds each part in each state, `NO_ROBOT` where none does, shape (steps + 1, parts)."""
    direction: Direction
    """Order in which the steps are shown; in disassembly the last one is undone first."""
    robots: int
    """Robots that there are."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of robots in each step, one entry a step; empty where there are none."""
    verdicts: tuple[Verdict, ...] = ()
    """On the states, one each; empty where none are known."""
    loads: Loads = ()
    """What robots bear in each state; empty where it is not known."""
    exit_paths: tuple[ExitPath, ...] = ()
    """As `Plan.exit_paths`."""
    robot_names: tuple[str, ...] = ()
    """Of the arms of a cell; empty where robots have numbers alone."""

    @classmethod
    def from_plan(
        cls,
        plan: Plan,
        assembly: Assembly,
        direction: Direction = Direction.ASSEMBLY,
        who: NDArray[np.int64] | None = None,
        robot_names: tuple[str, ...] = (),
    ) -> Timeline:
        """Return the timeline of a plan.

        Args:
            direction: order in which it is shown.
            who: robot that holds each part in each state; as in `Plan.holders` if not given.
            robot_names: of the arms, if any.

        Raises:
            PlanError: the plan is for another structure.
        """
        check_identity(plan, assembly)
        who = plan.holders if who is None else who
        presses, loads = plan.presses, plan.loads
        more = presses, plan.verdicts, loads, plan.exit_paths, robot_names
        return cls(assembly, plan.states, plan.actions, who, direction, plan.robots, *more)

    @classmethod
    def from_state(cls, assembly: Assembly, state: ArrayLike, robots: int = 2) -> Timeline:
        """Return the timeline of one state, shape (parts,), in which nothing happens."""
        states = as_states(state, assembly.boundary)[:1]
        who = holders(states, assembly.immovable)
        return cls(assembly, states, np.empty(0, dtype=np.int64), who, Direction.ASSEMBLY, robots)

    def __len__(self) -> int:
        return len(self.actions)

    def going_on(self, place: int, plan: Plan) -> Timeline:
        """Return the steps up to a place and those of a plan from there on, numbered through.

        The plan may begin in another state than that of the place: what was found on site.
        """
        states = np.concatenate([self.states[:place], plan.states])
        presses = (*(self.presses or ((),) * len(self))[:place], *(plan.presses or ((),) * len(plan)))
        known = self.verdicts or (Verdict.UNDECIDED,) * len(self.states)
        loads = (*(self.loads or ((),) * len(self.states))[:place], *(plan.loads or ((),) * len(plan.states)))
        paths = (*(self.exit_paths or ((),) * len(self))[:place], *(plan.exit_paths or ((),) * len(plan)))
        return replace(
            self,
            states=states,
            actions=np.concatenate([self.actions[:place], plan.actions]),
            holders=holders(states, self.assembly.immovable),
            robots=plan.robots,
            presses=presses if any(presses) else (),
            verdicts=(*known[:place], *plan.verdicts),
            loads=loads if any(loads) else (),
            exit_paths=paths if any(paths) else (),
        )

    def with_places(self, assembly: Assembly) -> Timeline:
        """Return the same steps of a structure with more places for props, as its last parts, which they do not use."""
        more = assembly.part_count - self.assembly.part_count
        if not more:
            return self
        states, parts = np.pad(self.states, ((0, 0), (0, more))), self.assembly.part_count
        who = np.pad(self.holders, ((0, 0), (0, more)), constant_values=NO_ROBOT)
        actions = np.where(self.actions >= parts, self.actions + more, self.actions)
        return replace(self, assembly=assembly, states=states, actions=actions, holders=who)

    def turned(self, direction: Direction) -> Timeline:
        """Return the same, shown in the order of assembly or disassembly."""
        return replace(self, direction=direction)

    @property
    def begin(self) -> int:
        """Place that is shown first."""
        return 0 if self.direction is Direction.ASSEMBLY else len(self)

    @property
    def end(self) -> int:
        """Place that is shown last."""
        return len(self) - self.begin

    @property
    def places(self) -> range:
        """All places, in the order shown."""
        return range(len(self) + 1) if self.direction is Direction.ASSEMBLY else range(len(self), -1, -1)

    def row(self, position: float) -> int:
        """Return the state shown at a place: the last one reached."""
        return self._whole(position, np.floor if self.direction is Direction.ASSEMBLY else np.ceil)

    def next(self, position: float) -> int:
        """Return the place that the step under way leads to; a whole place itself."""
        return self._whole(position, np.ceil if self.direction is Direction.ASSEMBLY else np.floor)

    def _whole(self, position: float, rounded: np.ufunc) -> int:
        return int(rounded(min(max(float(position), 0.0), float(len(self)))))

    def robot_name(self, robot: int) -> str:
        """Return the name of a robot, counted from 0: that of the cell, or such as `R1`."""
        return self.robot_names[robot] if robot < len(self.robot_names) else robot_number(robot)

    def loads_at(self, place: int) -> tuple[HoldLoad, ...]:
        """Return what robots bear in the state at a place; empty where it is not known."""
        return self.loads[self.row(place)] if self.loads else ()

    def loads_text(self, place: int) -> str:
        """Describe what robots bear in the state at a place; empty where it is not known."""
        return describe_loads(self.loads_at(place), self.assembly.names, self.holders[self.row(place)], self.robot_name)

    @cached_property
    def steps(self) -> tuple[PlanStep, ...]:
        """Steps in the order shown, with their robots."""
        verdicts = self.verdicts or (Verdict.UNDECIDED,) * len(self.states)
        names = tuple(self.assembly.names)
        steps = steps_of(self.states, self.actions, self.holders, verdicts, names, self.presses)
        return steps if self.direction is Direction.ASSEMBLY else undone(steps, self.states[0], verdicts[0])

    def step_to(self, place: int) -> PlanStep | None:
        """Return the step that leads to a place in the order shown; None for the place that is shown first."""
        return None if place == self.begin else self.steps[abs(place - self.begin) - 1]

    def label(self, place: int) -> str:
        """Describe the step that leads to a place, such as `step 30 of 56: insert block-3 (R1)`."""
        step = self.step_to(place)
        if step is None:
            return f"step 0 of {len(self)}" if self.direction is Direction.ASSEMBLY else f"all {len(self)} steps done"
        return f"step {step.number} of {len(self)}: {step.told(self.robot_name)}"

    def presses_at(self, place: int) -> tuple[Press, ...]:
        """Return the presses of the step that leads to a place; robots press in assembly alone."""
        step = self.step_to(place) if self.presses else None
        return () if step is None else step.presses

    @cached_property
    def insertion(self) -> NDArray[np.int64]:
        """Number of the step that inserts each part; 0 if it is there before, -1 if it never is. Shape (parts,)."""
        there = self.states != REMOVED
        return np.where(there.any(axis=0), there.argmax(axis=0), -1)

    @cached_property
    def exit_directions(self) -> Array:
        """Unit vector along which each part leaves at last, zero for those that stay. Shape (parts, 3)."""
        ways = np.zeros((self.assembly.part_count, 3))
        for part in np.flatnonzero(self.insertion > 0).tolist():
            step = int(self.insertion[part])
            if self.path_of(part):
                ways[part] = self.path_of(part)[-1].direction
                continue
            moved, _ = moved_parts(self.states[step - 1], self.states[step])
            ways[part] = exit_directions(self.assembly, self.states[step], moved)[moved.index(part)]
        return ways

    def path_of(self, part: int) -> ExitPath:
        """Return the moves in which a part leaves; none where it leaves in a straight line, or stays."""
        step = int(self.insertion[part])
        return self.exit_paths[step - 1] if self.exit_paths and step > 0 else ()

    def displacements(self, part: int, share: float, far: float) -> dict[int, Array]:
        """Return where a part, and those that move aside for it, are after a share of its way out.

        The last move of the part is shown for so many metres at most; then the others go back.

        Returns:
            Displacements from their places, shape (4, 4) each, by part.
        """
        path = self.path_of(part)
        if path:
            if (part, far) not in self._shown:
                self._shown[part, far] = on_the_way(path, lambda one: self.assembly.meshes[one].vertices, far)
            return {part: np.eye(4), **part_way(self._shown[part, far], share)}
        matrix = np.eye(4)
        matrix[:3, 3] = far * share * self.exit_directions[part]
        return {part: matrix}

    @cached_property
    def _shown(self) -> dict[tuple[int, float], list[tuple[float, PathMove]]]:
        """Ways as they are shown, by part and length of the last move."""
        return {}

    def held_when(self, part: int) -> list[tuple[int, int, int]]:
        """Return robot, first and last state of every time that the part is held."""
        column = self.holders[:, part]
        spans: list[tuple[int, int, int]] = []
        for position, robot in enumerate(column.tolist()):
            if robot == NO_ROBOT:
                continue
            if spans and spans[-1][0] == robot and spans[-1][2] == position - 1:
                spans[-1] = (robot, spans[-1][1], position)
            else:
                spans.append((robot, position, position))
        return spans


def exit_directions(assembly: Assembly, state: States, parts: Sequence[int]) -> Array:
    """Return the unit vectors along which parts that move in one step can leave a state, shape (parts, 3)."""
    if len(parts) > 1:
        order = sorted(parts)
        motion = assembly.clearance_of_sets.exit_motion(tuple(order), state)
        if motion is not None:
            return motion[[order.index(part) for part in parts]]
    return np.array([exit_direction_of(assembly, state, part) for part in parts])


def exit_direction_of(assembly: Assembly, state: States, part: int, *, exact_up_to: int = EXACT_UP_TO) -> Array:
    """Return the unit vector along which a part can leave a state; shape (3,).

    From the clearance table, or if that is not computed (more than `exact_up_to` parts) or has no direction: away from
    the parts that it touches.
    """
    if assembly.part_count <= exact_up_to:
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
    return sorted(chosen, reverse=timeline.direction is Direction.DISASSEMBLY)


def _held(timeline: Timeline, place: int) -> int:
    return int((timeline.holders[timeline.row(place)] != NO_ROBOT).sum())
