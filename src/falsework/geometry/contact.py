"""Contacts between parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.grouping import curved_groups, planes, segment_mean, segment_sum
from falsework.geometry.mesh import TriangleMesh
from falsework.geometry.overlap import check_overlap
from falsework.geometry.patches import Patches, face_patches, frames_of

Array = NDArray[np.float64]


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

    @property
    def normals(self) -> NDArray[np.float64]:
        """Unit normals from part `a` to part `b`, shape (contacts, 3)."""
        return self.frames[:, 0]

    def pushes(self, part_count: int) -> NDArray[np.float64]:
        """Area times normal into part `i` of all its contacts with part `j`, m2, shape (parts, parts, 3)."""
        push = np.zeros((part_count, part_count, 3))
        first, second = self.parts.T
        weighted = self.areas[:, None] * self.normals
        np.add.at(push, (first, second), -weighted)
        np.add.at(push, (second, first), weighted)
        return push


@dataclass(frozen=True)
class ContactSettings:
    """When two parts touch, and what counts as one plane."""

    gap: float | None = None
    """Largest gap between faces that still touch, metres. None: 1/2000 of the median diagonal of the parts, or
    1/20 of the thickness of the thinnest if that is less."""
    overlap: float | None = None
    """Largest depth to which faces that touch may pass through each other, metres. None: as `gap`."""
    corner: float | None = None
    """Largest depth to which corners and edges may cut into another part, metres. None: 1/50 of the diagonal
    of the smaller part, or 1/5 of the thickness of the thinner one if that is less."""
    angle: float = 6.0
    """Largest angle between faces that touch, degrees."""
    coplanar: float = 0.1
    """Largest angle between the normals of patches that form one plane, degrees."""
    curvature: float = 7.5
    """Largest angle between the normals of a curved interface that is treated as one plane, degrees."""
    curved_from: int = 16
    """Pairs of parts with more planes than this have their interface grouped by `curvature`."""

    def __post_init__(self) -> None:
        for name in ("gap", "overlap", "corner"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"contact tolerance {name} is {value} m; give a positive length or leave it out")
        for name in ("angle", "coplanar", "curvature"):
            if not 0 < getattr(self, name) < 45:
                raise InputError(f"contact tolerance {name} is {getattr(self, name)} degrees; give 0 to 45")

    def lengths(self, meshes: Sequence[TriangleMesh]) -> tuple[float, float]:
        """Gap and overlap in metres for these parts."""
        if self.gap is None:
            diagonal = np.median([np.linalg.norm(np.ptp(mesh.bounds, axis=0)) for mesh in meshes])
            gap = min(float(diagonal) / 2000, min(mesh.thickness for mesh in meshes) / 20)
        else:
            gap = self.gap
        return gap, gap if self.overlap is None else self.overlap


def find_contacts(meshes: Sequence[TriangleMesh], settings: ContactSettings | None = None) -> Contacts:
    """Find where parts lie against each other.

    Opposed faces within the tolerances are intersected; the patches of one pair of parts that lie in one
    plane become one contact, reduced to the corners of their common convex hull. Nothing is lost by that:
    a point of a patch is a convex combination of the corners, and the friction cone is convex and the same
    all over the plane, so a force at the point, shared out among the corners in the same proportions, stays
    in the cone and keeps its total force and moment. Nothing is gained either, since the corners are points
    of the patches.

    The interface of a pair with more than `settings.curved_from` planes is taken as curved: neighbouring
    patches whose normals differ by at most `settings.curvature` from that of the largest among them become
    one contact, with the mean normal and the true positions of its points.

    Args:
        meshes: closed meshes that face outwards.
        settings: tolerances.

    Returns:
        Contacts sorted by their parts; their order and points depend on the geometry alone, not on how
        faces are cut into triangles. What is narrower than the tolerance is left out.

    Raises:
        AssemblyError: two parts pass through each other; names them and how deep.
    """
    settings = settings or ContactSettings()
    gap, overlap = settings.lengths(meshes)
    check_overlap(meshes, overlap, corner=settings.corner)
    tolerance = max(gap, overlap)
    patches = face_patches(meshes, gap=gap, overlap=overlap, angle=settings.angle)
    group = planes(patches, settings.coplanar, tolerance)
    group = curved_groups(patches, group, settings.curvature, settings.curved_from, tolerance)
    return _contacts(patches, group, tolerance)


def _contacts(patches: Patches, group: NDArray[np.int64], tolerance: float) -> Contacts:
    """One contact a group of patches: mean frame, hull corners counter-clockwise, slivers left out."""
    count = int(group.max()) + 1 if len(group) else 0
    normals = segment_sum(patches.normals * patches.areas[:, None], group, count)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = segment_sum(patches.areas[:, None], group, count)[:, 0]
    parts = np.zeros((count, 2), dtype=np.int32)
    parts[group] = patches.parts
    frames = frames_of(normals)

    owner = group[patches.owner]
    origin = segment_mean(patches.points, owner, count)
    local = np.einsum("pij,pj->pi", frames[owner], patches.points - origin[owner])
    order = np.argsort(owner, kind="stable")
    clouds = shapely.multipoints(shapely.points(local[order][:, [1, 2, 0]]), indices=owner[order])
    # Corners that stand out of the hull by rounding alone depend on the triangulation; simplify drops them.
    hulls: Any = shapely.simplify(shapely.convex_hull(clouds), tolerance / 100, preserve_topology=True)

    width = 2 * shapely.area(hulls) / np.maximum(shapely.length(hulls), 1e-300)
    keep = width >= tolerance
    corners, hull = shapely.get_coordinates(hulls[keep], include_z=True, return_index=True)
    index = np.flatnonzero(keep)
    ring_end = np.append(hull[1:] != hull[:-1], True) if len(hull) else np.zeros(0, bool)
    corners, hull = corners[~ring_end], hull[~ring_end]
    middle = segment_mean(corners, hull, len(index))
    turn = np.arctan2(*(corners - middle[hull])[:, 1::-1].T)
    # Sorting by angle makes the hull counter-clockwise; the odd start keeps corners off the branch cut.
    turn = np.mod(turn + 0.7391, 2 * np.pi)
    position = origin[index][hull] + np.einsum("pji,pj->pi", frames[index][hull], corners[:, [2, 0, 1]])

    centre = np.round(segment_mean(position, hull, len(index)) / tolerance)
    rank = np.lexsort((*centre.T[::-1], parts[index, 1], parts[index, 0]))
    place = np.empty(len(index), dtype=np.int64)
    place[rank] = np.arange(len(index))
    order = np.lexsort((turn, place[hull]))
    sizes = np.bincount(place[hull], minlength=len(index))
    index = index[rank]
    arrays = (
        parts[index],
        np.ascontiguousarray(frames[index]),
        np.ascontiguousarray(position[order]),
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32),
        areas[index],
    )
    for array in arrays:
        array.setflags(write=False)
    return Contacts(*arrays)
