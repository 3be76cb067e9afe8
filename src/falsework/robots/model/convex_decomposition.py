"""Convex cover of a mesh: exact for unions of boxes, tight for most meshes, never smaller than the solid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.model.shapes import Pieces, hull

Array = NDArray[np.float64]

MAX_PIECES = 32
"""Largest number of pieces per part; beyond it the cover stays looser than the tolerance."""
IDLE_CUTS = 2
"""Consecutive cuts that may gain nothing: a ring must be halved before a cut of the halves helps."""
CUT_PLANES = 16
"""Number of planes tried per cut."""


@dataclass(frozen=True, eq=False)
class _Cut:
    """Part of a solid on one side of some planes: its surface there, open at the cuts."""

    triangles: Array
    """Shape (triangles, 3, 3)."""
    planes: tuple[Array, ...]
    """Cutting planes, `n . x <= d` inside, each as (n, d), shape (4,)."""
    corners: Array
    """Vertices of the convex hull, shape (corners, 3)."""
    volume: float = field(default=0.0)
    """Volume of the convex hull, m3."""
    idle: int = 0
    """Consecutive cuts that gained nothing."""


def convex_pieces(mesh: TriangleMesh, tolerance: float = 0.05, pieces: int = MAX_PIECES) -> Pieces:
    """Return convex pieces whose union contains the solid that a mesh encloses.

    The solid is cut by planes, in each step where that reduces the volume of the convex hulls most, until together
    they exceed the solid by at most `tolerance`. Every piece is the hull of what it covers, so no part of the solid is
    ever outside; where the limit of pieces is reached first, or a surface is curved, the cover is larger than the
    solid and motions keep a larger distance than necessary.

    Args:
        mesh: closed mesh with outward normals.
        tolerance: share of the volume by which the pieces may exceed the solid.
        pieces: largest number of pieces.

    Raises:
        InputError: the mesh spans no volume.
    """
    corners = hull(mesh.vertices)
    start = _Cut(mesh.triangles, (), corners, float(ConvexHull(corners).volume))
    solid = mesh.volume
    parts: list[_Cut] = [start]
    done: dict[int, _Cut] = {}  # by identity; kept, so that Python does not reuse the number
    while len(parts) < pieces and sum(part.volume for part in parts) > solid * (1 + tolerance):
        order = np.argsort([-part.volume for part in parts], kind="stable").tolist()
        for index in order:
            if id(parts[index]) not in done:
                halves = _best_cut(parts[index], mesh)
                if halves is not None:
                    break
                done[id(parts[index])] = parts[index]
        else:
            index = next((k for k in order if parts[k].idle < IDLE_CUTS), -1)
            halves = _halve(parts[index], mesh) if index >= 0 else None
            if halves is None:
                break
        parts[index : index + 1] = halves
    return tuple(part.corners for part in parts)


def _halve(part: _Cut, mesh: TriangleMesh) -> tuple[_Cut, _Cut] | None:
    """Cut across the middle of the longest side, even without gain."""
    low, high = part.corners.min(axis=0), part.corners.max(axis=0)
    axis = int(np.argmax(high - low))
    plane = np.append(np.eye(3)[axis], (low[axis] + high[axis]) / 2)
    one, other = _clip(part, plane, mesh), _clip(part, -plane, mesh)
    if one is None or other is None:
        return None
    return replace(one, idle=part.idle + 1), replace(other, idle=part.idle + 1)


def _best_cut(part: _Cut, mesh: TriangleMesh) -> tuple[_Cut, _Cut] | None:
    """Return the cut with the least hull volume of its two sides together; None if none gains a thousandth."""
    most = part.volume * (1 - 1e-3)
    best, chosen = most, None
    for plane in _candidates(part):
        sides = [_clip(part, sign * plane, None) for sign in (1.0, -1.0)]
        total = sum(side.volume for side in sides if side is not None)
        if None not in sides and total < best * (1 - 1e-9):
            best, chosen = total, plane
    if chosen is None:
        return None
    one, other = _clip(part, chosen, mesh), _clip(part, -chosen, mesh)
    if one is None or other is None or one.volume + other.volume >= most:
        return None
    return one, other


def _candidates(part: _Cut) -> list[Array]:
    """Return planes of faces inside the hull, and planes across its middle; shape (4,) each."""
    corners = part.triangles
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    good = area > area.max() * 1e-6
    normals = cross[good] / area[good, None]
    levels = np.einsum("ij,ij->i", normals, corners[good, 0])
    size = float(np.ptp(part.corners, axis=0).max())
    # A face plane cuts if there is solid in front of it; each plane once, largest faces first.
    front = (part.corners @ normals.T).max(axis=0) - levels > 1e-4 * size
    key = np.round(np.c_[normals, levels / size][front] * 1e4).astype(np.int64)
    flip = np.sign(key[np.arange(len(key)), np.argmax(np.abs(key) > 10, axis=1)])
    _, first, where = np.unique(key * flip[:, None], axis=0, return_index=True, return_inverse=True)
    weight = np.bincount(where.reshape(-1), area[good][front])
    order = np.argsort(-np.round(weight, 12), kind="stable")[:CUT_PLANES]
    planes = [np.append(normals[front][first[k]], levels[front][first[k]]) for k in order.tolist()]
    middle = part.corners.mean(axis=0)
    axes = np.linalg.svd(part.corners - middle, full_matrices=False)[2]
    for axis in (*np.eye(3), *axes):
        low, high = (part.corners @ axis).min(), (part.corners @ axis).max()
        planes.append(np.append(axis, (low + high) / 2))
    return planes


def _clip(part: _Cut, plane: Array, mesh: TriangleMesh | None) -> _Cut | None:
    """Return the part behind a plane, or None if it is negligible; an estimate where no mesh is given."""
    normal, level = plane[:3], plane[3]
    size = float(np.ptp(part.corners, axis=0).max())
    height = part.triangles @ normal - level
    height[np.abs(height) < 1e-9 * max(size, 1e-9)] = 0.0
    # A face in the plane bounds the part behind it if its normal agrees, else the part in front.
    along = np.cross(part.triangles[:, 1] - part.triangles[:, 0], part.triangles[:, 2] - part.triangles[:, 0]) @ normal
    whole = (height <= 0).all(axis=1) & ((height < 0).any(axis=1) | (along > 0))
    split = (height < 0).any(axis=1) & (height > 0).any(axis=1)
    kept = [part.triangles[whole]]
    if split.any():
        kept.append(_split(part.triangles[split], height[split]))
    triangles = np.concatenate(kept)
    if len(triangles) < 2:
        return None
    planes = (*part.planes, plane)
    points = triangles.reshape(-1, 3)
    if mesh is not None:
        points = np.concatenate([points, _inner_corners(planes, mesh, size)])
    try:
        made = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    corners = hull(points[made.vertices]) if mesh is not None else points[made.vertices]
    return _Cut(triangles, planes, corners, float(made.volume))


def _split(triangles: Array, height: Array) -> Array:
    """Return the parts of triangles behind a plane, as triangles."""
    found = []
    for corners, level in zip(triangles, height, strict=True):
        polygon = []
        for k in range(3):
            a, b = level[k], level[(k + 1) % 3]
            if a <= 0:
                polygon.append(corners[k])
            if a * b < 0:
                polygon.append(corners[k] + a / (a - b) * (corners[(k + 1) % 3] - corners[k]))
        found += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    return np.array(found).reshape(-1, 3, 3)


def _inner_corners(planes: tuple[Array, ...], mesh: TriangleMesh, size: float) -> Array:
    """Return the points where three cuts meet inside the solid. Shape (corners, 3)."""
    found = []
    for three in combinations(planes, 3):
        matrix = np.array([plane[:3] for plane in three])
        if abs(np.linalg.det(matrix)) > 1e-6:
            found.append(np.linalg.solve(matrix, [plane[3] for plane in three]))
    if not found:
        return np.zeros((0, 3))
    points = np.array(found)
    all_planes = np.array(planes)
    behind = (points @ all_planes[:, :3].T - all_planes[:, 3] <= 1e-9 * size).all(axis=1)
    points = points[behind]
    return points[inside(points, mesh.triangles)] if len(points) else np.zeros((0, 3))
