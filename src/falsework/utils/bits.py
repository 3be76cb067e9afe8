"""Bit sets in 64-bit words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.utils.kernels import njit

Words = NDArray[np.uint64]


def pack(rows: NDArray[np.bool_]) -> Words:
    """Return rows of flags as sets, lowest bit first, shape (rows, words)."""
    words = -(-rows.shape[1] // 64)
    padded = np.zeros((len(rows), words * 8), dtype=np.uint8)
    packed = np.packbits(rows, axis=1, bitorder="little")
    padded[:, : packed.shape[1]] = packed
    return padded.view("<u8").astype(np.uint64, copy=False)


def unpack(words: Words) -> NDArray[np.bool_]:
    """Return flags of sets, shape (rows, 64 words)."""
    little = np.ascontiguousarray(words).astype("<u8", copy=False)
    return np.unpackbits(little.view(np.uint8), axis=1, bitorder="little").astype(bool)


def intersect(one: Words, two: Words) -> NDArray[np.bool_]:
    """Return whether each set of `one` shares a member with each of `two`, shape (len(one), len(two))."""
    found = np.zeros((len(one), len(two)), dtype=np.bool_)
    intersect_into(np.ascontiguousarray(one), np.ascontiguousarray(two), found)
    return found


@njit(cache=True)
def intersect_into(one: Words, two: Words, found: NDArray[np.bool_]) -> None:  # pragma: no cover - compiled
    """Set the entries of `found`, false at first, whose sets share a member."""
    for i in range(len(one)):
        for j in range(len(two)):
            for word in range(one.shape[1]):
                if one[i, word] & two[j, word]:
                    found[i, j] = True
                    break
