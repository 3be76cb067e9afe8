"""Moves of parts that are made of cells: which sets can begin to move, how far, and which are out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.paths.gjk import INNER, OUTER
from falsework.utils.kernels import njit

Index = NDArray[np.int64]

BASE = 1024
"""Shifts are below half of that, in cells."""
MOST_SETS = 4096
"""Sets of parts that can begin to move in one step, at most."""


@njit(**INNER)
def _place(code: int, axis: int) -> int:  # pragma: no cover - compiled
    """Return a component of a shift from its number."""
    for _ in range(2 - axis):
        code = (code - ((code + BASE // 2) % BASE - BASE // 2)) // BASE
    return (code + BASE // 2) % BASE - BASE // 2


@njit(**INNER)
def _find(hits: Index, low: int, high: int, code: int) -> int:  # pragma: no cover - compiled
    """Return the place of a number in ascending ones, from a first up to a last place; -1 if it is not there."""
    end = high
    while low < high:
        middle = (low + high) // 2
        if hits[middle] < code:
            low = middle + 1
        else:
            high = middle
    return low if low < end and hits[low] == code else -1


@njit(**INNER)
def _closed(pushed: Index, blocked: int, found: Index) -> int:  # pragma: no cover - compiled
    """Write the sets that can move as one body to `found`, as `closed_sets`, and return their number.

    It is more than fit where not all of them are written.
    """
    parts, count = len(pushed), 0
    for middle in range(parts):
        for part in range(parts):
            if pushed[part] >> middle & 1:
                pushed[part] |= pushed[middle]
    for part in range(parts):
        some = pushed[part]
        if some & blocked:
            continue
        before = count
        for k in range(-1, before):
            joined = some if k < 0 else some | found[k]
            known = False
            for other in range(count):
                known |= found[other] == joined
            if known:
                continue
            if count == len(found):
                return count + 1
            found[count] = joined
            count += 1
    return count


@njit(**INNER)
def _length(
    at: Index, node: int, some: int, step: int, boxes: Index, home: Index, row: int, whole: bool
) -> int:  # pragma: no cover - compiled
    """Return by how many cells a set moves until one of its parts, or the whole, is beside the box around others."""
    axis, upwards = step // 2, step % 2 == 0
    low, high = home[row, 0, axis], home[row, 1, axis]
    for part in range(at.shape[1]):
        code = at[node, part]
        if code != 0 and not some >> part & 1:
            place = _place(code, axis)
            low, high = min(low, boxes[part, 0, axis] + place), max(high, boxes[part, 1, axis] + place)
    found, first = 1, True
    for part in range(at.shape[1]):
        if some >> part & 1:
            place = _place(at[node, part], axis)
            gap = high - boxes[part, 0, axis] - place if upwards else boxes[part, 1, axis] + place - low
            found = gap if first else max(found, gap) if whole else min(found, gap)
            first = False
    return max(found, 1)


@njit(**INNER)
def _free(
    at: Index, node: int, some: int, code: int, most: int, hits: Index, start: Index, touched: NDArray[np.uint8]
) -> int:  # pragma: no cover - compiled
    """Return by how many cells, up to `most`, a set that can begin to move goes until it hits another part."""
    parts = at.shape[1]
    for cells in range(2, most + 1):
        for part in range(parts):
            if not some >> part & 1:
                continue
            here, row = at[node, part] + cells * code, part * (parts + 1)
            for other in range(parts):
                if some >> other & 1:
                    continue
                if _find(hits, start[row + other], start[row + other + 1], here - at[node, other]) >= 0:
                    return cells - 1
            wall = _find(hits, start[row + parts], start[row + parts + 1], here)
            if wall >= 0:
                touched[wall] = 1
                return cells - 1
    return most


@njit(**OUTER)
def expand(
    at: Index,
    last: Index,
    steps: Index,
    hits: Index,
    start: Index,
    touched: NDArray[np.uint8],
    boxes: Index,
    home: Index,
    targets: Index,
    whole: bool,
    out: bool,
    rows: Index,
    counts: Index,
) -> int:  # pragma: no cover - compiled
    """Write the moves that lead on from shifts of parts, or those by which some are out.

    Args:
        at: shifts as numbers, shape (nodes, parts).
        last: set and axis of the move that led there, a set as bits, shape (nodes, 2).
        steps: the shifts by one cell, two along each axis, as numbers, shape (6,).
        hits: shifts at which two parts overlap, ascending for each pair: of each part past each and past all at rest.
        start: where the pairs begin in `hits`, shape (parts (parts + 1) + 1,).
        touched: set to 1 where something at rest is hit, shape of `hits`.
        boxes: lowest and highest cells of the parts in place, shape (parts, 2, 3).
        home: boxes around all parts, and around those beside each target, shape (1 + targets, 2, 3).
        targets: sets that are to leave, shape (targets,).
        whole: whether the target, of several parts then, moves until all of it is out, and not the first part of it.
        out: whether to write the moves by which a target is out.
        rows: node, step, set and cells of the moves, shape (room, 4).
        counts: number of moves, more than fit where not all are written, and of steps with too many sets.

    Returns:
        0.
    """
    parts = at.shape[1]
    pushed, found = np.zeros(parts, np.int64), np.zeros(MOST_SETS, np.int64)
    counts[0] = counts[1] = 0
    for node in range(at.shape[0]):
        for step in range(6):
            code, blocked = steps[step], 0
            for part in range(parts):
                here, row = at[node, part] + code, part * (parts + 1)
                pushed[part] = 1 << part
                for other in range(parts):
                    hit = _find(hits, start[row + other], start[row + other + 1], here - at[node, other])
                    if hit >= 0:
                        pushed[part] |= 1 << other
                wall = _find(hits, start[row + parts], start[row + parts + 1], here)
                if wall >= 0:
                    touched[wall] = 1
                    blocked |= 1 << part
            sets = _closed(pushed, blocked, found)
            if sets > MOST_SETS:
                counts[1] += 1
                sets = MOST_SETS
            for k in range(sets):
                some = found[k]
                if some == last[node, 0] and step // 2 == last[node, 1]:
                    continue
                leaves = 0
                for target in range(len(targets)):
                    if some == targets[target]:
                        leaves = target + 1
                if out and leaves == 0:
                    continue
                box = leaves if out or whole else 0
                most = _length(at, node, some, step, boxes, home, box, box > 0)
                free = _free(at, node, some, code, most, hits, start, touched)
                for cells in range(most if out else 1, free + 1):
                    if counts[0] < len(rows):
                        rows[counts[0], 0], rows[counts[0], 1] = node, step
                        rows[counts[0], 2], rows[counts[0], 3] = some, cells
                    counts[0] += 1
    return 0
