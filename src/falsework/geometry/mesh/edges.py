"""Edges of the faces of a mesh: which faces share them, what hangs together, and what is open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Faces = NDArray[np.int64]


def directed_edges(corners: Faces) -> tuple[Faces, Faces]:
    """Return start and end of the three edges of every face, shapes (3 faces,); those of one face are consecutive."""
    return corners.ravel(), corners[:, [1, 2, 0]].ravel()


def open_edges(corners: Faces) -> tuple[Faces, Faces]:
    """Return start and end of the directed edges that no face passes the other way."""
    tail, head = directed_edges(corners)
    count = int(corners.max()) + 1
    lonely = ~np.isin(tail * count + head, head * count + tail)
    return tail[lonely], head[lonely]


def is_closed(corners: Faces) -> bool:
    """Return whether every edge is passed equally often in both directions, so that the surface is closed."""
    tail, head = directed_edges(corners)
    count = int(corners.max()) + 1
    return bool((tail != head).all() and (np.sort(tail * count + head) == np.sort(head * count + tail)).all())


def edge_mates(corners: Faces) -> tuple[Faces, Faces, bool]:
    """Return pairs of directed edges between the same vertices, and whether any edge has more than two faces."""
    tail, head = directed_edges(corners)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    return order[:-1][same], order[1:][same], bool((same[1:] & same[:-1]).any())


def equal_faces(corners: Faces) -> tuple[Faces, Faces]:
    """Return the first of equal faces, with the same vertices in the same sense, and which of those each face is."""
    turned = np.take_along_axis(corners, (np.argmin(corners, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, first, copy = np.unique(turned, axis=0, return_index=True, return_inverse=True)
    return first, copy.ravel()


def components(one: NDArray, two: NDArray, count: int) -> Faces:
    """Return for each of so many things the number of those that pairs connect it to, shape (count,)."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    graph = csr_matrix((np.ones(len(one)), (one, two)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)
