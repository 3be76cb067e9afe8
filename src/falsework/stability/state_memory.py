"""Memory of arrays by state: whole, or with blocks that several states share stored once."""

from __future__ import annotations

from collections import OrderedDict
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.stability.state_arrays import BLOCK, GROWTH, Array

_WHOLE = 256 * 1024 * 1024
"""Memory for arrays stored whole, bytes."""
_SHARED = 3 * 1024 * 1024 * 1024
"""Memory for blocks, bytes: nearly all forces of a plan of ten thousand parts, which takes as much for its proofs."""
REMEMBERED = 1 << 16
"""States whose answers are kept by key, until all are forgotten together: chosen for memory, 33 MB at 510 parts."""
_UNHELD = 3
"""Held parts of which a guess is looked up for the state before they were held: as many as robots mostly hold."""


def remembered_forces(points: int, parts: int) -> WholeMemory | StateMemory:
    """Return a memory for the contact forces of a structure: whole if those of the states of a plan have room there."""
    size = 8 * 3 * points
    return WholeMemory(size) if 2 * parts * size <= _WHOLE else StateMemory(points, 3, _SHARED)


class WholeMemory(OrderedDict[bytes, NDArray[np.floating]]):
    """Arrays by key; the first stored are forgotten first."""

    def __init__(self, size: int) -> None:
        """Begin empty, for arrays of so many bytes."""
        super().__init__()
        self._size = size
        self._most = _WHOLE // max(size, 1)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes a copy; a dictionary would be made without the size."""
        return WholeMemory, (self._size,), None, None, iter(self.items())

    def __setitem__(self, key: bytes, array: NDArray[np.floating]) -> None:
        super().__setitem__(key, array)
        while len(self) > self._most:
            self.popitem(last=False)


class StateMemory:
    """Arrays of shape (rows, width), for example contact forces, by key; the first stored are forgotten first.

    An array shares the blocks that are, bit by bit, those of the array that was stored or looked up last, mostly that
    of a neighbouring state.
    """

    def __init__(self, rows: int, width: int, limit: int) -> None:
        """Begin empty.

        Args:
            rows: of each array.
            width: of each row.
            limit: bytes; one array is kept whatever it takes.
        """
        self._rows, self._limit = rows, limit
        self.values = np.zeros((1, BLOCK, width))
        self._users = np.ones(1, dtype=np.int64)
        """Arrays that have each block; the first block is zero, and never given up."""
        self._count, self._free = 1, np.zeros(0, dtype=np.int32)
        self._numbers: OrderedDict[bytes, NDArray[np.int32]] = OrderedDict()
        self._last = self._nothing = np.zeros(-(-rows // BLOCK), dtype=np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays take, without room for more."""
        block = self.values[0].nbytes + self._users.itemsize
        return (self._count - len(self._free)) * block + len(self) * self._nothing.nbytes

    def __len__(self) -> int:
        return len(self._numbers)

    def __contains__(self, key: bytes) -> bool:
        return key in self._numbers

    def get(self, key: bytes) -> Array | None:
        """Return a copy of an array, shape (rows, width); None where it is not known."""
        number = self._numbers.get(key)
        if number is None:
            return None
        self._last = number
        return self.values[number].reshape(-1, self.values.shape[2])[: self._rows]

    def __setitem__(self, key: bytes, array: NDArray[np.floating]) -> None:
        """Store an array, shape (rows, width)."""
        blocks = np.zeros((len(self._nothing), *self.values.shape[1:]))
        blocks.reshape(-1, blocks.shape[2])[: self._rows] = array
        new = (blocks.view(np.uint64) != self.values[self._last].view(np.uint64)).any(axis=(1, 2))
        number = self._last.copy()
        number[new] = self._room(int(new.sum()))
        self.values[number[new]] = blocks[new]
        self._users[number] += 1  # the zero block alone may be there twice
        if key in self:
            self._give_up(self._numbers[key])
        self._numbers[key] = self._last = number
        while self.nbytes > self._limit and len(self) > 1:
            self._give_up(self._numbers.popitem(last=False)[1])

    def _room(self, count: int) -> NDArray[np.int32]:
        """Return numbers of blocks that no array has."""
        reused, self._free = self._free[:count], self._free[count:]
        first, self._count = self._count, self._count + count - len(reused)
        if self._count > len(self.values):
            # In place, so that old and new memory are never both in use.
            size = max(self._count, int(GROWTH * len(self.values)))
            self.values.resize((size, *self.values.shape[1:]), refcheck=False)
            self._users.resize(size, refcheck=False)
        return np.concatenate([reused, np.arange(first, self._count, dtype=np.int32)])

    def _give_up(self, number: NDArray[np.int32]) -> None:
        """Give up the blocks of an array that no other has."""
        self._users[number] -= 1
        self._users[0] = 1
        self._free = np.concatenate([self._free, number[(self._users[number] == 0) & (number > 0)]])
        if self._last is number:
            self._last = self._nothing


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
        self.memory, self._boundary, self._holds_keep_stable = memory, boundary, holds_keep_stable

    def get(self, state: States) -> NDArray[np.floating] | None:
        """Return the guess stored for a state; where holds keep states stable, also for it with parts not yet held."""
        found = self.memory.get(state.tobytes())
        if found is not None or not self._holds_keep_stable:
            return found
        held, before = np.flatnonzero((state == HELD) & ~self._boundary)[:_UNHELD], state.copy()
        for values in product((REMOVED, INSTALLED, HELD), repeat=len(held)):
            before[held] = values
            if (found := self.memory.get(before.tobytes())) is not None:
                break
        return found

    def pass_on(self, states: States, origins: States) -> None:
        """Let states that were cached as stable share the guess of their parents."""
        for state, origin in zip(states, origins, strict=True):
            key = state.tobytes()
            if key not in self.memory and (known := self.get(origin)) is not None:
                self.memory[key] = known

    def remember(self, states: States, found: NDArray[np.float64]) -> None:
        """Store what was found for states, shape (batch, points, 3) or (batch, parts, 6)."""
        for state, guess in zip(states, found, strict=True):
            self.memory[state.tobytes()] = guess.astype(np.float64 if self._holds_keep_stable else np.float32)
