"""Contacts between parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.mesh import TriangleMesh
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


@dataclass(frozen=True)
class ContactSettings:
    """When two parts touch, and what counts as one plane."""

    gap: float | None = None
    """Largest gap between faces that still touch, metres. None: 1/2000 of the median diagonal of the parts."""
    overlap: float | None = None
    """Largest depth to which parts may pass through each other, metres. None: as `gap`."""
    angle: float = 3.0
    """Largest angle between faces that touch, degrees."""
    coplanar: float = 0.1
    """Largest angle between the normals of patches that form one plane, degrees."""
    curvature: float = 7.5
    """Largest angle between the normals of a curved interface that is treated as one plane, degrees."""
    curved_from: int = 16
    """Pairs of parts with more planes than this have their interface grouped by `curvature`."""

    def __post_init__(self) -> None:
        for name in ("gap", "overlap"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"contact tolerance {name} is {value} m; give a positive length or leave it out")
        for name in ("angle", "coplanar", "curvature"):
            if not 0 < getattr(self, name) < 45:
                raise InputError(f"contact tolerance {name} is {getattr(self, name)} degrees; give 0 to 45")

    def lengths(self, meshes: Sequence[TriangleMesh]) -> tuple[float, float]:
        """Gap and overlap in metres for these parts."""
        default = 0.0
        if self.gap is None:
            default = float(np.median([np.linalg.norm(np.ptp(mesh.bounds, axis=0)) for mesh in meshes])) / 2000
        gap = default if self.gap is None else self.gap
        return gap, gap if self.overlap is None else self.overlap


def find_contacts(meshes: Sequence[TriangleMesh], settings: ContactSettings = ContactSettings()) -> Contacts:
    """Find where parts lie against each other.

    Opposed faces within the tolerances are intersected; the patches of one pair of parts that lie in one
    plane become one contact, reduced to the corners of their common convex hull. Nothing is lost by that:
    the friction cone is convex and the same everywhere on the plane, so a force at any point of the hull is
    a convex combination of forces at its corners with the same total force and moment, and every wrench
    that pressure spread over the patches can transmit is one that forces at the corners can transmit. The
    reverse holds where the union of the patches is not convex too: forces at points of the union reach its
    hull corners, which are points of the union.

    The interface of a pair with more than `settings.curved_from` planes is taken as curved: neighbouring
    patches whose normals differ by at most `settings.curvature` from that of the largest among them become
    one contact, with the mean normal and the true positions of its points.

    Args:
        meshes: closed meshes that face outwards.
        settings: tolerances.

    Returns:
        Contacts sorted by their parts; their order and points depend on the geometry alone, not on how
        faces are cut into triangles.
    """
    gap, overlap = settings.lengths(meshes)
    tolerance = max(gap, overlap)
    patches = face_patches(meshes, gap=gap, overlap=overlap, angle=settings.angle)
    plane = _planes(patches, settings.coplanar, tolerance)
    return _contacts(patches, plane, tolerance)


def _planes(patches: Patches, coplanar: float, tolerance: float) -> NDArray[np.int64]:
    """Assign patches to planes of their pair of parts; returns the plane of every patch.

    All pairs go forward together: in each round the largest patch that is left of a pair collects the
    patches of that pair within `coplanar` degrees and `tolerance` metres of its plane.
    """
    count = len(patches.areas)
    _, pair = np.unique(patches.parts[:, 0] * np.int64(2**32) + patches.parts[:, 1], return_inverse=True)
    centre = _segment_mean(patches.points, patches.owner, count)
    plane = np.full(count, -1, dtype=np.int64)
    limit = np.cos(np.radians(coplanar))
    rest = np.lexsort((-patches.areas, pair))
    found = 0
    while len(rest):
        leads = np.append(True, pair[rest[1:]] != pair[rest[:-1]])
        seed = rest[np.flatnonzero(leads)[np.cumsum(leads) - 1]]
        parallel = np.einsum("ij,ij->i", patches.normals[rest], patches.normals[seed]) >= limit
        seed_of = np.full(count, -1, dtype=np.int64)
        seed_of[rest[parallel]] = seed[parallel]
        corner = np.flatnonzero(seed_of[patches.owner] >= 0)
        owner = patches.owner[corner]
        lead = seed_of[owner]
        height = np.abs(np.einsum("pi,pi->p", patches.points[corner] - centre[lead], patches.normals[lead]))
        seed_of[owner[height > tolerance]] = -1
        seed_of[rest[leads]] = rest[leads]  # a seed always belongs to itself, or the loop would not end
        taken = seed_of[rest] >= 0
        plane[rest[taken]] = found + np.cumsum(leads)[taken] - 1
        found += int(leads.sum())
        rest = rest[~taken]
    return plane


def _segment_mean(values: Array, owner: NDArray[np.int64], count: int) -> Array:
    """Mean of the rows of each owner, shape (count, columns)."""
    total = np.stack([np.bincount(owner, values[:, axis], count) for axis in range(values.shape[1])], axis=1)
    return total / np.maximum(np.bincount(owner, minlength=count), 1)[:, None]


def _contacts(patches: Patches, group: NDArray[np.int64], tolerance: float) -> Contacts:
    """One contact a group of patches: mean frame, hull corners counter-clockwise, slivers left out."""
    count = int(group.max()) + 1 if len(group) else 0
    weighted = patches.normals * patches.areas[:, None]
    normals = np.stack([np.bincount(group, weighted[:, axis], count) for axis in range(3)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = np.bincount(group, patches.areas, count)
    parts = np.zeros((count, 2), dtype=np.int32)
    parts[group] = patches.parts
    frames = frames_of(normals)

    owner = group[patches.owner]
    origin = _segment_mean(patches.points, owner, count)
    local = np.einsum("pij,pj->pi", frames[owner], patches.points - origin[owner])
    order = np.argsort(owner, kind="stable")
    clouds = shapely.multipoints(shapely.points(local[order][:, [1, 2, 0]]), indices=owner[order])
    # Corners that stand out of the hull by rounding alone depend on the triangulation; simplify drops them.
    hulls = shapely.simplify(shapely.convex_hull(clouds), tolerance / 100, preserve_topology=True)

    width = 2 * shapely.area(hulls) / np.maximum(shapely.length(hulls), 1e-300)
    keep = width >= tolerance
    corners, hull = shapely.get_coordinates(hulls[keep], include_z=True, return_index=True)
    index = np.flatnonzero(keep)
    ring_end = np.append(hull[1:] != hull[:-1], True) if len(hull) else np.zeros(0, bool)
    corners, hull = corners[~ring_end], hull[~ring_end]
    middle = _segment_mean(corners, hull, len(index))
    turn = np.arctan2(*(corners - middle[hull])[:, 1::-1].T)
    # Sorting by angle makes the hull counter-clockwise; the odd start keeps corners off the branch cut.
    turn = np.mod(turn + 0.7391, 2 * np.pi)
    position = origin[index][hull] + np.einsum("pji,pj->pi", frames[index][hull], corners[:, [2, 0, 1]])

    centre = np.round(_segment_mean(position, hull, len(index)) / tolerance)
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
