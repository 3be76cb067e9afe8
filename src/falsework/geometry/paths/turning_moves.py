"""Turns and screws out of a pose: about which axes a part can begin to turn, and where it may stop."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import apply, box_corners
from falsework.geometry.clearance.moves import PathMove, Poses
from falsework.geometry.mesh.mesh import triangle_normals
from falsework.geometry.paths.axes import Axis, axes_of
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.stops import face_normals

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_HOME = np.eye(4)
_AHEAD = 0.15
"""Sine of the angle between a face and the circle of its middle from which on a turn moves it ahead."""


class TurningMoves:
    """Turns of one part past all others.

    A turn may end where faces of the part become parallel to faces of others, and where it is not free to go on; a
    screw where the part is out of the box around the others, or where it is not free to go on.
    """

    def __init__(self, motions: PartMotions, part: int, there: Mask) -> None:
        """Take the part that turns, and all that are there, shape (parts,)."""
        self._motions, self._part, self._there = motions, part, there
        self._others = [int(other) for other in np.flatnonzero(there) if other != part]
        self.walls = np.zeros_like(there)
        """Parts that a turn has hit so far, shape (parts,)."""

    def moves(self, poses: Poses, box: Array) -> Iterator[PathMove]:
        """Yield the free turns from poses, longest first for each axis.

        Args:
            poses: parts that are not in place.
            box: lowest and highest coordinates of all others, shape (2, 3), metres.
        """
        if not self._others:
            return
        own = apply(poses.get(self._part, _HOME), self._motions.meshes[self._part].triangles)
        others = [apply(poses.get(other, _HOME), self._motions.meshes[other].triangles) for other in self._others]
        thickness = self._motions.meshes[self._part].thickness
        for axis in axes_of(own, others, self._motions.tolerance, thickness):
            yield from self._along(axis, own, others, poses, box)

    def _along(self, axis: Axis, own: Array, others: list[Array], poses: Poses, box: Array) -> Iterator[PathMove]:
        whole = self._whole(axis, own, box)
        first = whole.until(min(1.0, 4 * self._motions.tolerance / whole.length(own)))
        hit = self._motions.blockers(first, self._there, poses, stop=True)
        self.walls |= hit
        if hit.any():
            return
        share, hit = self._motions.free_share(whole, self._there, poses)
        self.walls |= hit
        angles = [share * whole.angle] if share > 0 else []
        if axis.pitch == 0.0:
            parallel = _parallel_angles(axis, own, others)
            angles += [angle for angle in parallel if angle < whole.angle]
        for angle in sorted(set(angles), reverse=True):
            move = whole.until(angle / whole.angle)
            if (
                move.length(own) > 4 * self._motions.tolerance
                and not self._motions.blockers(move, self._there, poses, stop=True).any()
            ):
                yield move

    def _whole(self, axis: Axis, own: Array, box: Array) -> PathMove:
        """Return the longest move: a whole turn, or a screw until the part is beside the box around the others."""
        direction, angle, distance = axis.direction, 2 * np.pi, 0.0
        if axis.pitch != 0.0:
            sense = np.sign(axis.pitch)
            direction = sense * direction
            distance = float((box_corners(box) @ direction).max() - (own.reshape(-1, 3) @ direction).min())
            angle = sense * distance / abs(axis.pitch)
        (x, y, z), (a, b, c) = (direction + 0.0).tolist(), axis.point.tolist()
        return PathMove((self._part,), (x, y, z), distance, float(angle), (a, b, c))


def _ahead(axis: Axis, triangles: Array) -> Array:
    """Return the faces that look ahead or back in a turn, shape (faces, 3, 3): on those around the axis parts slide."""
    normals, arms = triangle_normals(triangles), triangles.mean(axis=1) - axis.point
    radius = np.linalg.norm(np.cross(arms, axis.direction), axis=1)
    speed = np.abs(np.einsum("ij,ij->i", normals, np.cross(axis.direction, arms)))
    return triangles[speed > _AHEAD * radius * np.linalg.norm(normals, axis=1)]


def _parallel_angles(axis: Axis, own: Array, others: list[Array]) -> list[float]:
    """Return the angles below a whole turn at which a face of a part becomes parallel to one of others, ascending."""
    turned, rest = _ahead(axis, own), _ahead(axis, np.concatenate(others))
    if not len(turned) or not len(rest):
        return []
    mine, theirs = face_normals([turned])[0], face_normals([rest])[0]
    direction, found = axis.direction, []
    one = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    one /= np.linalg.norm(one)
    two = np.cross(direction, one)
    for a in (*mine, *-mine):
        for b in theirs:
            level_a, level_b = a @ direction, b @ direction
            if abs(level_a - level_b) > 1e-6 or abs(level_a) > 1 - 1e-6:
                continue
            turn = np.arctan2(b @ two, b @ one) - np.arctan2(a @ two, a @ one)
            found.append(float(turn % (2 * np.pi)))
    return sorted({round(angle, 9) for angle in found if angle > 1e-6})
