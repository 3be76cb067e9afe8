"""Joints: surfaces of two parts that face each other with overlaps and gaps beyond the contact tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falsework.errors import AssemblyError
from falsework.geometry.arrays import read_only
from falsework.geometry.contact.creases import Surface
from falsework.geometry.contact.grouping import planes
from falsework.geometry.contact.overlap import Overlaps, coarse_depth, depth, too_deep, vertex_depth
from falsework.geometry.contact.patches import Patches, intersect_faces, opposed_faces
from falsework.geometry.mesh.collision import inside, interpenetrate
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]

OVERLAP = 1 / 3
"""Largest overlap of a joint, as a share of the extent of the smaller part along the normal: at half the extent the
far sides of two equal parts are as near to each other as those that should touch."""
GAP = 1 / 20
"""Largest gap of a joint whose surfaces meet elsewhere, as a share of the same extent."""
BRIDGED = 1 / 100
"""Largest gap of a joint whose surfaces meet nowhere, as a share of the same extent. A part that closes it by tilting
about its other supports turns by about this angle in radians, which changes the friction that it needs by 0.01."""
_THROUGH = 0.95
"""Largest overlap of a joint, as a share of the thickness of the thinner part. Cubes reach `OVERLAP` first."""
_MANY_VERTICES = 500
"""Vertices from which the extent of a part is that of the corners of its hull."""
_ANGLE = 30.0
"""Largest angle between surfaces that face each other, degrees: two tessellations of one warped face differ by 20."""


@dataclass(frozen=True, eq=False)
class JointReport:
    """Joints that were resolved: what overlap and gap their middle surfaces divide; one row a pair of parts."""

    parts: NDArray[np.int32]
    """Part `a` and part `b`, `a < b`, sorted; shape (joints, 2)."""
    overlap: NDArray[np.float64]
    """Largest depth to which the surfaces pass through each other, along their normal, shape (joints,), metres."""
    gap: NDArray[np.float64]
    """Largest distance between the surfaces, along their normal, shape (joints,), metres."""

    def __len__(self) -> int:
        return len(self.parts)

    @staticmethod
    def none() -> JointReport:
        """Return the report of a structure whose parts all touch within the tolerances."""
        return JointReport(np.zeros((0, 2), dtype=np.int32), np.zeros(0), np.zeros(0))

    @staticmethod
    def from_patches(patches: Patches) -> JointReport:
        """Sum up patches by pairs of parts."""
        parts, joint = np.unique(patches.parts, axis=0, return_inverse=True)
        distance = np.zeros((2, len(parts)))
        np.minimum.at(distance[0], joint.ravel(), patches.distance[:, 0])
        np.maximum.at(distance[1], joint.ravel(), patches.distance[:, 1])
        return JointReport(*read_only(parts.astype(np.int32).reshape(-1, 2), -distance[0] + 0.0, distance[1]))

    def line(self, names: Sequence[str]) -> str:
        """Return one line that says how many joints were resolved, and the worst of them."""

        def worst(values: NDArray[np.float64]) -> str:
            a, b = self.parts[values.argmax()].tolist()
            return f"{format_quantity(float(values.max()), 'length')} (parts {names[a]} and {names[b]})"

        count = f"{len(self)} joints have" if len(self) > 1 else "1 joint has"
        return (
            f"{count} overlaps or gaps beyond the contact tolerance, which were divided between the two parts: "
            f"overlap up to {worst(self.overlap)}, gap up to {worst(self.gap)}"
        )


@dataclass(frozen=True, eq=False)
class JointSurfaces:
    """Middle surfaces of joints."""

    patches: Patches
    group: NDArray[np.int64]
    """Contact that each patch belongs to, shape (patches,)."""
    bound: Array
    """Largest overlap that is allowed to the joint of two parts, zero for pairs without one, shape (parts, parts),
    metres."""
    bridged: Array
    """Largest gap that is bridged between two parts whose surfaces meet nowhere, zero for pairs without a joint, shape
    (parts, parts), metres."""

    def take(self, chosen: NDArray[np.bool_]) -> JointSurfaces:
        """Return the chosen patches alone, shape (patches,)."""
        group = np.unique(self.group[chosen], return_inverse=True)[1]
        return JointSurfaces(self.patches.take(chosen), group, self.bound, self.bridged)

    def without_far_sides(self, meshes: Sequence[TriangleMesh], overlaps: Overlaps) -> JointSurfaces:
        """Leave out patches that are deeper than the thinner part is thick, of parts that do not overlap.

        Nested cups that do not touch have such patches: the inside of one is opposed to the outside of the other.
        """
        thickness = np.array([mesh.thickness for mesh in meshes])
        apart = np.ones(self.bound.shape, dtype=bool)
        apart[tuple(overlaps.parts.T)] = False
        deep = -self.patches.distance[:, 0] > _THROUGH * thickness[self.patches.parts].min(axis=1)
        return self.take(~(deep & apart[tuple(self.patches.parts.T)]))

    def near(self, tolerance: float) -> NDArray[np.bool_]:
        """Return whether two parts are so near to each other that a gap between them is an inaccuracy.

        A part that is shifted by some length overlaps neighbours on one side by this length, and has a gap on the
        other; where both parts are shifted, the gap is twice as wide. Wider gaps are meant, as are those of parts that
        overlap nothing, and a support that is not there must not carry: so is a gap above `BRIDGED`.

        Args:
            tolerance: metres.

        Returns:
            Shape (parts, parts).
        """
        pair = tuple(self.patches.parts.T)
        least = np.full(self.bound.shape, np.inf)
        np.minimum.at(least, pair, self.patches.distance[:, 0])
        allowed = np.full(len(least), tolerance)
        for parts in pair:
            np.maximum.at(allowed, parts, -2 * self.patches.distance[:, 0])
        shifted = np.minimum(np.maximum(allowed[:, None], allowed), self.bridged)
        return least <= np.maximum(shifted, tolerance)


def find_joints(
    meshes: Sequence[TriangleMesh], among: NDArray[np.bool_], angle: float, narrowest: float
) -> JointSurfaces:
    """Intersect surfaces of parts that face each other, within bounds that depend on the parts alone.

    Two faces belong to one joint if their outward normals differ from opposite by at most 30 degrees and their
    distance along the mean normal lies between minus `OVERLAP` and plus `GAP` of the extent of the smaller part along
    its own normal. The patches lie midway, so that together they make the middle surface, which is cut into contacts
    of patches whose normals differ little. Where a joint has an overlap, the sides of the two parts overlap as well, in
    a narrow strip and by much more: a contact that is narrower than it is deep is left out.

    Args:
        among: whether two parts may have a joint, shape (parts, parts).
        angle: largest angle between the normals of patches of one contact, degrees.
        narrowest: width below which a contact is left out, metres.
    """
    faces = Surface.from_meshes(meshes)
    extent = np.concatenate(
        [_extents(mesh.vertices, faces.normals[faces.part == part]) for part, mesh in enumerate(meshes)]
    )
    found = []
    for i, j in opposed_faces(faces, GAP * extent, OVERLAP * extent, _ANGLE, among):
        smaller = np.minimum(extent[i], extent[j])
        found.append(intersect_faces(faces, i, j, gap=GAP * smaller, overlap=OVERLAP * smaller))
    patches = Patches.join(found)
    smaller = extent[patches.faces].min(axis=1)
    side = planes(patches, _ANGLE, OVERLAP * smaller)
    wide = _widths(patches, side) > np.maximum(_depths(patches, side), narrowest)
    patches, smaller = patches.take(wide[side]), smaller[wide[side]]
    bound = np.zeros((len(meshes), len(meshes)))
    np.maximum.at(bound, tuple(patches.parts.T), smaller)
    return JointSurfaces(patches, planes(patches, angle, GAP * smaller), OVERLAP * bound, BRIDGED * bound)


def _widths(patches: Patches, group: NDArray[np.int64]) -> Array:
    """Return the area of each group by its diameter, shape (groups,), metres."""
    box = np.full((2, int(group.max(initial=-1)) + 1, 3), ([[np.inf]], [[-np.inf]]))
    np.minimum.at(box[0], group[patches.owner], patches.points)
    np.maximum.at(box[1], group[patches.owner], patches.points)
    return np.bincount(group, patches.areas, box.shape[1]) / np.linalg.norm(box[1] - box[0], axis=1)


def _depths(patches: Patches, group: NDArray[np.int64]) -> Array:
    """Return the largest overlap of each group, shape (groups,), metres."""
    depth = np.zeros(int(group.max(initial=-1)) + 1)
    np.maximum.at(depth, group, -patches.distance[:, 0])
    return depth


def _extents(vertices: Array, normals: Array) -> Array:
    """Return the extent of a part along each normal, shape (normals,), metres."""
    if len(vertices) > _MANY_VERTICES:
        from scipy.spatial import ConvexHull

        vertices = vertices[ConvexHull(vertices).vertices]
    extent = np.empty(len(normals))
    step = max(1, 2_000_000 // len(vertices))
    for start in range(0, len(normals), step):
        extent[start : start + step] = np.ptp(vertices @ normals[start : start + step].T, axis=0)
    return extent


def depths_beyond(meshes: Sequence[TriangleMesh], overlaps: Overlaps, bound: Array) -> Array:
    """Return how deep parts pass through each other where that is more than a joint may, else zero.

    Args:
        overlaps: pairs that overlap beyond the tolerance.
        bound: as of `check_joints`.

    Returns:
        Shape (pairs,), metres.
    """
    allowed = np.where(bound > 0, np.minimum(bound, deepest_of_joints(meshes, overlaps)), _limits(meshes, overlaps))
    found = np.zeros(len(allowed))
    for row, (a, b) in enumerate(overlaps.parts.tolist()):
        measure = coarse_depth if bound[row] else depth
        deep = measure(meshes[a], meshes[b])
        if deep > allowed[row] or _lies_inside(meshes[a], meshes[b]) or _lies_inside(meshes[b], meshes[a]):
            found[row] = deep
    return found


def _limits(meshes: Sequence[TriangleMesh], overlaps: Overlaps) -> Array:
    """Return the depth that is allowed to pairs without a joint, shape (pairs,), metres."""
    # Parts that meet along an edge overlap in a strip with parallel sides if one is shifted, and have no joint.
    most = np.maximum(overlaps.limit, OVERLAP * _thickness(meshes, overlaps))
    return np.where(overlaps.layer, most, overlaps.limit)


def deepest_of_joints(meshes: Sequence[TriangleMesh], overlaps: Overlaps) -> Array:
    """Return the depth that no joint of a pair may have, shape (pairs,), metres.

    Bars that lie in each other are as deep as they are thick, however long they are along what looks like a joint.
    """
    return np.maximum(overlaps.limit, _THROUGH * _thickness(meshes, overlaps))


def _thickness(meshes: Sequence[TriangleMesh], overlaps: Overlaps) -> Array:
    """Return the thickness of the thinner part of each pair, shape (pairs,), metres."""
    thickness: Array = np.array([mesh.thickness for mesh in meshes])[overlaps.parts].min(axis=1)
    return thickness


def refuse_deep(meshes: Sequence[TriangleMesh], overlaps: Overlaps) -> None:
    """Raise for the first pair that is deeper in each other than any joint may be.

    This takes seconds where parts of many faces lie in each other, and joints between these would take minutes to find.

    Raises:
        AssemblyError: names the parts and the depth.
    """
    for (a, b), allowed in zip(overlaps.parts.tolist(), deepest_of_joints(meshes, overlaps).tolist(), strict=True):
        deep = coarse_depth(meshes[a], meshes[b], allowed)
        if deep > allowed:
            most = f"at most {format_quantity(allowed, 'length')} is allowed to parts that are so thin; move them apart"
            raise too_deep(meshes[a], meshes[b], deep, most)


def _lies_inside(one: TriangleMesh, other: TriangleMesh) -> bool:
    (low, high), (least, most) = one.bounds, other.bounds
    enclosed = (low >= least).all() and (high <= most).all()
    # Most parts that do not lie inside show it by their first vertices.
    return bool(enclosed and all(inside(some, other.triangles).all() for some in (one.vertices[:8], one.vertices)))


def check_joints(meshes: Sequence[TriangleMesh], overlaps: Overlaps, bound: Array) -> None:
    """Raise for parts that overlap by more than a joint may.

    Args:
        overlaps: pairs that overlap beyond the tolerance.
        bound: depth that is allowed to the joint of each of them, zero if it has none, shape (pairs,), metres.

    Raises:
        AssemblyError: a part inside another, or an overlap beyond the bound, or beyond the tolerance without a joint.
    """
    limit = _limits(meshes, overlaps)
    doubtful = [
        row
        for row in np.flatnonzero(bound == 0).tolist()
        if interpenetrate(meshes[overlaps.parts[row, 0]], meshes[overlaps.parts[row, 1]], float(limit[row]))
    ]
    replace(overlaps, limit=limit).raise_first(meshes, doubtful)
    for (a, b), allowed in zip(overlaps.parts.tolist(), bound.tolist(), strict=True):
        if not allowed:
            continue
        for one, other in ((a, b), (b, a)):
            if _lies_inside(meshes[one], meshes[other]):
                raise AssemblyError(
                    f"parts {meshes[a].name} and {meshes[b].name} pass through each other: {meshes[one].name} lies "
                    "inside; move them apart"
                )
        deep = vertex_depth(meshes[a], meshes[b])
        if deep > allowed:
            most = f"{format_quantity(allowed, 'length')} is allowed, a third of the smaller part; move them apart"
            raise too_deep(meshes[a], meshes[b], deep, most)
