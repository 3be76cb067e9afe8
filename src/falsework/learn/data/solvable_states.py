"""Set of states known to be solvable, from which imitation learns, and which grows during training."""

from __future__ import annotations

import numpy as np
import torch

from falsework.search.device.rules import TensorRules
from falsework.search.problem.hashing import StateHash
from falsework.utils.tensors import in_sorted, put

_DRAWN = 4
"""States drawn for each that is wanted, where only those near the end count."""
_CHUNK = 1 << 16
"""States hashed at once."""


class SolvableStates:
    """Set of states from which the structure is known to be disassemblable, on one device.

    States are identified by their 64-bit hashes alone, those of `StateHash`. Among ten million states and a billion
    look-ups, two hashes collide with a probability of one in two thousand, and a collision costs one wrong sample.

    Test states are never stored, and no episode starts from one. If a search during training finds one of them to be
    solvable, actions that lead to it count as valid from then on.
    """

    def __init__(self, rules: TensorRules, states: torch.Tensor | None = None) -> None:
        """Begin with some states.

        Args:
            rules: says which actions are legal, and where.
            states: solvable states in any order, repeated or not, `uint8`, shape (count, parts).
        """
        self.rules = rules
        self.device = rules.device
        parts = rules.part_count
        table = StateHash.for_parts(parts).words
        change = np.concatenate([table[:, 1] ^ table[:, 2], table[:, 2] ^ table[:, 0]])
        self._change = put(change, self.device)
        self._states = torch.empty((0, parts), dtype=torch.uint8, device=self.device)
        self._known = self._no_hashes()
        self._held_out = self._no_hashes()
        self._visited = torch.empty(0, dtype=torch.bool, device=self.device)
        if states is not None:
            self.add(states)

    def __len__(self) -> int:
        return len(self._states)

    @property
    def states(self) -> torch.Tensor:
        """States to learn from and to start from, in the order of insertion, shape (count, parts)."""
        return self._states

    @property
    def held_out(self) -> int:
        """Number of test states."""
        return len(self._held_out)

    @property
    def visited(self) -> int:
        """Number of test states that rollouts have visited, see `record_visits`."""
        return int(self._visited.sum())

    @property
    def held_out_visit_rate(self) -> float:
        """Share of the test states that rollouts have visited."""
        return self.visited / max(self.held_out, 1)

    def hashes(self, states: torch.Tensor) -> torch.Tensor:
        """Return the hash of each state, int64, shape (batch,)."""
        pieces = [self.rules.hashes(states[begin : begin + _CHUNK]) for begin in range(0, len(states), _CHUNK)]
        return torch.cat(pieces) if pieces else self._no_hashes()

    def add(self, states: torch.Tensor) -> int:
        """Add states known to be solvable; test states are not stored.

        Args:
            states: solvable states, repeated or not, shape (count, parts).

        Returns:
            Number of states that were not stored before.
        """
        states = states.to(self.device)
        hashes = self.hashes(states)
        fresh = ~in_sorted(self._known, hashes)
        states, hashes = states[fresh], hashes[fresh]
        if len(states) == 0:
            return 0
        ordered, order = torch.sort(hashes, stable=True)
        first = torch.ones_like(ordered, dtype=torch.bool)
        first[1:] = ordered[1:] != ordered[:-1]
        rows = torch.sort(order[first]).values  # in the order of insertion
        states, hashes = states[rows], hashes[rows]
        self._known = torch.sort(torch.cat([self._known, hashes])).values
        storable = ~in_sorted(self._held_out, hashes)
        self._states = torch.cat([self._states, states[storable]])
        return int(storable.sum())

    def hold_out(self, states: torch.Tensor) -> None:
        """Hold out states for testing: they are never stored, and removed if they were.

        Args:
            states: shape (count, parts).
        """
        hashes = torch.unique(self.hashes(states.to(self.device)))
        hashes = hashes[~in_sorted(self._held_out, hashes)]
        self._held_out, order = torch.sort(torch.cat([self._held_out, hashes]))
        self._visited = torch.cat([self._visited, torch.zeros_like(hashes, dtype=torch.bool)])[order]
        self._states = self._states[~in_sorted(self._held_out, self.hashes(self._states))]

    def is_held_out(self, states: torch.Tensor) -> torch.Tensor:
        """Return which states are held out for testing, bool, shape (batch,)."""
        return in_sorted(self._held_out, self.hashes(states))

    def record_visits(self, states: torch.Tensor) -> None:
        """Note which test states a rollout has come across; they are counted, nothing else.

        Args:
            states: states of rollouts, in any number, shape (batch, parts).
        """
        if len(self._held_out) and len(states):
            hashes = self.hashes(states)
            slot = torch.searchsorted(self._held_out, hashes).clamp_(max=len(self._held_out) - 1)
            hit = (self._held_out[slot] == hashes).to(torch.int32)
            self._visited |= torch.zeros_like(self._visited, dtype=torch.int32).index_add_(0, slot, hit) > 0

    def valid_actions(self, states: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Return the legal actions whose successors are known to be solvable.

        Args:
            states: shape (batch, parts).
            mask: legal actions if they are known already, shape (batch, 2 parts).

        Returns:
            Bool, shape (batch, 2 parts).
        """
        mask = self.rules.moves(states) if mask is None else mask
        hashes = self.hashes(states)
        if self.device.type == "cuda":  # looking all of them up costs less than waiting for a list of the legal ones
            return in_sorted(self._known, hashes[:, None] ^ self._change) & mask
        rows, actions = mask.nonzero(as_tuple=True)
        valid = torch.zeros_like(mask)
        valid[rows, actions] = in_sorted(self._known, hashes[rows] ^ self._change[actions])
        return valid

    def within(self, horizon: int, count: int, generator: torch.Generator) -> torch.Tensor:
        """Draw stored states at most some steps from the end, with repetitions.

        Args:
            horizon: steps at most.
            generator: source of randomness, on the device of the states.

        Returns:
            Shape (count, parts); fewer rows, and even none, if hardly any state is so close.
        """
        if count == 0 or len(self) == 0:
            return self._states[:0]
        rows = torch.randint(len(self), (_DRAWN * count,), generator=generator, device=self.device)
        drawn = self._states[rows]
        return drawn[self.rules.steps_left(drawn) <= horizon][:count]

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the tensors to save, for `load`."""
        return {"states": self._states, "known": self._known, "held_out": self._held_out, "met": self._visited}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore the tensors that `tensors` returned."""
        moved = {name: tensor.to(self.device) for name, tensor in tensors.items()}
        self._states, self._known = moved["states"], moved["known"]
        self._held_out, self._visited = moved["held_out"], moved["met"].bool()

    def held_out_hashes(self) -> torch.Tensor:
        """Return the hashes of test states that are known to be solvable, for other processes; shape (count,)."""
        return self._known[in_sorted(self._held_out, self._known)]

    def learn_held_out_hashes(self, hashes: torch.Tensor) -> None:
        """Add hashes of test states that other processes found solvable; only hashes of test states are valid."""
        fresh = torch.unique(hashes[~in_sorted(self._known, hashes)])
        self._known = torch.sort(torch.cat([self._known, fresh])).values

    def sort(self) -> None:
        """Sort the states by their hashes, an order that does not depend on which process found them first."""
        self._states = self._states[torch.argsort(self.hashes(self._states), stable=True)]

    def _no_hashes(self) -> torch.Tensor:
        return torch.empty(0, dtype=torch.int64, device=self.device)
