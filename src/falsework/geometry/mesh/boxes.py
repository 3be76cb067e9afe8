"""Overlap of axis-aligned bounding boxes: the broad phase of all part-to-part tests."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CHUNK = 20_000
"""Boxes that are looked up at once; bounds the memory for very fine meshes."""
_FEW = 4096
"""Pairs of boxes up to which comparing all takes less time than a tree."""


def box_pairs(low: Array, high: Array, chunk: int = _CHUNK) -> tuple[Index, Index]:
    """Return pairs `i < j` of boxes that overlap or touch, sorted.

    Args:
        low: lowest corners, shape (boxes, 3), metres.
        high: highest corners, shape (boxes, 3), metres.
        chunk: boxes that are looked up at once.

    Returns:
        Two index arrays of equal length.
    """
    i, j = _joined(list(crossing_boxes(low, high, low, high, chunk=chunk)))
    ahead = i < j
    i, j = i[ahead], j[ahead]
    order = np.lexsort((j, i))
    return i[order], j[order]


def crossing_boxes(
    low: Array, high: Array, other_low: Array, other_high: Array, *, chunk: int = _CHUNK, few: int = _FEW
) -> Iterator[tuple[Index, Index]]:
    """Yield pairs of a box of one set and a box of another that overlap or touch, in chunks.

    A tree finds them over the two axes along which the boxes are most spread; the third is compared.

    Args:
        low: lowest corners of the first set, shape (boxes, 3), metres.
        high: highest corners of the first set, shape (boxes, 3), metres.
        other_low: lowest corners of the other set, shape (others, 3), metres.
        other_high: highest corners of the other set, shape (others, 3), metres.
        chunk: boxes that are looked up at once.
        few: pairs up to which all are compared.
    """
    if len(low) * len(other_low) <= few:
        i, j = np.nonzero(((low[:, None] <= other_high) & (other_low <= high[:, None])).all(axis=2))
        yield i, j
        return
    size = (other_high - other_low).mean(axis=0)
    spread = np.ptp(np.concatenate([other_low, other_high]), axis=0) / np.maximum(size, 1e-300)
    third, first, second = np.argsort(spread, kind="stable")
    tree = shapely.STRtree(
        shapely.box(other_low[:, first], other_low[:, second], other_high[:, first], other_high[:, second])
    )
    for start in range(0, len(low), chunk):
        some = slice(start, start + chunk)
        i, j = tree.query(shapely.box(low[some, first], low[some, second], high[some, first], high[some, second]))
        i = i + start
        keep = (low[i, third] <= other_high[j, third]) & (other_low[j, third] <= high[i, third])
        yield i[keep], j[keep]


def pairs_of_groups(
    boxes: Array,
    reach: Array,
    group: NDArray[np.integer],
    among: NDArray[np.bool_] | None = None,
    *,
    chunk: int = _CHUNK,
    few: int = _FEW,
) -> Iterator[tuple[Index, Index]]:
    """Yield pairs of boxes of different groups, such as faces of different parts, each within the reach of the other.

    Groups are compared first, so that neighbours within a group, which are most of the boxes near each one of a fine
    mesh, are never listed.

    Args:
        boxes: lowest and highest corners, shape (2, boxes, 3), metres.
        reach: those of larger boxes around them, which contain all that a box may have to do with.
        group: of each box, ascending from 0, shape (boxes,).
        among: whether two groups are compared, shape (groups, groups); None: all.
        chunk: boxes that are looked up at once, and pairs from which they are handed on.
        few: pairs of two groups up to which all are compared.

    Yields:
        Indices of equal length, the first of the lower group.
    """
    if not len(group):
        return
    first = np.flatnonzero(np.append(True, group[1:] != group[:-1]))
    start = np.append(first, len(group))
    outer, inner = (
        np.stack([np.minimum.reduceat(some[0], first), np.maximum.reduceat(some[1], first)]) for some in (reach, boxes)
    )
    a, b = box_pairs(*outer)
    keep = _overlap(outer, a, inner, b) & _overlap(inner, a, outer, b)
    if among is not None:
        keep &= among[group[first[a]], group[first[b]]]
    batch: list[tuple[Index, Index]] = []
    held = 0
    for one, two in zip(a[keep].tolist(), b[keep].tolist(), strict=True):
        i, j = (
            start[mine] + np.flatnonzero(_within(reach, span, inner[:, other]) & _within(boxes, span, outer[:, other]))
            for mine, other in ((one, two), (two, one))
            for span in [slice(start[mine], start[mine + 1])]
        )
        for row, column in crossing_boxes(*reach[:, i], *boxes[:, j], chunk=chunk, few=few):
            row, column = i[row], j[column]
            both = _overlap(boxes, row, reach, column)
            batch.append((row[both], column[both]))
            held += len(row)
        if held > chunk:
            yield _joined(batch)
            batch, held = [], 0
    if batch:
        yield _joined(batch)


def _joined(chunks: list[tuple[Index, Index]]) -> tuple[Index, Index]:
    i, j = (np.concatenate([chunk[side] for chunk in chunks]) for side in (0, 1))
    return i, j


def _overlap(boxes: Array, i: Index, others: Array, j: Index) -> NDArray[np.bool_]:
    """Return whether boxes of two arrays overlap or touch, pair by pair."""
    return ((boxes[0, i] <= others[1, j]) & (others[0, j] <= boxes[1, i])).all(axis=1)


def _within(boxes: Array, span: slice, box: Array) -> NDArray[np.bool_]:
    """Return whether boxes of a range overlap or touch one box."""
    return ((boxes[0, span] <= box[1]) & (box[0] <= boxes[1, span])).all(axis=1)
