"""Memory of arrays by state, of which blocks that several states share are stored once."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.stability.state_arrays import BLOCK, Array, RowBlocks

_SMALL, _LARGE = 256 << 20, 3 << 30
"""Memory, bytes: for arrays stored whole, displacements and forces of which those of a plan have room in it; and for
blocks: nearly all forces of a plan of ten thousand parts, which takes as much for its proofs."""
REMEMBERED = 1 << 16
"""States whose answers are kept by key, until all are forgotten together: chosen for memory, 33 MB at 510 parts."""


class StateMemory:
    """Arrays of shape (rows, width), for example contact forces, by key; the first stored are forgotten first.

    An array shares the blocks that are, bit by bit, those of the array that was stored or looked up last, mostly that
    of a neighbouring state.
    """

    def __init__(self, shape: tuple[int, ...], limit: int) -> None:
        """Begin empty.

        Args:
            shape: rows of each array, and their width.
            limit: bytes; one array is kept whatever it takes.
        """
        rows, width = shape
        self._rows, self._limit, self.blocks = rows, limit, RowBlocks(width)
        self._users = np.ones(1, dtype=np.int64)
        """Arrays that have each block; the block of zeros is never given up."""
        self._numbers: OrderedDict[bytes, NDArray[np.int32]] = OrderedDict()
        self._last = self._nothing = np.zeros(-(-rows // BLOCK), dtype=np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays take, without room for more."""
        block = self.blocks.values[0].nbytes + self._users.itemsize
        return (self.blocks.count - len(self.blocks.free)) * block + len(self) * self._nothing.nbytes

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
        return self.blocks.read(number, self._rows)

    def __setitem__(self, key: bytes, array: NDArray[np.floating]) -> None:
        """Store an array, shape (rows, width)."""
        number = self.blocks.store(array, self._last)
        self._users.resize(len(self.blocks.values), refcheck=False)
        self._users[number] += 1  # the zero block alone may be there twice
        if key in self:
            self._give_up(self._numbers[key])
        self._numbers[key] = self._last = number
        while self.nbytes > self._limit and len(self) > 1:
            self._give_up(self._numbers.popitem(last=False)[1])

    def _give_up(self, number: NDArray[np.int32]) -> None:
        """Give up the blocks of an array that no other has."""
        self._users[number] -= 1
        self._users[0] = 1
        unused = number[(self._users[number] == 0) & (number > 0)]
        self.blocks.free = np.concatenate([self.blocks.free, unused])
        if self._last is number:
            self._last = self._nothing


class Guesses:
    """Memory of forces, or under `contact` displacements, by state."""

    def __init__(self, nothing: Array, boundary: Mask, *, holds_keep_stable: bool) -> None:
        """Begin with an empty memory.

        Args:
            nothing: guess for a state of which nothing is known, shape (rows, width).
            boundary: parts that no robot holds, shape (parts,).
            holds_keep_stable: whether forces prove a state with more parts held too; displacements do not.
        """
        whole = not holds_keep_stable or 2 * len(boundary) * nothing.nbytes <= _SMALL
        self.memory: dict[bytes, Array] | StateMemory = {} if whole else StateMemory(nothing.shape, _LARGE)
        self._most = _SMALL // max(nothing.nbytes, 1) if whole else np.inf
        self._boundary, self._holds_keep_stable = boundary, holds_keep_stable

    def get(self, state: States) -> Array | None:
        """Return the guess of a state; where holds keep states stable, else that of it before one or all were held."""
        found = self.memory.get(state.tobytes())
        if found is not None or not self._holds_keep_stable:
            return found
        held, before = np.flatnonzero((state == HELD) & ~self._boundary), state.copy()
        for parts in (held, *held[:, None]):
            for value in (REMOVED, INSTALLED):
                before[parts] = value
                if (found := self.memory.get(before.tobytes())) is not None:
                    return found
            before[parts] = HELD
        return None

    def pass_on(self, states: States, origins: States) -> None:
        """Let states that were cached as stable share the guess of their parents."""
        for state, origin in zip(states, origins, strict=True):
            if state.tobytes() not in self.memory and (known := self.get(origin)) is not None:
                self._keep(state, known)

    def remember(self, states: States, found: Array) -> None:
        """Store what was found for states, shape (batch, points, 3) or (batch, parts, 6)."""
        for state, guess in zip(states, found, strict=True):
            self._keep(state, guess.copy())

    def _keep(self, state: States, guess: Array) -> None:
        self.memory[state.tobytes()] = guess
        while len(self.memory) > self._most:
            del self.memory[next(iter(self.memory))]  # type: ignore[attr-defined]
