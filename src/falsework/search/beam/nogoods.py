"""Dead ends of a search: the choices that led to them, and distances of jumps back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States


class Nogoods:
    """Memory of refuted choices: moves that fix a part in a state, from which the search died."""

    def __init__(self, remembered: int = 4096) -> None:
        """Begin without conflicts.

        Args:
            remembered: states whose refuted choices are remembered, those refuted last: of a few hundred parts each, a
                few megabytes.
        """
        self._remembered = remembered
        self.count = 0
        """Conflicts so far."""
        self.refuted: dict[str, list[int]] = {}
        """Refuted actions by the state, in hexadecimal digits."""

    def learn(self, state: States, action: int) -> None:
        """Note that the search died after a choice, an action in a state of shape (parts,)."""
        self.count += 1
        key = state.tobytes().hex()
        refuted = self.refuted[key] = self.refuted.pop(key, [])  # the last used is the last forgotten
        if action not in refuted:
            refuted.append(action)
        if len(self.refuted) > self._remembered:
            del self.refuted[next(iter(self.refuted))]

    def barred(self, states: States) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows of states and their refuted actions, shapes (refuted,)."""
        pairs = [
            (row, action)
            for row, state in enumerate(states if self.refuted else ())
            for action in self.refuted.get(state.tobytes().hex(), ())
        ]
        rows, actions = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        return rows, actions


@dataclass
class Jumps:
    """Distances of jumps back from dead ends: the Luby sequence, until a search gets farther than ever before."""

    farthest: int = 0
    """Farthest level since the last restart."""
    since: int = 0
    """Jumps since it was reached."""

    def distance(self, level: int) -> int:
        """Return how far to jump back from a dead end at some level."""
        if level > self.farthest:
            self.farthest, self.since = level, 0
        return luby(self.since + 1)


def luby(number: int) -> int:
    """Return an entry of the sequence 1, 1, 2, 1, 1, 2, 4, ... of Luby et al. (1993), the first for number 1."""
    while True:
        bits = number.bit_length()
        if number == (1 << bits) - 1:
            return 1 << (bits - 1)
        number -= (1 << (bits - 1)) - 1
