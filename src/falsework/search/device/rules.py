"""Rules of a task on tensors, as `Task` on arrays, for beams and rollouts that stay on their device."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.state import HELD, INSTALLED, REMOVED, as_states, held_count
from falsework.errors import StateError
from falsework.geometry.clearance.protocol import Clearance
from falsework.geometry.clearance.table import ClearanceTable, StraightWays
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.task import STAGE, Direction, Task
from falsework.utils.bits import unpack
from falsework.utils.quantity import counted
from falsework.utils.tensors import choose_device, import_torch, put

if TYPE_CHECKING:
    import torch


class TensorRules:
    """Legal moves between the states of one task in one direction, on one device.

    The rules are those of `Task`. A task has one goal; here every row of a batch may have its own, for goal-conditioned
    policies. Goals of rows are for tasks without missing parts.
    """

    def __init__(
        self, task: Task, device: torch.device | str = "cpu", direction: Direction = Direction.DISASSEMBLY
    ) -> None:
        """Copy the rules to the device.

        Args:
            device: where the states are: a device, or `auto`, `cpu` or `cuda`.

        Raises:
            InputError: no such device.
        """
        self.task = task
        self.direction = direction
        self.device = device = choose_device(device) if isinstance(device, str) else device
        self.part_count = task.part_count
        backward = direction is Direction.ASSEMBLY
        self._stage = put(-STAGE if backward else STAGE, device)
        self._origin = put(task.origin(direction), device)
        self._to_come = put(task.start != REMOVED, device)
        self.hash_words = put(StateHash.for_parts(task.part_count).words, device)
        self._values = put(np.array([INSTALLED, HELD] if backward else [HELD, REMOVED], dtype=np.uint8), device)
        self._ways = ExitTable(task.clearance, task.part_count, device)
        can_leave = None if task.clearance is None else self._ways.can_leave
        self._legal = task.legal_moves("torch", lambda array: put(array, device), direction, can_leave)
        self._loose, self._touchable, self._goal = self._legal.loose, self._legal.touchable, self._legal.goal

    def origin(self) -> torch.Tensor:
        """Return the state that the search begins with, shape (1, parts)."""
        return self._origin[None].clone()

    def complete(self, count: int = 1) -> torch.Tensor:
        """Return the complete structure, nothing held, `count` times. Shape (count, parts)."""
        state = import_torch().where(self._loose, INSTALLED, HELD).to(self._origin.dtype)
        return state.expand(count, -1).clone()

    def moves(self, states: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        """Return actions that the rules allow from each state, stability aside, as `Task.moves`.

        Args:
            states: between the origin and the goals, `uint8`, shape (batch, parts).
            goals: `uint8`, shape (batch, parts); None for the goal of the task.

        Returns:
            `bool`, shape (batch, 2 parts); `[:, i]` hold part `i`, `[:, parts + i]` remove part `i`, or undo that.
        """
        return self._legal.legal(states, goals)

    def held(self, states: torch.Tensor) -> torch.Tensor:
        """Return the number of parts that robots hold in each state. Shape (batch,)."""
        return ((states == HELD) & self._loose).sum(dim=1)

    def goals(self, states: torch.Tensor) -> torch.Tensor:
        """Return the default goals: that of the task, with boundary and fixed parts as in each state.

        Args:
            states: shape (batch, parts).

        Returns:
            Shape (batch, parts).
        """
        return import_torch().where(self._touchable, self._goal, states)

    def reached(self, states: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        """Return which states equal their goal; without goals, boundary and fixed parts are ignored. Shape (batch,)."""
        if goals is None:
            return ((states == self._goal) | ~self._touchable).all(dim=1)
        return (states == goals).all(dim=1)

    def steps_left(self, states: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        """Return the number of actions from each state to its goal, the same on all paths. `int64`, shape (batch,)."""
        goals = self.goals(states) if goals is None else goals
        return (self._stage[goals.long()] - self._stage[states.long()]).sum(dim=1)

    def contains(self, states: torch.Tensor, goals: torch.Tensor | None = None) -> torch.Tensor:
        """Return which states may lead to their goal under the rules, as `Task.from_rules` checks. Shape (batch,).

        No part has to reverse its order of conditions, no fixed part has to change, and robots suffice in both.
        """
        goals = self.goals(states) if goals is None else goals
        forward = (self._stage[goals.long()] >= self._stage[states.long()]).all(dim=1)
        still = ((states == goals) | self._touchable).all(dim=1)
        first, last = (self.held(given) <= self.task.robots for given in (states, goals))
        return forward & still & first & last

    def put(self, states: ArrayLike | torch.Tensor) -> torch.Tensor:
        """Check states that come from outside, and put them on the device.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)` of 0 removed, 1 installed, 2 held.

        Returns:
            `uint8`, shape (batch, parts).

        Raises:
            StateError: as `as_states`, or more parts held than there are robots.
        """
        tensor: Any = states
        if isinstance(states, import_torch().Tensor):
            states = tensor.detach().cpu().numpy()
        boundary, robots = self.task.boundary, self.task.robots
        batch = as_states(states, boundary)
        held = held_count(batch, boundary)
        if (held > robots).any():
            row = int(np.argmax(held > robots))
            can = f"{counted(robots, 'robot')} can hold {robots}"
            raise StateError(f"state {row} has {counted(int(held[row]), 'part')} held; {can}")
        return put(batch, self.device)

    def dead_ends(self, states: torch.Tensor) -> torch.Tensor:
        """Return the states from which the goal is certainly out of reach, as `Task.dead_ends`. Shape (batch,)."""
        torch = import_torch()
        task = self.task
        if task.clearance is None or self.direction is Direction.DISASSEMBLY or task.moves_aside:
            return torch.zeros(len(states), dtype=torch.bool, device=self.device)
        missing = (states == REMOVED) & self._to_come
        return (missing & ~self._ways.can_leave(states, missing)).any(dim=1)

    def needs_verdict(self, actions: torch.Tensor) -> torch.Tensor:
        """Return which moves can destabilise a stable state, as `Task.needs_verdict`. Shape (batch,)."""
        holds = actions < self.part_count
        fixes = holds if self.direction is Direction.DISASSEMBLY else ~holds
        return ~(fixes & self.task.holds_keep_stable)

    def moved_value(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the value that each move gives its part, `uint8`, shape (batch,)."""
        return import_torch().where(actions < self.part_count, *self._values)

    def follow(self, states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Return the states after one move each. Shapes (batch, parts), (batch,)."""
        after = states.clone()
        part = (actions % self.part_count).long()
        return after.scatter_(1, part[:, None], self.moved_value(actions)[:, None])

    def hashes(self, states: torch.Tensor) -> torch.Tensor:
        """Return the words of `StateHash`, as int64 of the same bits. Shape (batch,)."""
        return hash_states(states, self.hash_words)

    def hashes_after(self, states: torch.Tensor, hashes: torch.Tensor, actions: torch.Tensor, parent: torch.Tensor):
        """Return the hashes of the states that moves lead to, without expanding these.

        Args:
            states: shape (level, parts).
            hashes: theirs, shape (level,).
            actions: shape (batch,).
            parent: state that each action is taken in, shape (batch,).

        Returns:
            Shape (batch,).
        """
        part = actions % self.part_count
        old = states.view(-1)[parent * self.part_count + part].long()
        words = self.hash_words.view(-1)
        return hashes[parent] ^ words[3 * part + old] ^ words[3 * part + self.moved_value(actions).long()]

    def children(
        self, states: torch.Tensor, hashes: torch.Tensor, moves: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return every state one move away from some others, not expanded; some may be equal.

        Args:
            states: shape (level, parts).
            hashes: theirs, shape (level,).
            moves: as of `moves`, shape (level, 2 parts).

        Returns:
            Parent, action and hash of each, shape (batch,); parents ascend, and so do the actions of one.
        """
        index = moves.view(-1).nonzero()[:, 0]
        parent, action = index // moves.shape[1], index % moves.shape[1]
        return parent, action, self.hashes_after(states, hashes, action, parent)


class ExitTable:
    """Exit directions of each part, as two matrix products of small integers, which are exact in any precision."""

    def __init__(self, clearance: Clearance | None, parts: int, device: torch.device) -> None:
        """Copy a clearance table to the device; without one, every part can leave."""
        self._clearance, self._parts, self._device = clearance, parts, device

    @cached_property
    def _products(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """What blocks each exit, shape (parts, exits), and whose it is, shape (exits, parts); None without a table."""
        table = self._clearance.table if isinstance(self._clearance, StraightWays) else self._clearance
        if not isinstance(table, ClearanceTable):
            return None
        owner = np.repeat(np.arange(self._parts), np.diff(table.start))
        blockers = put(unpack(table.blockers)[:, : self._parts].T.astype(np.float32), self._device)
        return blockers, put((owner[:, None] == np.arange(self._parts)).astype(np.float32), self._device)

    def can_leave(self, states: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        """Return which parts have a free exit, of those that are wanted at least; shape (batch, parts) each."""
        if self._clearance is None:
            return import_torch().ones_like(states, dtype=import_torch().bool)
        if self._products is None:
            return put(np.asarray(self._clearance.can_leave(states.cpu().numpy(), wanted.cpu().numpy())), self._device)
        blockers, owner = self._products
        return ((states != REMOVED).float() @ blockers == 0).float() @ owner > 0


def hash_states(states: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
    """Return the hashes of states.

    Args:
        states: `uint8`, shape (batch, parts).
        words: those of `StateHash`, as int64 of the same bits, shape (parts, 3).

    Returns:
        int64, shape (batch,).
    """
    torch = import_torch()
    hashes = words[torch.arange(len(words), device=states.device), states.long()]
    while hashes.shape[1] > 1:  # torch has no exclusive or along an axis
        half = hashes.shape[1] // 2
        hashes, odd = hashes[:, :half] ^ hashes[:, half : 2 * half], hashes[:, 2 * half :]
        if odd.shape[1]:
            hashes[:, :1] ^= odd
    return hashes[:, 0]
