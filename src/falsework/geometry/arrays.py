"""Operations on arrays of points and rows that geometry and those who draw it have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rows:
    """Base of tables: dataclasses whose fields are arrays with a row for each entry of the table."""

    def take(self, chosen: Any) -> Self:
        """Return those rows alone, in that order; `chosen` is what arrays of rows are indexed with."""
        return type(self)(*(getattr(self, column.name)[chosen] for column in fields(self)))

    @classmethod
    def join(cls, tables: Sequence[Self]) -> Self:
        """Return all rows of several tables, one after the other."""
        return cls(*(np.concatenate([getattr(one, column.name) for one in tables]) for column in fields(cls)))


def read_only(*arrays: Any) -> tuple[Any, ...]:
    """Make arrays read-only, in place, and return them."""
    for array in arrays:
        array.setflags(write=False)
    return arrays


def segment_sum(values: Array, owner: NDArray[np.integer], count: int) -> Array:
    """Return the sum of the rows of each owner, shape (count, columns)."""
    columns = [np.bincount(owner, column, count) for column in values.T]
    return np.stack(columns, axis=1).astype(np.float64)


def segment_mean(values: Array, owner: NDArray[np.integer], count: int) -> Array:
    """Return the mean of the rows of each owner, shape (count, columns); zero for an owner without rows."""
    return segment_sum(values, owner, count) / np.maximum(np.bincount(owner, minlength=count), 1)[:, None]


def box_around(points: Array) -> Array:
    """Return the lowest and highest coordinates of points, shape (2, 3)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def box_corners(box: Array) -> Array:
    """Return the corners of a box, whose lowest and highest coordinates have shape (2, 3); shape (8, 3)."""
    return np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def apply(matrix: Array, points: Array) -> Array:
    """Return points, shape (..., 3), displaced by a matrix of shape (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
