"""Forces or displacements of states that searches found stable, from which later checks start."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.stability.state_memory import StateMemory, WholeMemory

_UNHELD = 3
"""Held parts of which a guess is looked up for the state before they were held."""


class Guesses:
    """Memory of forces, or under `contact` displacements, by state."""

    def __init__(self, memory: WholeMemory | StateMemory, boundary: Mask, *, holds_keep_stable: bool) -> None:
        """Begin with an empty memory.

        Args:
            memory: where they are kept.
            boundary: parts that no robot holds, shape (parts,).
            holds_keep_stable: whether forces prove a state with more parts held too; displacements do not, and are kept
                in float32.
        """
        self._memory, self._boundary, self._holds_keep_stable = memory, boundary, holds_keep_stable

    def of(self, state: States) -> NDArray[np.floating] | None:
        """Return the guess stored for a state; where holds keep states stable, also for it with parts not yet held."""
        found = self._memory.get(state.tobytes())
        if found is not None or not self._holds_keep_stable:
            return found
        held, before = np.flatnonzero((state == HELD) & ~self._boundary)[:_UNHELD], state.copy()
        for values in product((REMOVED, INSTALLED, HELD), repeat=len(held)):
            before[held] = values
            if (found := self._memory.get(before.tobytes())) is not None:
                break
        return found

    def pass_on(self, states: States, origins: States) -> None:
        """Let states that were cached as stable share the guess of their parents."""
        for state, origin in zip(states, origins, strict=True):
            key = state.tobytes()
            if key not in self._memory and (known := self.of(origin)) is not None:
                self._memory[key] = known

    def remember(self, states: States, found: NDArray[np.float64]) -> None:
        """Store what was found for states, shape (batch, points, 3) or (batch, parts, 6)."""
        for state, guess in zip(states, found, strict=True):
            self._memory[state.tobytes()] = guess.astype(np.float64 if self._holds_keep_stable else np.float32)
