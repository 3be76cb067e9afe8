"""Rows of parts from the free edges of a shell inwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask

_LARGEST_SHARE = 0.3
"""Share of the parts at free edges at most; where more are at edges, the structure has no rows behind them."""

_SHORTEST_ARCH = 3
"""Parts at an edge at least; fewer need no order."""


def edge_rows(pairs: NDArray[np.integer], boundary: Mask) -> NDArray[np.intp] | None:
    """Return how many contacts each part is away from the nearest free edge between two supports.

    Around a part inside a shell one block thick the neighbours touch each other in a ring, so each touches two others
    of them. At a free edge the ring is open. An edge that does not reach from one support to another, such as that of
    the opening at the top of a dome, is no arch that could be closed first.

    Args:
        pairs: parts in contact, shape (contacts, 2).
        boundary: parts that are supports, shape (parts,).

    Returns:
        Shape (parts,), 0 at an edge; None where there is no such edge, or it is not one of a shell.
    """
    beside: list[set[int]] = [set() for _ in boundary]
    for one, other in pairs.tolist():
        beside[one].add(other)
        beside[other].add(one)
    inner = set(np.flatnonzero(~boundary).tolist())
    edge = {part for part in inner if any(len(beside[part] & beside[other]) < 2 for other in beside[part])}
    row = np.full(len(boundary), -1, dtype=np.intp)
    while edge:
        piece = _reached([edge.pop()], beside, edge)
        edge -= piece
        supports = {other for part in piece for other in beside[part] if boundary[other]}
        if len(supports) > 1 and len(piece) >= _SHORTEST_ARCH:
            row[list(piece)] = 0
    front = np.flatnonzero(row == 0).tolist()
    if not front or len(front) > _LARGEST_SHARE * len(inner):
        return None
    while front:
        number = int(row[front[0]]) + 1
        near = set().union(*(beside[part] for part in front))
        front = [part for part in near & inner if row[part] < 0]
        row[front] = number
    row[row < 0] = row.max()
    return row


def _reached(front: list[int], beside: list[set[int]], among: set[int]) -> set[int]:
    """Return the parts that are reached from some by contacts among others, the first ones included."""
    found = set(front)
    while front:
        fresh = (beside[front.pop()] & among) - found
        found |= fresh
        front += fresh
    return found
