"""Moves of a task with several parts in one step."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, held_count
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction, Task
from falsework.utils.quantity import listed

_EVERY = 0.2
"""Seconds between two questions whether to stop."""


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
        """Asked between sets; true ends the search for steps with `DeadlineExceeded`."""
        self._asked = time.perf_counter()
        self.removable = ~task.boundary & (task.start != REMOVED) & (task.target == REMOVED)
        self.removable[list(task.fixed)] = False
        self.sets = task.together.sets(self.removable)
        self._bare = task.part_count - len(task.props)

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
        several = list(self.removals(state) if direction is Direction.DISASSEMBLY else self._insertions(state))
        states = np.array([after for after, _ in several], dtype=np.uint8).reshape(-1, len(state))
        inside = self.task.contains(states)
        numbers = np.array([number for _, number in several], dtype=np.int64)
        return np.concatenate([single, states[inside]]), np.concatenate([actions, numbers[inside]])

    @property
    def caveat(self) -> str:
        """Why the absence of a plan would not be proven; empty if it would be."""
        return self.task.caveat or self._rule.caveat(self.sets)

    def first_motions(self, state: States) -> str:
        """Say which parts, and sets of parts that lock each other, can begin to move in a state, shape (parts,)."""
        there = np.flatnonzero((state != REMOVED) & self.removable)
        sets = [(part,) for part in there.tolist()] + [parts for parts in self.sets if np.isin(parts, there).all()]
        movable = [parts for parts in sets if self._rule.can_begin_to_move(parts, state)]
        if not movable:
            return f"no part there, and no set of up to {self.largest}, can begin to move, not even by turning"
        names = listed([self._rule.name(parts) for parts in movable])
        return f"what can begin to move there finds no straight way out: {names}"

    def _check_time(self) -> None:
        """Ask whether to stop, a few times a second: searches that take turns count how often they ask."""
        now = time.perf_counter()
        if self.stop is None or now - self._asked < _EVERY:
            return
        self._asked = now
        if self.stop():
            raise DeadlineExceeded

    def removals(self, state: States) -> Iterator[tuple[States, int]]:
        """Yield the states that the removal of a set leads to, with the number of the step; of parts on no prop.

        Args:
            state: shape (parts,).

        Raises:
            DeadlineExceeded: `stop` returned true.
        """
        propped = {part for part, prop in zip(self.task.props, state[self._bare :], strict=True) if prop != REMOVED}
        for parts in self.sets:
            self._check_time()
            rows = list(parts)
            held = [part for part in parts if state[part] == HELD]
            allowed = (1, len(parts)) if self._rule.each_held else (1,)
            if len(held) not in allowed or (state[rows] == REMOVED).any() or propped & set(parts):
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
            if (
                self._rule.each_held
                and free >= len(parts)
                and self._rule.leave_together(parts, state[None], apart=True)[0]
            ):
                after = state.copy()
                after[rows] = HELD
                yield after, len(state) + parts[0]
            carriers = self._rule.carriers(parts, self._oracle)
            for carrier in carriers if self._rule.leave_together(parts, state[None], apart=False)[0] else ():
                after = state.copy()
                after[rows] = INSTALLED
                after[carrier] = HELD
                yield after, len(state) + carrier


def graph_with_sets(task: Task, oracle: Oracle, states: States, *, name: str = "") -> StateGraph:
    """Connect stable states by every step that a task allows, those of several parts included; see `StateGraph`.

    Args:
        task: rules between start and target, `judged_by` the oracle.
        oracle: found the states stable, and says by which parts a robot can carry others.
        states: shape (count, parts).
        name: name of the structure.
    """
    several = None if task.together is None else TogetherMoves(task, oracle).removals
    return StateGraph.from_states(task, states, name=name, several=several)
