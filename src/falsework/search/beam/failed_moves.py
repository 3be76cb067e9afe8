"""Memory of moves that failed, by what surrounded the part that moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, REMOVED, Mask, States


class FailedMoves:
    """Memory of moves whose state was rejected, by the values of the moved part and of those in contact with it.

    What makes a part fall is mostly what surrounds it, so a move that failed once fails again wherever the parts around
    it are the same, however different the rest of the structure. That is an observation, not a theorem: searches try
    such moves last, and never take them as refuted.
    """

    def __init__(self, neighbours: Mask) -> None:
        """Begin with nothing.

        Args:
            neighbours: which parts are in contact, without those that never change, shape (parts, parts).
        """
        parts = len(neighbours)
        count = neighbours.sum(axis=1)
        # Rows are filled up with a part that does not exist, whose word is zero.
        self._ring = np.full((parts, int(count.max(initial=0))), parts, dtype=np.int64)
        for part, others in enumerate(neighbours):
            self._ring[part, : count[part]] = np.flatnonzero(others)
        rng = np.random.default_rng(0xFA11)
        self._around = np.zeros((parts + 1, 3), dtype=np.uint64)
        self._around[:parts] = rng.integers(0, 2**64, size=(parts, 3), dtype=np.uint64)
        self._moved = rng.integers(0, 2**64, size=(parts, 3), dtype=np.uint64)
        self.known: dict[int, bool] = {}
        """By its key, whether a move failed when it was last tried."""

    def keys(self, states: States, part: NDArray[np.integer]) -> NDArray[np.uint64]:
        """Return what the memory goes by.

        Args:
            states: after the moves, shape (batch, parts).
            part: that moved, shape (batch,).

        Returns:
            Shape (batch,).
        """
        ring = self._ring[part]
        values = np.take_along_axis(states, np.minimum(ring, states.shape[1] - 1), axis=1)
        own = self._moved[part, states[np.arange(len(part)), part]]
        return np.bitwise_xor.reduce(self._around[ring, values], axis=1) ^ own

    def traps(self, states: States, part: NDArray[np.integer]) -> Mask:
        """Return which moves close the surroundings of a missing part that failed in them. Shape (batch,).

        Nothing around such a part changes any more, so it can no longer be placed.

        Args:
            states: after the moves, in the order of assembly, shape (batch, parts).
            part: that moved, shape (batch,).
        """
        found = np.zeros(len(part), dtype=bool)
        # Rings of parts with few neighbours are filled up with one more part, which is there.
        padded = np.concatenate([states, np.full((len(states), 1), INSTALLED, dtype=states.dtype)], axis=1)
        row, place = np.nonzero(np.take_along_axis(padded, self._ring[part], axis=1) == REMOVED)
        missing = self._ring[part[row], place]
        closed = (np.take_along_axis(padded[row], self._ring[missing], axis=1) == INSTALLED).all(axis=1)
        row, missing = row[closed], missing[closed]
        filled = states[row]
        filled[np.arange(len(row)), missing] = INSTALLED
        found[row[self.failed(self.keys(filled, missing))]] = True
        return found

    def failed(self, keys: NDArray[np.uint64]) -> Mask:
        """Return which moves failed when they were last tried. Shape (batch,)."""
        return np.array([self.known.get(key, False) for key in keys.tolist()], dtype=bool)

    def learn(self, keys: NDArray[np.uint64], stable: Mask) -> None:
        """Take note of verdicts on the states after some moves, shapes (batch,)."""
        for key, good in zip(keys.tolist(), stable.tolist(), strict=True):
            self.known[key] = not good
