"""Moves with repeated holds and props."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.search.problem.task import Direction, Task


class RegraspMoves:
    """Moves of a task with repeated holds: an action changes whether a part is held, or whether it is present.

    Action `i` holds or releases part `i`, and `parts + i` removes it; in assembly it inserts it. A held part can be
    released without being removed, and held again later; a robot that takes over a hold does so before the other
    releases, since each is a step of its own. A prop needs no robot: it is present, which is written as held, or
    absent. It can be placed under a present part only.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.parts = task.part_count
        self._props = np.arange(self.parts - len(task.props), self.parts)
        touched = ~task.boundary
        touched[list(task.fixed)] = False
        touched[self._props] = False
        self._holdable = touched & (task.start != REMOVED)
        self._removable = touched & (task.start != REMOVED) & (task.target == REMOVED)
        self._counted = ~task.boundary
        self._counted[self._props] = False

    @cached_property
    def removals(self) -> int:
        """Parts that every plan removes."""
        return int(self._removable.sum())

    def held(self, states: States) -> NDArray[np.int64]:
        """Return the number of parts that robots hold, shape (batch,)."""
        return ((states == HELD) & self._counted).sum(axis=-1)

    def burden(self, states: States) -> NDArray[np.int64]:
        """Return the number of held parts, and of props that are not under held parts, shape (batch,)."""
        props, above = states[..., self._props] != REMOVED, states[..., list(self.task.props)]
        return self.held(states) + (props & (above != HELD)).sum(axis=-1)

    def removed(self, states: States) -> NDArray[np.int64]:
        """Return the number of parts removed since the start, shape (batch,)."""
        return ((states == REMOVED) & self._removable).sum(axis=-1)

    def legal(self, states: States, direction: Direction) -> Mask:
        """Return the actions that the rules allow from each state, stability aside, shape (batch, 2 parts)."""
        task, props = self.task, self._props
        free = (self.held(states) < task.robots)[:, None]
        held = self._holdable & (states == HELD)
        change = held | (self._holdable & (states == INSTALLED) & free)
        bare = np.ones_like(held)  # parts without a prop below, which a robot may then remove
        under, there = np.asarray(task.props, dtype=np.int64), states[:, props] != REMOVED
        for prop in range(len(props)):
            bare[:, under[prop]] &= ~there[:, prop]
        room = (there.sum(axis=1) < task.prop_limit)[:, None]
        if direction is Direction.DISASSEMBLY:
            presence = self._removable & held & bare
        else:
            presence = self._removable & (states == REMOVED) & free
        if task.clearance is not None:
            presence &= task.clearance.can_leave(states, presence)
        presence[:, props] = there | (room & (states[:, under] != REMOVED))
        return np.concatenate([change, presence], axis=1)

    def follow(self, states: States, actions: NDArray[np.integer]) -> States:
        """Return states after one move each. Shapes (batch, parts), (batch,)."""
        rows, part = np.arange(len(states)), actions % self.parts
        after, old = states.copy(), states[rows, part]
        presence = np.where(old == REMOVED, HELD, REMOVED)
        after[rows, part] = np.where(actions < self.parts, np.where(old == HELD, INSTALLED, HELD), presence)
        return after
