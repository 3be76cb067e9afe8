"""Distinct successor states of a beam level, expanded lazily."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States, held_count
from falsework.search.problem.hashing import Hashes, StateHash, merge
from falsework.search.problem.task import Direction, Task

_CHUNK_STATES = 4096
_WORTH_PACKING = 16_384
"""Bytes of states from which a level is packed."""


@dataclass(frozen=True, eq=False)
class Level:
    """States that a beam kept the same number of steps away from its origin."""

    states: States
    """Shape (kept, parts)."""
    parent: NDArray[np.int64]
    """Row of the level before, shape (kept,)."""
    action: NDArray[np.int64]
    """Shape (kept,)."""
    score: NDArray[np.float64]
    """Sum of the guide's scores on the way, shape (kept,)."""
    grounded: NDArray[np.int8]
    """1 where the state and all on the way to it are known to be stable, -1 where one is not, 0 where the verdict of
    a fixed part waits; shape (kept,)."""


class PackedLevel:
    """Level of which one state is stored, and what is different in the others."""

    def __init__(self, level: Level) -> None:
        """Pack a level."""
        self.parent, self.action, self.score, self.grounded = level.parent, level.action, level.score, level.grounded
        self._first = level.states[0].copy()
        row, part = np.nonzero(level.states != self._first)
        self._row, self._part = row.astype(np.int32), part.astype(np.int32)
        self._value = level.states[row, part]

    @property
    def states(self) -> States:
        """States written down, shape (kept, parts)."""
        states = np.repeat(self._first[None], len(self.parent), axis=0)
        states[self._row, self._part] = self._value
        return states

    @property
    def size(self) -> int:
        """Bytes that the states take."""
        return self._first.nbytes + self._row.nbytes + self._part.nbytes + self._value.nbytes


def pack(level: Level | PackedLevel) -> Level | PackedLevel:
    """Return a level, packed if it takes less than half of the memory: states of narrow beams are mostly alike."""
    if isinstance(level, PackedLevel) or level.states.nbytes < _WORTH_PACKING:
        return level
    packed = PackedLevel(level)
    return packed if 2 * packed.size < level.states.nbytes else level


@dataclass(frozen=True, eq=False)
class Frontier:
    """Distinct states that one move leads to from the states of a level."""

    task: Task
    direction: Direction
    level: States
    """Shape (level, parts)."""
    parent: NDArray[np.int64]
    """Row of `level` that each candidate comes from, shape (candidates,)."""
    action: NDArray[np.int64]
    """Shape (candidates,)."""
    hashes: Hashes
    """Shape (candidates,)."""
    fixing: Mask
    """Candidates that a move which fixes a part leads to, shape (candidates,)."""

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def free(self) -> Mask:
        """Candidates that are stable because the level is, shape (candidates,)."""
        return self.fixing & self.task.holds_keep_stable

    def states(self, rows: NDArray[np.integer] | slice = slice(None)) -> States:
        """Return candidates written down, shape (rows, parts)."""
        return self.task.follow(self.level[self.parent[rows]], self.action[rows], self.direction)

    def parents(self, rows: NDArray[np.integer] | slice = slice(None)) -> States:
        """Return states of the level that the candidates come from, shape (rows, parts)."""
        return self.level[self.parent[rows]]

    def held(self) -> NDArray[np.int64]:
        """Return parts that robots hold in each candidate, shape (candidates,)."""
        before = held_count(self.level, self.task.boundary)[self.parent]
        holds = self.task.moved_value(self.action, self.direction) == HELD
        return before + np.where(holds, 1, -1)


def expand(task: Task, direction: Direction, level: States, hashes: Hashes, state_hash: StateHash) -> Frontier:
    """Return every legal move from every state of a level; states reached twice are kept once, dead ends not at all.

    Args:
        task: rules of the search.
        direction: which way to move.
        level: stable states, all the same number of steps from the start, shape (level, parts).
        hashes: their hashes, shape (level,).
        state_hash: how hashes are made.
    """
    parent, action = np.nonzero(task.moves(level, direction))
    part = action % task.part_count
    old = level[parent, part]
    new = task.moved_value(action, direction)
    child = state_hash.after(hashes[parent], part, old, new)

    def rows(index: NDArray[np.intp]) -> States:
        return task.follow(level[parent[index]], action[index], direction)

    first, position = merge(child, rows)
    fixing = np.zeros(len(first), dtype=bool)
    fixing[position[task.fixes(action, direction)]] = True
    frontier = Frontier(task, direction, level, parent[first], action[first], child[first], fixing)
    return frontier if task.clearance is None else _without_dead_ends(frontier)


def _without_dead_ends(frontier: Frontier) -> Frontier:
    count = len(frontier)
    dead = np.zeros(count, dtype=bool)
    for begin in range(0, count, _CHUNK_STATES):
        rows = slice(begin, begin + _CHUNK_STATES)
        dead[rows] = frontier.task.dead_ends(frontier.states(rows), frontier.direction)
    return replace(
        frontier,
        parent=frontier.parent[~dead],
        action=frontier.action[~dead],
        hashes=frontier.hashes[~dead],
        fixing=frontier.fixing[~dead],
    )
