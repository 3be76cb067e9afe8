"""Memory of moves that failed, by what surrounded the part that moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States

_CHUNK_MOVES = 16_384


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
        keys = np.empty(len(part), dtype=np.uint64)
        for begin in range(0, len(part), _CHUNK_MOVES):
            rows = slice(begin, begin + _CHUNK_MOVES)
            ring = self._ring[part[rows]]
            values = np.take_along_axis(states[rows], np.minimum(ring, states.shape[1] - 1), axis=1)
            keys[rows] = np.bitwise_xor.reduce(self._around[ring, values], axis=1)
            keys[rows] ^= self._moved[part[rows], states[rows][np.arange(len(ring)), part[rows]]]
        return keys

    def failed(self, keys: NDArray[np.uint64]) -> Mask:
        """Return which moves failed when they were last tried. Shape (batch,)."""
        return np.array([self.known.get(key, False) for key in keys.tolist()], dtype=bool)

    def learn(self, keys: NDArray[np.uint64], stable: Mask) -> None:
        """Take note of verdicts on the states after some moves, shapes (batch,)."""
        for key, good in zip(keys.tolist(), stable.tolist(), strict=True):
            self.known[key] = not good
