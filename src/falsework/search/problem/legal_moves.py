"""Legal moves between the states of a task, on arrays and on tensors alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from falsework.assembly.state import HELD, INSTALLED, REMOVED

Array = Any
"""Array of numpy or tensor of torch."""


@dataclass(frozen=True, eq=False)
class LegalMoves:
    """Rules of a task in one direction, stability aside.

    Only operations are used that numpy and torch have in common, so that one implementation serves both.
    """

    space: str
    """Module of the arrays: `numpy` or `torch`."""
    backward: bool
    """Whether moves are those of assembly, which undo those of disassembly."""
    robots: int
    """Parts that may be held at a time."""
    loose: Array
    """Parts that are not boundary, shape (parts,)."""
    touchable: Array
    """Of these, parts that are not fixed, shape (parts,)."""
    goal: Array
    """State to be reached, shape (parts,)."""
    keeps: bool
    """Whether robots hold parts in that."""
    can_leave: Callable[[Array, Array], Array] | None
    """Returns which parts of states, of those asked for, have a free exit, shape (batch, parts); None where that does
    not matter."""
    missing: Array
    """Numbers of the missing parts."""
    postponed: Array
    """Steps of assembly before each of them is inserted, ascending; empty where none has to wait."""
    steps: int
    """Of a whole plan."""
    begun: int
    """Steps of disassembly that the start has behind it."""

    def legal(self, states: Array, goals: Array | None = None) -> Array:
        """Return the actions that are allowed from each state.

        Args:
            states: shape (batch, parts).
            goals: state to be reached from each, shape (batch, parts), instead of the common one.

        Returns:
            Shape (batch, 2 parts); `[:, i]` hold part `i`, `[:, parts + i]` remove part `i`, or undo that.
        """
        # Assembly mirrors disassembly: installed and removed change places, and so do insert and remove.
        before, after = (REMOVED, INSTALLED) if self.backward else (INSTALLED, REMOVED)
        goal = self.goal if goals is None else goals
        held, goes = (states == HELD) & self.loose, goal == after
        idle = held.sum(axis=1) < self.robots
        take = (states == before) & idle[:, None] & self.touchable & (goal != before)
        give = held & self.touchable & goes
        if self.keeps or goals is not None:
            # A robot that holds a part to the end is not available for the rest: the last robot must stay free.
            kept = (goal == HELD) & self.loose
            last = (held & kept).sum(axis=1) + 1 >= self.robots
            waiting = (goes & (states != after)).any(axis=1)
            take = take & ~(kept & (last & waiting)[:, None])
        hold, remove = (give, take) if self.backward else (take, give)
        if self.can_leave is not None:
            remove = remove & self.can_leave(states, remove)
        space = import_module(self.space)
        mask = space.concatenate([hold, remove], axis=1)
        if len(self.postponed):
            step = 1 if self.backward else -1
            moved = space.zeros_like(mask[0])
            moved[len(self.loose) + self.missing] = True
            present = (states[:, self.missing] != REMOVED).sum(axis=1)[:, None] + step * (moved * 1)
            mask = mask & (present <= self.missing_allowed(states, step)[:, None])
        return mask

    def missing_allowed(self, states: Array, offset: int) -> Array:
        """Return how many missing parts may be present `offset` assembly steps after each state, shape (batch,)."""
        stage = 2 * (states == REMOVED).sum(axis=1) + (states == HELD).sum(axis=1)
        return (self.postponed[None] < (self.steps + self.begun - stage + offset)[:, None]).sum(axis=1)
