"""Cache of verdicts on the device."""

from __future__ import annotations

from collections.abc import Callable

import torch

from falsework.search.device.rules import TensorRules
from falsework.stability.verdict import Verdict
from falsework.utils.tensors import mix

_UNKNOWN, _STABLE = int(Verdict.UNDECIDED), int(Verdict.STABLE)
_LEAST = 1 << 10
"""Fewest slots of the table."""
_MOST = 1 << 23
"""Most slots of the table, whatever memory there is."""


class VerdictTable:
    """Verdict table on a device; a lookup is a handful of operations on whole batches.

    A hash table with one place for each slot: a new state replaces the previous one, so memory is bounded and nothing
    is ever rehashed. States themselves are compared, not hashes, so that a verdict was proven for exactly this state.
    """

    def __init__(self, rules: TensorRules, *, memory: int = 0) -> None:
        """Begin empty, with room for `memory` bytes of states; 0: 512 MiB on a GPU, 64 MiB on the processor."""
        memory = memory or (1 << 29 if rules.device.type == "cuda" else 1 << 26)
        slots = _LEAST
        while 2 * slots * (rules.part_count + 9) <= memory and slots < _MOST:
            slots *= 2
        self.slots = slots
        # Sums of random words, taken from the top bits; which of several states a slot holds is all that depends on it.
        self._words = mix(torch.arange(rules.part_count, device=rules.device), 1)
        # One extra slot, written by rows without a result.
        self._states = torch.zeros((slots + 1, rules.part_count), dtype=torch.uint8, device=rules.device)
        self.verdict = torch.zeros(slots + 1, dtype=torch.int8, device=rules.device)
        self._ticket = torch.zeros(slots + 1, dtype=torch.int64, device=rules.device)
        self._next_ticket = 1

    def stable(
        self,
        states: torch.Tensor,
        needed: torch.Tensor | None,
        ask: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        *,
        final: bool = True,
    ) -> torch.Tensor:
        """Return which states are proven stable; requests each unknown verdict once per distinct state.

        Waits for the device once, to read the number of unknown states.

        Args:
            states: shape (batch, parts).
            needed: rows that need a verdict, the others count as stable; all if None. Shape (batch,).
            ask: given states `(asked, parts)` and their rows `(asked,)`, returns a `Verdict` each, `(asked,)`.
            final: store undecided states as not stable; otherwise they are not stored.

        Returns:
            `bool`, shape (batch,).
        """
        count = len(states)
        row = torch.arange(count, device=states.device)
        slot = ((states * self._words).sum(dim=1) >> 40) & (self.slots - 1)
        verdict = torch.where((self._states[slot] == states).all(dim=1), self.verdict[slot], _UNKNOWN)
        if needed is not None:
            slot = torch.where(needed, slot, self.slots)
            verdict = torch.where(needed, verdict, _STABLE)
        # Of the rows that share a slot the last one leads: rows with the same state follow it, others ask themselves.
        first = self._next_ticket
        self._ticket.scatter_reduce_(0, slot, row + first, "amax")
        self._next_ticket += count
        leader = self._ticket[slot] - first
        leads = leader == row
        unknown = verdict == _UNKNOWN
        follows = unknown & ~leads & (states[leader] == states).all(dim=1)
        rows = (unknown & ~follows).nonzero()[:, 0]
        if len(rows):
            answer = ask(states[rows], rows)
            if final:
                answer = torch.where(answer == _UNKNOWN, int(Verdict.UNSTABLE), answer)
            verdict[rows] = answer.to(torch.int8)
            verdict = torch.where(follows, verdict[leader], verdict)
            place = torch.where(leads, slot, self.slots)
            self._states[place] = states
            self.verdict[place] = verdict
        return verdict == _STABLE
