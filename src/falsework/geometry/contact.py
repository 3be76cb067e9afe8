"""Contacts between parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Contacts:
    """Planar contacts between pairs of parts; a curved interface is several contacts."""

    parts: NDArray[np.int32]
    """Shape (contacts, 2): part `a` and part `b`, `a < b`, sorted."""
    frames: NDArray[np.float64]
    """Shape (contacts, 3, 3): rows are normal (from `a` to `b`), first and second tangent; right-handed."""
    points: NDArray[np.float64]
    """Contact points, shape (points, 3), metres: per contact the corners of its convex hull."""
    start: NDArray[np.int32]
    """Shape (contacts + 1,): contact `k` owns `points[start[k]:start[k + 1]]`."""
    areas: NDArray[np.float64]
    """Shape (contacts,), m2."""

    def __len__(self) -> int:
        return len(self.parts)

    @property
    def contact_of_point(self) -> NDArray[np.int32]:
        """Contact that each contact point belongs to, shape (points,)."""
        return np.repeat(np.arange(len(self.parts), dtype=np.int32), np.diff(self.start))
