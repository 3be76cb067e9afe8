"""Overlap polygons of opposed faces of two parts, from which contacts are made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.contact.creases import Surface
from falsework.geometry.mesh.boxes import pairs_of_groups
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]

_CHUNK = 200_000
"""Pairs of faces that are intersected at once; bounds the memory of very fine meshes."""
_SLACK = 1.01
"""Growth of the boxes of faces beyond what the distances demand, so that rounding loses no pair."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Pieces of two opposed faces that cover each other; one patch a pair of triangles."""

    parts: NDArray[np.int32]
    """Part `a` and part `b`, `a < b`, shape (patches, 2)."""
    normals: Array
    """From `a` to `b`, unit length, shape (patches, 3)."""
    areas: Array
    """Shape (patches,), m2."""
    points: Array
    """Corners, midway between the two faces, shape (points, 3), metres."""
    owner: NDArray[np.int64]
    """Patch of every corner, ascending, shape (points,)."""
    gaps: Array
    """Distance of the two faces at every corner, along the normal, negative where they overlap, shape (points,),
    metres."""
    faces: NDArray[np.int64]
    """Face of part `a` and of part `b`, shape (patches, 2)."""
    lean: Array
    """Angle between the normal of the patch and that of either face, half of the one between them, shape (patches,),
    radians."""

    @staticmethod
    def none() -> Patches:
        """Return no patches."""
        ints, vectors, numbers = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)), np.zeros(0)
        return Patches(
            ints.astype(np.int32), vectors, numbers, vectors, np.zeros(0, dtype=np.int64), numbers, ints, numbers
        )

    @cached_property
    def distance(self) -> Array:
        """Smallest and largest distance of the two faces over each patch, shape (patches, 2), metres."""
        distance = np.full((len(self.areas), 2), (np.inf, -np.inf))
        np.minimum.at(distance[:, 0], self.owner, self.gaps)
        np.maximum.at(distance[:, 1], self.owner, self.gaps)
        return distance

    @staticmethod
    def join(found: Sequence[Patches]) -> Patches:
        """Return all patches of several, none of none."""
        found = found or [Patches.none()]
        first = np.repeat(
            np.cumsum([0, *(len(patches.areas) for patches in found[:-1])]), [len(patches.owner) for patches in found]
        )
        columns = {one.name: np.concatenate([getattr(some, one.name) for some in found]) for one in fields(Patches)}
        return Patches(**{**columns, "owner": columns["owner"] + first})

    def take(self, chosen: NDArray[np.bool_]) -> Patches:
        """Return the chosen patches alone, shape (patches,)."""
        corners = chosen[self.owner]
        owner = (np.cumsum(chosen) - 1)[self.owner[corners]]
        return Patches(
            self.parts[chosen],
            self.normals[chosen],
            self.areas[chosen],
            self.points[corners],
            owner,
            self.gaps[corners],
            self.faces[chosen],
            self.lean[chosen],
        )


def face_patches(
    meshes: Sequence[TriangleMesh], *, gap: float, overlap: float, angle: float, least: float | None = None
) -> Patches:
    """Intersect all pairs of opposed, nearly coplanar faces of different parts.

    Two faces are opposed if their outward normals differ from opposite by at most `angle`. They touch where
    the distance from one to the other along the mean normal lies in `[-overlap, gap]`.

    Args:
        gap: largest distance between touching faces, metres; negative to find overlapping ones alone.
        overlap: largest depth to which touching faces may pass through each other, metres.
        angle: degrees.
        least: side of a square whose area is rounding, metres; None: a thousandth of the larger of gap and overlap.
    """
    faces = Surface.from_meshes(meshes)
    least = max(gap, overlap) / 1000 if least is None else least
    count = len(faces.part)
    return Patches.join(
        [
            intersect_faces(faces, i, j, gap=np.full(len(i), gap), overlap=np.full(len(i), overlap), least=least)
            for i, j in opposed_faces(faces, np.full(count, gap), np.full(count, overlap), angle)
        ]
    )


def opposed_faces(
    faces: Surface, gap: Array, overlap: Array, angle: float, among: NDArray[np.bool_] | None = None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield pairs of faces that look at each other and may touch, as far as their boxes tell; in chunks.

    Args:
        gap: largest distance between each face and others that touch it, shape (faces,), metres.
        overlap: largest depth to which others that touch each face may pass through it, shape (faces,), metres.
        angle: largest angle between the faces, degrees.
        among: whether faces of two parts are compared, shape (parts, parts); None: all.
    """
    boxes = np.stack([faces.corners.min(axis=1), faces.corners.max(axis=1)])
    # Distances count along the mean normal of two faces, which differs from that of either by half of their angle.
    turn = np.arccos(np.clip(faces.normals, -1.0, 1.0))
    up, down = (np.cos(np.clip(turned - np.radians(angle / 2), 0.0, np.pi / 2)) for turned in (turn, np.pi - turn))
    ahead, behind = np.maximum(gap, 0.0)[:, None], np.maximum(overlap, 0.0)[:, None]
    growth = np.stack([-np.maximum(ahead * down, behind * up), np.maximum(ahead * up, behind * down)])
    limit = -np.cos(np.radians(angle))
    for i, j in pairs_of_groups(boxes, boxes + _SLACK * growth, faces.part, among):
        keep = np.einsum("ij,ij->i", faces.normals[i], faces.normals[j]) <= limit
        i, j = i[keep], j[keep]
        for chunk in range(0, len(i), _CHUNK):
            yield i[chunk : chunk + _CHUNK], j[chunk : chunk + _CHUNK]


def intersect_faces(
    faces: Surface,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    *,
    gap: Array,
    overlap: Array,
    least: float | None = None,
) -> Patches:
    """Project pairs of faces along their mean normal, intersect them, and keep what is near enough.

    Args:
        i: first face of each pair, shape (pairs,).
        j: second face of each pair, shape (pairs,).
        gap: largest distance between the faces of each pair, shape (pairs,), metres.
        overlap: largest depth to which they may pass through each other, shape (pairs,), metres.
        least: side of a square whose area is rounding, metres; None: a thousandth of the larger of gap and overlap.
    """
    normals = faces.normals[i] - faces.normals[j]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    beside = _balls_may_touch(faces, i, j, normals, gap=gap, overlap=overlap)
    i, j, normals, gap, overlap = i[beside], j[beside], normals[beside], gap[beside], overlap[beside]
    origin = faces.corners[i].mean(axis=1)
    frames = frames_of(normals)
    a = np.einsum("kij,kvj->kvi", frames, faces.corners[i] - origin[:, None])
    b = np.einsum("kij,kvj->kvi", frames, faces.corners[j] - origin[:, None])
    # In the frame (n, t1, t2) a face is the graph of a linear height over (t1, t2).
    slope_a = _slopes(frames, faces.normals[i])
    slope_b = _slopes(frames, faces.normals[j])
    level_a = a[:, 0, 0] - np.einsum("ki,ki->k", slope_a, a[:, 0, 1:])
    level_b = b[:, 0, 0] - np.einsum("ki,ki->k", slope_b, b[:, 0, 1:])
    slope, level = slope_b - slope_a, level_b - level_a

    near = _may_touch(a[:, :, 1:], b[:, :, 1:], slope, level, gap=gap, overlap=overlap)
    a, b, slope, level, gap, overlap = a[near], b[near], slope[near], level[near], gap[near], overlap[near]
    corners, count = _common(a[:, :, 1:], b[:, :, 1:])
    for side, limit in ((1.0, gap), (-1.0, overlap)):  # where the height of the second above the first is in its band
        slack = 1e-6 * np.maximum(gap, overlap)  # rounding must not cut parallel faces at the limit
        corners, count = _clipped(corners, count, side * slope, limit + slack - side * level)
    areas = _areas(corners, count)
    rounding = np.maximum(gap, overlap) / 1000 if least is None else np.full(len(areas), least)
    solid = areas > rounding**2  # touching edges leave slivers of rounding
    corners, count, areas = corners[solid], count[solid], areas[solid]
    kept = np.flatnonzero(near)[solid]

    owner = np.repeat(np.arange(len(count)), count)
    flat = corners[np.arange(corners.shape[1]) < count[:, None]]
    source = kept[owner]
    height = np.einsum("pi,pi->p", slope_a[source] + slope_b[source], flat) + level_a[source] + level_b[source]
    local = np.column_stack([height / 2, flat])
    gaps = level_b[source] - level_a[source] + np.einsum("pi,pi->p", slope_b[source] - slope_a[source], flat)
    return Patches(
        parts=np.stack([faces.part[i[kept]], faces.part[j[kept]]], axis=1),
        normals=normals[kept],
        areas=areas,
        points=origin[source] + np.einsum("pji,pj->pi", frames[source], local),
        owner=owner,
        gaps=gaps,
        faces=np.stack([i[kept], j[kept]], axis=1),
        lean=np.arcsin(np.minimum(np.linalg.norm(faces.normals[i[kept]] + faces.normals[j[kept]], axis=1) / 2, 1.0)),
    )


def _balls_may_touch(
    faces: Surface, i: NDArray[np.int64], j: NDArray[np.int64], normals: Array, *, gap: Array, overlap: Array
) -> NDArray[np.bool_]:
    """Test whether balls around pairs of faces are beside each other, and their distance along the normal in its band.

    Boxes of faces that look along no axis have much space around them, and this is cheaper than a projection.
    """
    centre, radius = faces.balls
    arm, reach = centre[j] - centre[i], _SLACK * (radius[i] + radius[j])
    ahead = np.einsum("ki,ki->k", arm, normals)
    aside = np.einsum("ki,ki->k", arm, arm) - ahead**2
    swing = reach * np.linalg.norm(faces.normals[i] + faces.normals[j], axis=1) / 2
    slack = (_SLACK - 1.0) * np.maximum(np.abs(gap), overlap)
    return (aside <= reach**2) & (ahead - swing <= gap + slack) & (ahead + swing >= -overlap - slack)


def frames_of(normals: Array) -> Array:
    """Return right-handed frames `(n, t1, t2)` as rows, shape (count, 3, 3).

    `t1` is horizontal, and lies along x where the normal is vertical, so that a frame depends on nothing
    but the normal.
    """
    up = np.abs(normals[:, 2:]) > 0.999
    tangent = np.where(up, np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
    first = np.cross(tangent, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([normals, first, np.cross(normals, first)], axis=1).astype(np.float64, copy=False)


def _slopes(frames: Array, face_normals: Array) -> Array:
    """Return the gradient of the height of faces over the tangents of their frames, shape (pairs, 2)."""
    local: Array = np.einsum("kij,kj->ki", frames, face_normals)
    return -local[:, 1:] / local[:, :1]


def _may_touch(a: Array, b: Array, slope: Array, level: Array, *, gap: Array, overlap: Array) -> NDArray[np.bool_]:
    """Test cheap necessary conditions: flat boxes overlap, and the gap enters its band somewhere over them."""
    low = np.maximum(a.min(axis=1), b.min(axis=1))
    high = np.minimum(a.max(axis=1), b.max(axis=1))
    middle = level + np.einsum("ki,ki->k", slope, (low + high) / 2)
    swing = np.einsum("ki,ki->k", np.abs(slope), np.abs(high - low)) / 2
    return (low < high).all(axis=1) & (middle - swing <= gap) & (middle + swing >= -overlap)


def _common(a: Array, b: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return what pairs of triangles, shape (pairs, 3, 2), have in common; polygons as of `_clipped`.

    General polygon overlay decides which edges cross, and loses the whole polygon where rounding makes it contradict
    itself. Here an edge nearly in line with another moves a corner by rounding at most.
    """
    corners, count = a, np.full(len(a), 3)
    edges = np.roll(b, -1, axis=1) - b
    double = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    count[double == 0.0] = 0
    for side in range(3):
        outwards = np.sign(double)[:, None] * np.stack([edges[:, side, 1], -edges[:, side, 0]], axis=1)
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1), 1e-300)[:, None]
        corners, count = _clipped(corners, count, outwards, np.einsum("ki,ki->k", outwards, b[:, side]))
    return corners, count


def _clipped(corners: Array, count: NDArray[np.int64], uphill: Array, limit: Array) -> tuple[Array, NDArray[np.int64]]:
    """Clip convex polygons by a half plane each (Sutherland and Hodgman, 1974).

    Args:
        corners: shape (polygons, slots, 2); the first ones count.
        count: corners of each polygon, shape (polygons,).
        uphill: shape (polygons, 2).
        limit: what the product with it is at most where a polygon is kept, shape (polygons,).

    Returns:
        The same for what is left, with more slots if need be.
    """
    slots = corners.shape[1]
    there = np.arange(slots) < count[:, None]
    above = np.einsum("ksi,ki->ks", corners, uphill) - limit[:, None]
    outside = (above > 0.0) & there
    cut = np.flatnonzero(outside.any(axis=1))
    if not len(cut):
        return corners, count
    following = (np.arange(slots) + 1) % np.maximum(count[cut], 1)[:, None]
    here, height = corners[cut], above[cut]
    then, next_height = np.take_along_axis(here, following[:, :, None], 1), np.take_along_axis(height, following, 1)
    crosses = there[cut] & (height * next_height < 0.0)
    share = height / np.where(crosses, height - next_height, 1.0)
    both = np.stack([here, here + share[:, :, None] * (then - here)], axis=2).reshape(len(cut), -1, 2)
    kept = np.stack([there[cut] & ~outside[cut], crosses], axis=2).reshape(len(cut), -1)
    count = count.copy()
    count[cut] = kept.sum(axis=1)
    more = max(int(count.max()) - slots, 0)
    first = np.argsort(~kept, axis=1, kind="stable")[:, : slots + more]
    corners = np.pad(corners, ((0, 0), (0, more), (0, 0)))
    corners[cut] = np.take_along_axis(both, first[:, :, None], 1)
    return corners, count


def _areas(corners: Array, count: NDArray[np.int64]) -> Array:
    """Return the areas of convex polygons as of `_clipped`, shape (polygons,)."""
    arms = np.where((np.arange(corners.shape[1]) < count[:, None])[:, :, None], corners - corners[:, :1], 0.0)
    double = arms[:, 1:-1, 0] * arms[:, 2:, 1] - arms[:, 1:-1, 1] * arms[:, 2:, 0]
    return np.abs(double.sum(axis=1)) / 2
