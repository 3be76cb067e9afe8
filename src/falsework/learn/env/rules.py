"""The rules of disassembly on tensors, for batches in which every row may have a target of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, as_states
from falsework.errors import InputError, StateError
from falsework.search.device.rules import WaysOut, hash_states
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.task import STAGE, Clearance, Task
from falsework.utils.tensors import choose_device, put


class Rules:
    """Legal actions of one structure on one device (paper, section 3; targets: section 5.3).

    The same rules as `Task.moves` in the direction of disassembly. A `Task` knows one start and one target; here
    states `(batch, parts)` come with targets `(batch, parts)`, or with None, which means that everything goes but
    the boundary and the `fixed` parts. Nothing here waits for the device.
    """

    def __init__(
        self,
        assembly: Assembly | ArrayLike,
        robots: int,
        device: torch.device | str = "cpu",
        *,
        clearance: Clearance | bool | None = None,
        fixed: Sequence[int] = (),
        holds_keep_stable: bool = False,
    ) -> None:
        """Copy the rules to the device.

        Args:
            assembly: the structure, or which of its parts are boundary, shape (parts,).
            robots: number of parts that may be held at once.
            device: where the states are, such as `cpu`, `cuda` or `auto`.
            clearance: where given, a part is removed only if it can leave; True for the table of the assembly.
            fixed: parts that are never touched, whatever a target says.
            holds_keep_stable: whether a stable state stays stable when a part of it is held, as of the oracle.

        Raises:
            InputError: fewer than one robot, no such device, a fixed part that does not exist, or a clearance asked
                of a bare boundary.
        """
        boundary = assembly.boundary if isinstance(assembly, Assembly) else np.asarray(assembly, dtype=bool)
        if clearance is True:
            if not isinstance(assembly, Assembly):
                raise InputError("a boundary alone has no clearance table; hand in the assembly, or the table itself")
            clearance = assembly.clearance
        task = Task.create(boundary, robots, fixed=fixed)
        self.boundary = task.boundary
        self.robots = task.robots
        self.fixed = task.fixed
        self.part_count = task.part_count
        self.device = choose_device(device) if isinstance(device, str) else torch.device(device)
        self.clearance = clearance or None
        self.holds_keep_stable = holds_keep_stable
        self._ways = None if self.clearance is None else WaysOut(self.clearance, self.part_count, self.device)
        touchable = ~task.boundary
        touchable[list(task.fixed)] = False
        self._loose = put(~task.boundary, self.device)
        self._touchable = put(touchable, self.device)
        self._stage = put(STAGE, self.device)
        self._words = put(StateHash.for_parts(self.part_count).words, self.device)

    def mask(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> torch.Tensor:
        """Actions that are legal, stability aside.

        Args:
            states: between a start and the targets, `uint8`, shape (batch, parts).
            targets: `uint8`, shape (batch, parts); None takes everything away that is not fixed.

        Returns:
            `bool`, shape (batch, 2 parts); `[:, i]` hold part `i`, `[:, parts + i]` remove part `i`.
        """
        held = states == HELD
        used = (held & self._loose).sum(dim=1)
        hold = (states == INSTALLED) & (used < self.robots)[:, None] & self._touchable
        remove = held & self._touchable
        if targets is not None:
            goes = targets == REMOVED
            # A robot that holds a part to the end is lost for the rest: the last one must stay free for removals.
            kept = (targets == HELD) & self._loose
            busy = (kept & held).sum(dim=1)
            waiting = (goes & (states != REMOVED)).any(dim=1)
            hold &= (targets != INSTALLED) & ~(kept & ((busy + 1 >= self.robots) & waiting)[:, None])
            remove &= goes
        if self._ways is not None:
            remove &= self._ways.can_leave(states)
        return torch.cat([hold, remove], dim=1)

    def apply(self, states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """States after one action each: hold sets 2, remove sets 0. Shapes (batch, parts), (batch,)."""
        actions = actions.long()
        value = torch.where(actions < self.part_count, HELD, REMOVED).to(torch.uint8)
        return states.scatter(1, (actions % self.part_count)[:, None], value[:, None])

    def needs_verdict(self, actions: torch.Tensor) -> torch.Tensor:
        """Which actions can make a stable state one that is not, as `Task.needs_verdict`. `bool`, shape (batch,)."""
        return (actions >= self.part_count) | (not self.holds_keep_stable)

    def reached(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> torch.Tensor:
        """Which states are their target; without targets, those in which nothing removable is left. Shape (batch,)."""
        if targets is None:
            return ((states == REMOVED) | ~self._touchable).all(dim=1)
        return (states == targets).all(dim=1)

    def steps_left(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> torch.Tensor:
        """Number of actions from each state to its target, the same on all ways. `int64`, shape (batch,)."""
        if targets is None:
            targets = self.targets(states)
        return (self._stage[targets.long()] - self._stage[states.long()]).sum(dim=1)

    def contains(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> torch.Tensor:
        """Which states may lead to their target as far as the rules go, as `Task.create` checks. Shape (batch,).

        No part has to go backwards, no fixed part has to change, and robots suffice in both.
        """
        if targets is None:
            targets = self.targets(states)
        forward = (self._stage[targets.long()] >= self._stage[states.long()]).all(dim=1)
        still = ((states == targets) | self._touchable).all(dim=1)
        enough = torch.stack([((s == HELD) & self._loose).sum(dim=1) <= self.robots for s in (states, targets)])
        return forward & still & enough.all(dim=0)

    def targets(self, states: torch.Tensor) -> torch.Tensor:
        """What None as target means for each state: only boundary and fixed parts stay, as they are.

        Args:
            states: shape (batch, parts).

        Returns:
            Shape (batch, parts).
        """
        return torch.where(self._touchable, REMOVED, states).to(torch.uint8)

    def complete(self, count: int = 1) -> torch.Tensor:
        """The complete structure, nothing held, `count` times. Shape (count, parts)."""
        state = torch.where(self._loose, INSTALLED, HELD).to(torch.uint8)
        return state.expand(count, -1).clone()

    def hashes(self, states: torch.Tensor) -> torch.Tensor:
        """The words of `StateHash` as int64 of the same bits. Shape (batch,)."""
        return hash_states(states, self._words)

    def put(self, states: ArrayLike | torch.Tensor) -> torch.Tensor:
        """Check states that come from outside, and put them on the device.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)` of 0 removed, 1 installed, 2 held.

        Returns:
            `uint8`, shape (batch, parts).

        Raises:
            StateError: as `as_states`, or more parts held than there are robots.
        """
        if isinstance(states, torch.Tensor):
            states = states.detach().cpu().numpy()
        batch = as_states(states, self.boundary)
        held = ((batch == HELD) & ~self.boundary).sum(axis=1)
        if (held > self.robots).any():
            row = int(np.argmax(held > self.robots))
            raise StateError(f"state {row} has {held[row]} parts held; {self.robots} robots can hold {self.robots}")
        return put(batch, self.device)
