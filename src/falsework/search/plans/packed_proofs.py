"""Proofs of the states of a plan as text for its file: whole arrays, or for large plans what changes between states."""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.stability.state_arrays import StateArrays

Array = NDArray[np.float64]

WHOLE, CHANGES = "zlib_base64", "changes_zlib_base64"
"""Entries of the file: the arrays of all states, or what changes from state to state."""

_ROOM, _EXPANSION = 1 << 28, 64
"""Proofs may take 256 MiB, or so many times the size of their text if that is more, so that a short text cannot ask for
any amount of memory."""
_LEVELS = {WHOLE: 9, CHANGES: 6}
"""Levels of compression; there is little left to gain in changes."""


def pack_proofs(arrays: Array | StateArrays, *, whole_bytes: int = 64 << 20) -> dict[str, str]:
    """Return arrays of shape (states, rows, width) as an entry of a plan file, whole up to so many bytes.

    Other programs read whole arrays more easily.
    """
    if isinstance(arrays, StateArrays) and 8 * np.prod(arrays.shape) > whole_bytes:
        return _packed(CHANGES, _changes(arrays))
    return _packed(WHOLE, iter([np.ascontiguousarray(arrays, dtype="<f8")]))


def unpack_proofs(
    entry: str, text: Any, shape: tuple[int, int, int], what: str, *, room: int = _ROOM
) -> Array | StateArrays:
    """Return what `pack_proofs` wrote.

    Args:
        entry: `WHOLE` or `CHANGES`.
        shape: states, rows and width that are expected.
        what: the text is to hold.
        room: bytes that arrays may take, or `_EXPANSION` times the size of the text if that is more.

    Raises:
        ValueError: it does not; says why.
    """
    states, rows, width = shape
    misfit = f"does not hold {what}"
    try:
        packed, unpacker = base64.b64decode(text, validate=True), zlib.decompressobj()
        most = max(room, _EXPANSION * len(packed))
        # A whole array, or for changes one state and the numbers of the blocks of all states.
        least = 8 * rows * width * (states if entry == WHOLE else 1) + states * rows * (entry == CHANGES) // 8
        if least > most:
            raise ValueError(misfit)
        count = np.full(states, rows)
        if entry == CHANGES:
            head = unpacker.decompress(packed, 4 * states)
            if len(head) != 4 * states:
                raise ValueError(misfit)
            count, packed = np.frombuffer(head, dtype="<u4").astype(np.int64), unpacker.unconsumed_tail
            if count.max(initial=0) > rows:
                raise ValueError(misfit)
        wanted = int(count.sum()) * (8 * width + 4 * (entry == CHANGES))
        if wanted > most:
            raise ValueError(misfit)
        # One extra byte reveals oversized data without unpacking all of it.
        data = unpacker.decompress(packed, wanted + 1)
    except (TypeError, OverflowError, binascii.Error, zlib.error):
        raise ValueError("cannot be unpacked") from None
    if len(data) != wanted:
        raise ValueError(misfit)
    if entry == WHOLE:
        return np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
    row = np.frombuffer(data, dtype="<u4", count=int(count.sum())).astype(np.int64)
    values = np.frombuffer(data, dtype="<f8", offset=4 * len(row)).reshape(len(row), width)
    arrays, end = StateArrays(*shape), 0
    for state, changes in enumerate(count.tolist()):
        begin, end = end, end + changes
        some = row[begin:end]
        if len(some) and (some[-1] >= rows or (np.diff(some) <= 0).any()):
            raise ValueError(misfit)
        arrays.follow(state, some, values[begin:end])
        if arrays.nbytes > most:
            raise ValueError(misfit)
    return arrays


def _changes(arrays: StateArrays) -> Iterator[NDArray[Any]]:
    """Yield how many rows change in each state, beginning with zeros, then all of these rows, then their values."""
    states, rows, width = arrays.shape
    changed, before = [], np.zeros((rows, width))
    for state in range(states):
        now = arrays[state]
        changed.append(np.flatnonzero((now.view(np.uint64) != before.view(np.uint64)).any(axis=1)))
        before = now
    yield np.array([len(some) for some in changed], dtype="<u4")
    for some in changed:
        yield some.astype("<u4")
    for state, some in enumerate(changed):
        yield arrays[state][some].astype("<f8")


def _packed(entry: str, pieces: Iterator[NDArray[Any]]) -> dict[str, str]:
    """Return arrays one after another, compressed, as an entry of a plan file."""
    packer = zlib.compressobj(_LEVELS[entry])
    packed = [packer.compress(np.ascontiguousarray(piece).tobytes()) for piece in pieces]
    return {entry: base64.b64encode(b"".join([*packed, packer.flush()])).decode()}
