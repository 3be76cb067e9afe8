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


def box_pairs(low: Array, high: Array, chunk: int = _CHUNK) -> tuple[Index, Index]:
    """Return pairs `i < j` of boxes that overlap or touch, sorted.

    Args:
        low: lowest corners, shape (boxes, 3), metres.
        high: highest corners, shape (boxes, 3), metres.
        chunk: boxes that are looked up at once.

    Returns:
        Two index arrays of equal length.
    """
    chunks = list(iterate_box_pairs(low, high, chunk))
    i, j = (np.concatenate([chunk[side] for chunk in chunks]) for side in (0, 1))
    ahead = i < j
    i, j = i[ahead], j[ahead]
    order = np.lexsort((j, i))
    return i[order], j[order]


def iterate_box_pairs(low: Array, high: Array, chunk: int = _CHUNK) -> Iterator[tuple[Index, Index]]:
    """Yield all pairs of boxes that overlap or touch, each both ways round, in chunks.

    A tree finds them over the two axes along which the boxes are most spread; the third is compared.
    """
    if not len(low):
        yield np.zeros(0, np.int64), np.zeros(0, np.int64)
        return
    size = (high - low).mean(axis=0)
    spread = np.ptp(np.concatenate([low, high]), axis=0) / np.maximum(size, 1e-300)
    third, first, second = np.argsort(spread, kind="stable")
    boxes = shapely.box(low[:, first], low[:, second], high[:, first], high[:, second])
    tree = shapely.STRtree(boxes)
    for start in range(0, len(low), chunk):
        i, j = tree.query(boxes[start : start + chunk])
        i = i + start
        keep = (i != j) & (low[i, third] <= high[j, third]) & (low[j, third] <= high[i, third])
        yield i[keep], j[keep]
