"""Distinct successor states of a beam level, expanded lazily."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States, held_count
from falsework.search.problem.hashing import StateHash, StateIndex, chunks, merge
from falsework.search.problem.task import Direction, Task

Rows = NDArray[np.int64]


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
    """Sum of the guide's scores on the path, shape (kept,)."""
    grounded: NDArray[np.int8]
    """1 where the state and all on the path to it are known to be stable, -1 where one is not, 0 where the verdict of
    a fixed part waits; shape (kept,)."""

    def state(self, row: int) -> States:
        """Return a copy of one state, shape (parts,)."""
        return self.states[row].copy()


class PackedLevel:
    """Level of which one state is stored, and what is different in the others."""

    def __init__(self, level: Level) -> None:
        """Pack a level."""
        self.parent, self.action, self.score, self.grounded = level.parent, level.action, level.score, level.grounded
        self._first = level.states[0].copy()
        row, part = np.divmod(np.flatnonzero(level.states != self._first), len(self._first))
        self._row, self._part = row.astype(np.int32), part.astype(np.int32)
        self._value = level.states[row, part]

    @property
    def states(self) -> States:
        """States written down, shape (kept, parts)."""
        states = np.repeat(self._first[None], len(self.parent), axis=0)
        states[self._row, self._part] = self._value
        return states

    def state(self, row: int) -> States:
        """Return one state, shape (parts,), without writing the others down."""
        state, own = self._first.copy(), self._row == row
        state[self._part[own]] = self._value[own]
        return state

    @property
    def size(self) -> int:
        """Bytes that the states take."""
        return self._first.nbytes + self._row.nbytes + self._part.nbytes + self._value.nbytes


def pack(level: Level | PackedLevel) -> Level | PackedLevel:
    """Return a level, packed if it takes less than half of the memory: states of narrow beams are mostly alike."""
    if isinstance(level, PackedLevel):
        return level
    packed = PackedLevel(level)
    return packed if 2 * packed.size < level.states.nbytes else level


@dataclass(frozen=True, eq=False)
class Frontier:
    """Distinct states that one move leads to from the states of a level.

    A candidate is named by its number among all moves of the level, `row of the level * 2 parts + action`, so that
    nothing needs to be stored for each.
    """

    task: Task
    direction: Direction
    level: States
    """Shape (level, parts)."""
    legal: Mask
    """Moves that the rules allow, shape (level, 2 parts)."""
    moves: Mask
    """The first of them that leads to each candidate, shape (level, 2 parts)."""
    fixing: Mask
    """Candidates that a move which fixes a part leads to, shape (level, 2 parts)."""

    @cached_property
    def _count(self) -> int:
        return int(np.count_nonzero(self.moves))

    def __len__(self) -> int:
        return self._count

    def candidates(self) -> Rows:
        """Return all candidates, ascending."""
        return np.flatnonzero(self.moves)

    def without(self, rows: NDArray[np.int64], actions: NDArray[np.int64]) -> bool:
        """Leave some moves of states of the level out; return whether there were any."""
        self.fixing[rows, actions] = False
        left_out = self.moves[rows, actions].any()
        self.moves[rows, actions] = False
        return bool(left_out)

    def without_states(self, states: StateIndex, state_hash: StateHash) -> bool:
        """Leave some states that need no verdict out; return whether there were any."""
        free = self.candidates()
        free = free[self.free(free)]
        row, part = self.parent(free), self.part(free)
        value = self.task.moved_value(self.action(free), self.direction)
        hashes = state_hash.after(state_hash(self.level)[row], part, self.level[row, part], value)
        out = free[states.find_hashed(hashes, lambda some: self.states(free[some])) >= 0]
        return bool(len(out)) and self.without(self.parent(out), self.action(out))

    def parent(self, rows: Rows) -> NDArray[np.int64]:
        """Return the rows of `level` that candidates come from, shape (rows,)."""
        return rows // self.moves.shape[1]

    def action(self, rows: Rows) -> NDArray[np.int64]:
        """Return the actions that lead to candidates, shape (rows,)."""
        return rows % self.moves.shape[1]

    def part(self, rows: Rows) -> NDArray[np.int64]:
        """Return the parts that move, shape (rows,)."""
        return rows % self.level.shape[1]

    def fixes(self, rows: Rows) -> Mask:
        """Return which candidates a move that fixes a part leads to, shape (rows,)."""
        return self.fixing.ravel()[rows]

    def free(self, rows: Rows) -> Mask:
        """Return which candidates are stable because the level is, shape (rows,)."""
        return self.fixes(rows) & self.task.holds_keep_stable

    def states(self, rows: Rows) -> States:
        """Return candidates written down, shape (rows, parts)."""
        return self.task.follow(self.level[self.parent(rows)], self.action(rows), self.direction)

    @cached_property
    def held_before(self) -> NDArray[np.int64]:
        """Parts that robots hold in each state of the level, shape (level,)."""
        return held_count(self.level, self.task.boundary)

    def held(self, rows: Rows) -> NDArray[np.int64]:
        """Return parts that robots hold in candidates, shape (rows,)."""
        holds = self.task.moved_value(self.action(rows), self.direction) == HELD
        return self.held_before[self.parent(rows)] + np.where(holds, 1, -1)


def expand(task: Task, direction: Direction, level: States, state_hash: StateHash) -> Frontier:
    """Return every legal move from every state of a level; states reached twice are kept once, dead ends not at all.

    Args:
        level: distinct stable states, all the same number of steps from the start, shape (level, parts).
    """
    legal = task.moves(level, direction)
    parent, action = np.nonzero(legal)
    first = place = np.arange(len(action))
    if len(level) > 1:  # moves of one state never lead to the same
        part = action % task.part_count
        value = task.moved_value(action, direction)
        hashes = state_hash.after(state_hash(level)[parent], part, level[parent, part], value)
        first, place = merge(hashes, lambda rows: task.follow(level[parent[rows]], action[rows], direction))
    fixed = first[place[task.fixes(action, direction)]]
    moves, fixing = np.zeros_like(legal), np.zeros_like(legal)
    moves[parent[first], action[first]] = fixing[parent[fixed], action[fixed]] = True
    frontier = Frontier(task, direction, level, legal, moves, fixing)
    if task.clearance is not None and direction is Direction.ASSEMBLY:
        candidates = frontier.candidates()
        for piece in chunks(len(candidates)):
            rows = candidates[piece]
            dead = rows[task.dead_ends(frontier.states(rows), direction)]
            moves.ravel()[dead] = fixing.ravel()[dead] = False
    return frontier
