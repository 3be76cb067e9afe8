"""Arrays of the states of a plan, of which blocks that do not change from state to state are stored once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 32
"""Rows of a block: small, since a repair changes few contacts, and large beside the four bytes of its number."""
GROWTH = 1.0625
"""Factor by which the memory for blocks grows: small, since room that is not used is resident too."""


class RowBlocks:
    """Blocks of rows, each stored once for all arrays that have it; the first is zero."""

    def __init__(self, width: int) -> None:
        """Begin with the block of zeros."""
        self.count, self.free = 1, np.zeros(0, dtype=np.int32)
        """Blocks so far, and the numbers of those that no array has any more."""
        self.values = np.zeros((1, BLOCK, width))

    def add(self, blocks: Array) -> NDArray[np.int32]:
        """Store blocks, shape (some, block, width), and return their numbers."""
        reused, self.free = self.free[: len(blocks)], self.free[len(blocks) :]
        first, self.count = self.count, self.count + len(blocks) - len(reused)
        if self.count > len(self.values):
            # In place, so that old and new memory are never both in use.
            shape = (max(self.count, int(GROWTH * len(self.values))), *self.values.shape[1:])
            self.values.resize(shape, refcheck=False)
        numbers = np.concatenate([reused, np.arange(first, self.count, dtype=np.int32)])
        self.values[numbers] = blocks
        return numbers

    def store(self, array: NDArray[np.floating], before: NDArray[np.int32]) -> NDArray[np.int32]:
        """Store an array, shape (rows, width), and return the numbers of its blocks.

        Those that are, bit by bit, the ones of the array whose blocks are `before` are shared.
        """
        blocks = np.zeros((len(before), *self.values.shape[1:]))
        blocks.reshape(-1, blocks.shape[2])[: len(array)] = array
        new = (blocks.view(np.uint64) != self.values[before].view(np.uint64)).any(axis=(1, 2))
        number = before.copy()
        number[new] = self.add(blocks[new])
        return number

    def read(self, number: NDArray[np.int32], rows: int) -> Array:
        """Return a copy of arrays by the numbers of their blocks, shape (..., rows, width)."""
        return self.values[number].reshape(*number.shape[:-1], -1, self.values.shape[2])[..., :rows, :]


class StateArrays:
    """Array of shape (states, rows, width), for example contact forces, that takes memory only for what changes.

    Converts to a NumPy array where one is needed: `np.asarray(arrays)`, or `arrays[state]` for one state. Slices share
    the memory.
    """

    def __init__(self, states: int, rows: int, width: int) -> None:
        """Begin with zeros."""
        self._rows = rows
        self._blocks = RowBlocks(width)
        self._number = np.zeros((states, -(-rows // BLOCK)), dtype=np.int32)
        self._known = np.zeros(states, dtype=bool)

    @property
    def shape(self) -> tuple[int, int, int]:
        """States, rows, width."""
        return len(self._number), self._rows, self._blocks.values.shape[2]

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays take."""
        return self._blocks.values.nbytes + self._number.nbytes

    def __len__(self) -> int:
        return len(self._number)

    def __getitem__(self, index: Any) -> Any:
        """Return the array of one state, those of several, or for a slice of states the same without a copy."""
        if isinstance(index, slice):
            some = object.__new__(StateArrays)
            some._rows, some._blocks = self._rows, self._blocks
            some._number, some._known = self._number[index], self._known[index]
            return some
        return self._blocks.read(self._number[index], self._rows)

    def __setitem__(self, states: NDArray[np.integer], arrays: Array) -> None:
        """Store the arrays of some states, shape (some, rows, width)."""
        for state, array in zip(np.arange(len(self))[states].tolist(), arrays, strict=True):
            self._put(state, array)

    def follow(self, state: int, rows: NDArray[np.int64], values: Array) -> None:
        """Store the array of a state that differs from that of the state before, or the first from zeros, in some rows.

        Args:
            state: number of the state; all before it are stored.
            rows: ascending, shape (some,).
            values: shape (some, width).
        """
        number = self._number[state - 1].copy() if state else np.zeros_like(self._number[0])
        touched, place = np.unique(rows // BLOCK, return_inverse=True)
        blocks = self._blocks.values[number[touched]]
        blocks[place, rows % BLOCK] = values
        number[touched] = self._blocks.add(blocks)
        self._number[state], self._known[state] = number, True

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[np.arange(len(self))], dtype=dtype)

    def copy(self) -> StateArrays:
        """Return a copy, which shares the blocks, since these never change."""
        same = self[:]
        same._number, same._known = same._number.copy(), same._known.copy()
        return same

    def _put(self, state: int, array: Array) -> None:
        """Store the array of one state; blocks that are, bit by bit, those of the last stored before it are shared."""
        before = np.flatnonzero(self._known[:state])
        last = self._number[before[-1]] if len(before) else np.zeros_like(self._number[0])
        self._number[state] = self._blocks.store(array, last)
        self._known[state] = True
