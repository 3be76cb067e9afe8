"""Contacts between pairs of parts, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import read_only, segment_mean
from falsework.geometry.contact.creases import expand
from falsework.geometry.contact.joints import JointReport

Array = NDArray[np.float64]

PARALLEL = 1e-4
"""Angle in radians, beyond that of friction, up to which surfaces count as parallel: a force along a normal that is
inclined by so much leaves a residual of this share of it, as much as is allowed."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts between pairs of parts: planar ones, of which a curved interface is several, and lines and points.

    The arrays become read-only. Lines and points arise where parts touch by an edge or a corner. Real ones have some
    width, which the meshes do not contain; `areas` assumes the default gap, so that they have a small, nonzero weight
    wherever contacts are weighted by area.
    """

    parts: NDArray[np.int32]
    """Shape (contacts, 2): part `a` and part `b`, `a < b`, sorted."""
    frames: NDArray[np.float64]
    """Shape (contacts, 3, 3): rows are normal (from `a` to `b`), first and second tangent; right-handed. Of a curved
    interface the frame of its mean normal."""
    points: NDArray[np.float64]
    """Contact points, shape (points, 3), metres: per contact the corners of its convex hull, at least three; the two
    ends of a line; or one point."""
    start: NDArray[np.int32]
    """Shape (contacts + 1,): contact `k` owns `points[start[k]:start[k + 1]]`."""
    areas: NDArray[np.float64]
    """Shape (contacts,), m2, above zero. Nominal for a line, its length times the default gap, and for a point, the
    square of that."""
    report: JointReport = field(default_factory=JointReport.none)
    """Joints whose overlap or gap was beyond the tolerance, and was divided between the two parts."""
    curved: NDArray[np.float64] | None = None
    """Frame of every contact point, shape (points, 3, 3), if some lie on curved interfaces; None: that of the contact.
    Read `point_frames` instead."""
    lean: NDArray[np.float64] | None = None
    """Largest angle between the normal of every contact point and that of either surface there, shape (points,),
    radians; None: all are zero. Read `point_lean` instead."""

    def __post_init__(self) -> None:
        read_only(*(array for array in vars(self).values() if isinstance(array, np.ndarray)))

    def __len__(self) -> int:
        return len(self.parts)

    def __repr__(self) -> str:
        return f"<Contacts: {len(self)} with {len(self.points)} points>"

    @property
    def contact_of_point(self) -> NDArray[np.int32]:
        """Contact that each contact point belongs to, shape (points,)."""
        return np.repeat(np.arange(len(self.parts), dtype=np.int32), np.diff(self.start))

    @cached_property
    def point_frames(self) -> NDArray[np.float64]:
        """Frame of every contact point, with the normal of the surface at that point, shape (points, 3, 3)."""
        return self.frames[self.contact_of_point] if self.curved is None else self.curved

    @cached_property
    def point_lean(self) -> NDArray[np.float64]:
        """Angle by which either surface may be inclined to the normal at every contact point, shape (points,)."""
        return np.zeros(len(self.points)) if self.lean is None else self.lean

    def idle(self, friction: NDArray[np.float64] | float) -> NDArray[np.bool_]:
        """Return the points that carry nothing: no force lies in the friction cones of both surfaces, shape (points,).

        Args:
            friction: coefficient of all points, or of each.
        """
        return np.arctan(friction) < self.point_lean - PARALLEL

    @property
    def centres(self) -> NDArray[np.float64]:
        """Mean of the points of each contact, shape (contacts, 3), metres."""
        return segment_mean(self.points, self.contact_of_point, len(self))

    @property
    def dimension(self) -> NDArray[np.int8]:
        """2 for contacts with an area, 1 for lines, 0 for points; shape (contacts,)."""
        return np.minimum(np.diff(self.start) - 1, 2).astype(np.int8)

    @property
    def width(self) -> NDArray[np.float64]:
        """Twice the area over the perimeter of each contact, zero for lines and points; shape (contacts,), metres."""
        ahead = np.arange(1, len(self.points) + 1)
        ahead[self.start[1:] - 1] = self.start[:-1]
        sides = np.linalg.norm(self.points[ahead] - self.points, axis=1)
        perimeter = np.bincount(self.contact_of_point, sides, len(self))
        return np.where(self.dimension == 2, 2 * self.areas / np.maximum(perimeter, 1e-300), 0.0)

    @property
    def normals(self) -> NDArray[np.float64]:
        """Unit normals from part `a` to part `b`, shape (contacts, 3)."""
        return self.frames[:, 0]

    def points_of(self, chosen: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the indices of the points of contacts, one contact after another."""
        return expand(self.start[chosen], self.start[np.asarray(chosen) + 1])[1]

    def touched(self, parts: int | Sequence[int], part_count: int) -> NDArray[np.bool_]:
        """Return the parts that touch some parts, these too if anything touches them, shape (parts,)."""
        found = np.zeros(part_count, dtype=bool)
        found[self.parts[np.isin(self.parts, parts).any(axis=1)]] = True
        return found

    def take(self, chosen: NDArray[np.integer]) -> Contacts:
        """Return those contacts alone, in that order."""
        points = self.points_of(chosen)
        return Contacts(
            self.parts[chosen],
            self.frames[chosen],
            self.points[points],
            np.concatenate([[0], np.cumsum(np.diff(self.start)[chosen])]).astype(np.int32),
            self.areas[chosen],
            report=self.report,
            curved=None if self.curved is None else self.curved[points],
            lean=None if self.lean is None else self.lean[points],
        )

    def join(self, other: Contacts) -> Contacts:
        """Return these contacts and then the other ones, unsorted, with the report of these."""
        flat = self.curved is None and other.curved is None
        parallel = self.lean is None and other.lean is None
        return Contacts(
            np.concatenate([self.parts, other.parts]),
            np.concatenate([self.frames, other.frames]),
            np.concatenate([self.points, other.points]),
            np.concatenate([self.start, self.start[-1] + other.start[1:]]).astype(np.int32),
            np.concatenate([self.areas, other.areas]),
            report=self.report,
            curved=None if flat else np.concatenate([self.point_frames, other.point_frames]),
            lean=None if parallel else np.concatenate([self.point_lean, other.point_lean]),
        )

    def flat(self) -> Contacts:
        """Return the same points in contacts that have one frame each: those of curved interfaces become one a point.

        The areas are shared out among the points.
        """
        if self.curved is None:
            return self
        owner, count = self.contact_of_point, np.diff(self.start)
        bent = np.zeros(len(self), dtype=bool)
        bent[owner[(self.curved != self.frames[owner]).any(axis=(1, 2))]] = True
        first = bent[owner]
        first[self.start[:-1]] = True
        rows = np.flatnonzero(first)
        contact = owner[rows]
        areas = self.areas / np.where(bent, count, 1)
        start = np.append(rows, len(owner)).astype(np.int32)
        arrays = self.parts[contact], self.curved[rows], self.points, start, areas[contact]
        return Contacts(*arrays, report=self.report, lean=self.lean)

    def pushes(self, part_count: int) -> NDArray[np.float64]:
        """Return the area times normal into part `i` of all its contacts with part `j`, m2, shape (parts, parts, 3)."""
        return self._pushes(part_count, self.areas)

    def narrow_pushes(self, part_count: int) -> NDArray[np.float64]:
        """Return the normals into part `i` of its lines and points with part `j`, shape (parts, parts, 3)."""
        return self._pushes(part_count, (self.dimension < 2).astype(np.float64))

    def _pushes(self, part_count: int, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        push = np.zeros((part_count, part_count, 3))
        first, second = self.parts.T
        weighted = weights[:, None] * self.normals
        np.add.at(push, (first, second), -weighted)
        np.add.at(push, (second, first), weighted)
        return push
