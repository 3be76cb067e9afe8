"""Zobrist hashes of states, updated in one step per move, and exact merging of equal states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States

Hashes = NDArray[np.uint64]

CHUNK = 4096
"""States that are written down at once where many are only read; it bounds memory and changes no result."""


def chunks(count: int, size: int = CHUNK) -> Iterator[slice]:
    """Yield slices of at most `size` that cover `count` entries."""
    for begin in range(0, count, size):
        yield slice(begin, min(begin + size, count))


@dataclass(frozen=True, eq=False)
class StateHash:
    """Zobrist hash: the exclusive or of one random word for each part and value.

    A move changes one part, so the hash of a child costs two operations and the child itself need not be
    written down. Equal hashes are only a hint: `merge` and `find` compare the states too.
    """

    words: NDArray[np.uint64]
    """Shape (parts, 3)."""

    @classmethod
    def for_parts(cls, parts: int) -> StateHash:
        """Return the words for a structure of `parts` parts; the same in every run."""
        words = np.random.default_rng(0x5EED).integers(0, 2**64, size=(parts, 3), dtype=np.uint64)
        words.setflags(write=False)
        return cls(words)

    def __call__(self, states: States) -> Hashes:
        """Return the hashes of states `(batch, parts)`, shape (batch,)."""
        hashes = np.empty(len(states), dtype=np.uint64)
        part = np.arange(len(self.words))
        for rows in chunks(len(states)):
            hashes[rows] = np.bitwise_xor.reduce(self.words[part, states[rows]], axis=1)
        return hashes

    def after(
        self, hashes: Hashes, part: NDArray[np.integer], old: NDArray[np.integer], new: NDArray[np.integer]
    ) -> Hashes:
        """Return hashes once `part` went from value `old` to `new`; all of shape (batch,)."""
        return hashes ^ self.words[part, old] ^ self.words[part, new]


def merge(hashes: Hashes, rows: Callable[[NDArray[np.intp]], States]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find equal states among many.

    Args:
        hashes: hash of every state, shape (batch,).
        rows: returns the states of given indices, shape (len(indices), parts); asked only where hashes agree.

    Returns:
        Index of the first occurrence of each distinct state, ascending, shape (distinct,), and for every state the
        position of its representative in that list, shape (batch,).
    """
    _, first, inverse = np.unique(hashes, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    repeated = np.flatnonzero(first[inverse] != np.arange(len(hashes)))
    for piece in chunks(len(repeated)):
        chunk = repeated[piece]
        if not np.array_equal(rows(chunk), rows(first[inverse[chunk]])):
            _, first, inverse = np.unique(rows(np.arange(len(hashes))), axis=0, return_index=True, return_inverse=True)
            inverse = inverse.reshape(-1)
            break
    order = np.argsort(first)
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    return first[order], position[inverse]


class StateIndex:
    """Index of a fixed collection of states."""

    def __init__(self, states: States, state_hash: StateHash | None = None) -> None:
        """Index distinct `states`, shape (count, parts)."""
        self._states = states
        self._hash = state_hash or StateHash.for_parts(states.shape[1])
        hashes = self._hash(states)
        self._order = np.argsort(hashes, kind="stable")
        self._sorted = hashes[self._order]

    def find(self, states: States) -> NDArray[np.int64]:
        """Return the position of each state in the collection, or -1. Shape (batch,)."""
        return self.find_hashed(self._hash(states), lambda rows: states[rows])

    def find_hashed(self, hashes: Hashes, rows: Callable[[NDArray[np.intp]], States]) -> NDArray[np.int64]:
        """Return the position of each state in the collection, or -1, for states that are not written down.

        Args:
            hashes: shape (batch,).
            rows: returns the states of given indices; asked only where a hash is in the collection.
        """
        found = np.full(len(hashes), -1, dtype=np.int64)
        if len(self._states) == 0:
            return found
        slot = np.searchsorted(self._sorted, hashes)
        open_rows = np.arange(len(hashes))
        while len(open_rows):
            inside = slot < len(self._sorted)
            inside[inside] = self._sorted[slot[inside]] == hashes[open_rows[inside]]
            open_rows, slot = open_rows[inside], slot[inside]
            place = self._order[slot]
            same = np.zeros(len(open_rows), dtype=bool)
            for part in chunks(len(open_rows)):
                same[part] = (self._states[place[part]] == rows(open_rows[part])).all(axis=1)
            found[open_rows[same]] = place[same]
            # Same hash, another state: look at the next entry with this hash, if there is one.
            open_rows, slot = open_rows[~same], slot[~same] + 1
        return found
