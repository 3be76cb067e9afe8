"""Several parts in one step: the rule, and the moves that it allows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States, held_count
from falsework.errors import InputError
from falsework.geometry.clearance.locked import LARGEST, PartSet
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Direction, Task
from falsework.stability.settings import StabilitySettings

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


class Together(Protocol):
    """Rule that up to some number of parts may be removed, or inserted, in one step."""

    largest: int
    """Parts of a step at most."""

    def sets(self, movable: Mask) -> tuple[PartSet, ...]:
        """Return the sets of two parts and more, among parts of shape (parts,), that may leave together somewhere."""
        ...

    def leave_together(self, parts: PartSet, states: States, *, apart: bool) -> Mask:
        """Return whether a set, present or not, leaves together from states, shape (batch,).

        Args:
            parts: the set.
            states: shape (batch, parts).
            apart: whether its parts may move along different directions.
        """
        ...

    def carriers(self, parts: PartSet, oracle: Oracle) -> tuple[int, ...]:
        """Return the parts by which one robot can carry a set."""
        ...

    def doubt(self, sets: tuple[PartSet, ...]) -> str:
        """Explain why the absence of a plan would not be proven; empty if it would be."""
        ...


class LockedTogether:
    """Rule that parts of a structure leave together where they lock each other; see `SetClearance`."""

    def __init__(self, assembly: Assembly, largest: int) -> None:
        """Take a structure.

        Args:
            assembly: the structure.
            largest: parts of a step at most.

        Raises:
            InputError: fewer than two parts, or more than can move.
        """
        most = min(int((~assembly.immovable).sum()), LARGEST)
        if not (isinstance(largest, int | np.integer) and 1 < largest <= most):
            raise InputError(
                f"{largest} is not a number of parts of {assembly.name} that can move at once; give 1 (one at a time) "
                f"to {max(most, 1)}"
            )
        self.largest, self._assembly = int(largest), assembly
        self._carriers: dict[tuple[PartSet, StabilitySettings], tuple[int, ...]] = {}

    def sets(self, movable: Mask) -> tuple[PartSet, ...]:
        """Return the sets of parts that may leave together from some state."""
        return self._assembly.clearance_of_sets.sets(movable, self.largest)

    def leave_together(self, parts: PartSet, states: States, *, apart: bool) -> Mask:
        """Return whether a set leaves together from states; see `SetClearance.leave_together`."""
        return self._assembly.clearance_of_sets.leave_together(parts, states, apart=apart)

    def carriers(self, parts: PartSet, oracle: Oracle) -> tuple[int, ...]:
        """Return the parts by which one robot can carry a set, under the settings of an oracle.

        None if no contacts connect the set, or the oracle has no settings.
        """
        from falsework.errors import AssemblyError
        from falsework.stability.carried_group import holds_together

        settings: StabilitySettings | None = getattr(oracle, "settings", None)
        if settings is None:
            return ()
        if (parts, settings) not in self._carriers:
            try:
                found = tuple(part for part in parts if holds_together(self._assembly, parts, part, settings))
            except AssemblyError:
                found = ()
            self._carriers[parts, settings] = found
        return self._carriers[parts, settings]

    def doubt(self, sets: tuple[PartSet, ...]) -> str:
        """Explain why the absence of a plan would not be proven; empty if it would be."""
        return self._assembly.clearance_of_sets.doubt(sets)


class TogetherMoves:
    """Moves of a task with several parts in one step.

    A set that leaves together is either held part by part, each by a robot of its own, and all robots move at the same
    time; or one robot holds one part of it and carries the others, which nothing else holds.
    """

    def __init__(self, task: Task, oracle: Oracle) -> None:
        """Take a task with `Task.together`, and the oracle that judges its states."""
        assert task.together is not None
        self.task, self._rule, self._oracle = task, task.together, oracle
        self.largest = task.together.largest
        self.stop: Callable[[], bool] | None = None
        """Asked before each set; true ends the search for steps with `DeadlineExceeded`."""
        self.removable = ~task.boundary & (task.start != REMOVED) & (task.target == REMOVED)
        self.removable[list(task.fixed)] = False
        self.sets = task.together.sets(self.removable)

    def after(self, state: States, direction: Direction) -> tuple[States, NDArray[np.int64]]:
        """Return the states that one step leads to, stability aside, and the steps as numbers.

        Args:
            state: shape (parts,).
            direction: in disassembly steps lead out of the state; in assembly they are undone.

        Raises:
            DeadlineExceeded: `stop` returned true.

        Returns:
            States, shape (steps, parts); and numbers as in `Plan.actions`, for a set that of one part that is held.
        """
        actions = np.flatnonzero(self.task.moves(state[None], direction)[0])
        single = self.task.follow(np.repeat(state[None], len(actions), axis=0), actions, direction)
        several = list(self._removals(state) if direction is Direction.DISASSEMBLY else self._insertions(state))
        states = np.array([after for after, _ in several], dtype=np.uint8).reshape(-1, len(state))
        inside = self.task.contains(states)
        numbers = np.array([number for _, number in several], dtype=np.int64)
        return np.concatenate([single, states[inside]]), np.concatenate([actions, numbers[inside]])

    @property
    def doubt(self) -> str:
        """Why the absence of a plan would not be proven; empty if it would be."""
        return self.task.doubt or self._rule.doubt(self.sets)

    def _check_time(self) -> None:
        if self.stop is not None and self.stop():
            raise DeadlineExceeded

    def _removals(self, state: States) -> Iterator[tuple[States, int]]:
        for parts in self.sets:
            self._check_time()
            rows = list(parts)
            held = [part for part in parts if state[part] == HELD]
            if not held or len(held) not in (1, len(parts)) or (state[rows] == REMOVED).any():
                continue
            if len(held) == 1 and held[0] not in self._rule.carriers(parts, self._oracle):
                continue
            if self._rule.leave_together(parts, state[None], apart=len(held) == len(parts))[0]:
                after = state.copy()
                after[rows] = REMOVED
                yield after, len(state) + held[0]

    def _insertions(self, state: States) -> Iterator[tuple[States, int]]:
        free = self.task.robots - int(held_count(state[None], self.task.boundary)[0])
        for parts in self.sets if free > 0 else ():
            self._check_time()
            rows = list(parts)
            if (state[rows] != REMOVED).any():
                continue
            if free >= len(parts) and self._rule.leave_together(parts, state[None], apart=True)[0]:
                after = state.copy()
                after[rows] = HELD
                yield after, len(state) + parts[0]
            carriers = self._rule.carriers(parts, self._oracle)
            for carrier in carriers if self._rule.leave_together(parts, state[None], apart=False)[0] else ():
                after = state.copy()
                after[rows] = INSTALLED
                after[carrier] = HELD
                yield after, len(state) + carrier
