"""Moves of a task, with several parts in one step and with repeated holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, held_count
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction, Task
from falsework.search.together.exits import exit_path, sets_of
from falsework.utils.quantity import listed


class TaskMoves:
    """Moves of a task: those of single parts, with repeated holds where they are allowed, and of several in one step.

    A set that leaves together is either held part by part, each by a robot of its own, and all robots move at the same
    time; or one robot holds one part of it and carries the others, which nothing else holds.
    """

    def __init__(self, task: Task, oracle: Oracle) -> None:
        """Take a task and the oracle that judges its states."""
        self.task, self._rule, self._oracle = task, task.together, oracle
        self.again = RegraspMoves(task) if task.allow_regrasp else None
        """Moves of single parts where holds may be repeated."""
        self.stop: Callable[[], bool] | None = None
        """Asked between sets; true ends the search for steps with `DeadlineExceeded`."""
        self.removable = ~task.boundary & (task.start != REMOVED) & (task.target == REMOVED)
        self.removable[list(task.fixed)] = False
        self.sets, self._left_out = sets_of(task, self.removable)
        self._bare = task.part_count - len(task.props)

    @property
    def largest(self) -> int:
        """Parts of a step at most."""
        return 1 if self._rule is None else self._rule.largest

    def after(self, states: States, direction: Direction) -> tuple[NDArray[np.int64], States, NDArray[np.int64]]:
        """Return the states that one step leads to, stability aside, and the steps as numbers.

        Args:
            states: shape (batch, parts).
            direction: in disassembly steps lead out of the states; in assembly they are undone.

        Raises:
            DeadlineExceeded: `stop` returned true.

        Returns:
            Row of the state that each step leads from, ascending, shape (steps,); states, shape (steps, parts); and
            numbers as in `Plan.actions`, for a set that of one part that is held.
        """
        if self.again is not None:
            row, actions = np.nonzero(self.again.legal(states, direction))
            single = self.again.follow(states[row], actions)
        else:
            row, actions = np.nonzero(self.task.moves(states, direction))
            single = self.task.follow(states[row], actions, direction)
        if not self.sets:
            return row, single, actions
        several = self.removals if direction is Direction.DISASSEMBLY else self._insertions
        found = [(number, to, action) for number, state in enumerate(states) for to, action in several(state)]
        after = np.array([to for _, to, _ in found], dtype=np.uint8).reshape(-1, self.task.part_count)
        inside = self.task.contains(after) if self.again is None else np.ones(len(after), dtype=bool)
        rows, numbers = (np.array([entry[k] for entry in found], dtype=np.int64)[inside] for k in (0, 2))
        row = np.concatenate([row, rows])
        order = np.argsort(row, kind="stable")
        steps = np.concatenate([single, after[inside]]), np.concatenate([actions, numbers])
        return row[order], steps[0][order], steps[1][order]

    @property
    def caveat(self) -> str:
        """Why the absence of a plan would not be proven; empty if it would be."""
        return self.task.caveat or (
            "" if self._rule is None else self._left_out or self._rule.clearance.caveat(self.sets)
        )

    def first_motions(self, state: States) -> str:
        """Say which parts, and sets of parts that lock each other, can begin to move in a state, shape (parts,)."""
        assert self._rule is not None
        there = np.flatnonzero((state != REMOVED) & self.removable)
        sets = [(part,) for part in there.tolist()] + [parts for parts in self.sets if np.isin(parts, there).all()]
        movable = [parts for parts in sets if self._rule.clearance.can_begin_to_move(parts, state)]
        if not movable:
            return f"no part there, and no set of up to {self.largest}, can begin to move, not even by turning"
        names = listed([self._rule.name(parts) for parts in movable])
        return f"what can begin to move there finds no straight way out: {names}"

    def removals(self, state: States) -> Iterator[tuple[States, int]]:
        """Yield the states that the removal of a set leads to, with the number of the step; of parts on no prop.

        Args:
            state: shape (parts,).

        Raises:
            DeadlineExceeded: `stop` returned true.
        """
        if self._rule is None:
            return
        propped = {part for part, prop in zip(self.task.props, state[self._bare :], strict=True) if prop != REMOVED}
        for parts in self.sets:
            if self.stop is not None and self.stop():
                raise DeadlineExceeded
            rows = list(parts)
            held = [part for part in parts if state[part] == HELD]
            allowed = (1, len(parts)) if self._rule.each_held else (1,)
            if len(held) not in allowed or (state[rows] == REMOVED).any() or propped & set(parts):
                continue
            if len(held) == 1 and held[0] not in self._rule.carriers(parts, self._oracle):
                continue
            if exit_path(self.task, state, parts) is not None:
                after = state.copy()
                after[rows] = REMOVED
                yield after, len(state) + held[0]

    def _insertions(self, state: States) -> Iterator[tuple[States, int]]:
        if self._rule is None:
            return
        moving = np.arange(len(state)) < self._bare  # props are no parts that robots hold
        free = self.task.robots - int(held_count(state[None], self.task.boundary | ~moving)[0])
        for parts in self.sets if free > 0 else ():
            if self.stop is not None and self.stop():
                raise DeadlineExceeded
            rows = list(parts)
            if (state[rows] != REMOVED).any():
                continue
            if self._rule.each_held and free >= len(parts):
                after = state.copy()
                after[rows] = HELD
                if exit_path(self.task, after, parts) is not None:
                    yield after, len(state) + parts[0]
            leaves = None  # the same by whichever part they are carried
            for carrier in self._rule.carriers(parts, self._oracle):
                after = state.copy()
                after[rows] = INSTALLED
                after[carrier] = HELD
                if leaves is None:
                    leaves = exit_path(self.task, after, parts) is not None
                if not leaves:
                    break
                yield after, len(state) + carrier


def graph_with_sets(task: Task, oracle: Oracle, states: States, *, name: str = "") -> StateGraph:
    """Connect stable states by every step that a task allows, those of several parts included; see `StateGraph`.

    Args:
        task: rules between start and target, `judged_by` the oracle.
        oracle: found the states stable, and says by which parts a robot can carry others.
        states: shape (count, parts).
    """
    several = None if task.together is None else TaskMoves(task, oracle).removals
    return StateGraph.from_states(task, states, name=name, several=several)
