"""Supports modelled as open surfaces, which are given a thickness on their free side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.mesh.edges import open_edges
from falsework.geometry.mesh.mesh import triangle_normals

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

_THICKNESS = 1 / 100
"""Thickness that a sheet is given, relative to its diagonal."""
_FLAT = 1 / 20
"""Largest distance of the vertices of a sheet from its plane, relative to its diagonal."""
_LEVEL = np.cos(np.radians(60))
"""Cosine of the largest angle between a face of a sheet and its plane."""


def is_sheet(points: Array, faces: Faces) -> bool:
    """Return whether an open surface is so flat that it bounds no solid, whatever closes it."""
    used = points[np.unique(faces)]
    if len(used) < 3 or not np.isfinite(used).all() or not open_edges(faces)[0].size:
        return False
    normal = plane_normal(used)
    corners = points[faces]
    cross = triangle_normals(corners)
    if (np.abs(cross @ normal) < _LEVEL * np.linalg.norm(cross, axis=1)).any():
        return False  # a plate that lacks a face has its sides
    return bool(np.ptp((used - used.mean(axis=0)) @ normal) <= 2 * _FLAT * np.linalg.norm(np.ptp(used, axis=0)))


def is_flat(points: Array, share: float) -> bool:
    """Return whether points, shape (points, 3), lie in a plane to within a share of their extent."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= share * spread[0])


def plane_normal(points: Array) -> Array:
    """Return the unit normal of the plane that fits points best, of either sign, shape (3,)."""
    return np.linalg.svd(points - points.mean(axis=0))[2][2]


def thickened(points: Array, faces: Faces, others: Sequence[Array]) -> tuple[Array, Faces, float]:
    """Return the solid behind a sheet: away from the part nearest to it.

    Args:
        points: shape (vertices, 3), metres.
        faces: shape (faces, 3).
        others: vertices of the parts that are solids, metres.

    Returns:
        Vertices and faces of a closed surface, and the thickness in metres.
    """
    used, index = np.unique(faces, return_inverse=True)
    front, faces = points[used], index.reshape(-1, 3)
    centre, normal = front.mean(axis=0), plane_normal(front)
    thickness = _THICKNESS * float(np.linalg.norm(np.ptp(front, axis=0)))
    if others:
        from scipy.spatial import KDTree

        near = min(others, key=lambda vertices: KDTree(vertices).query(front)[0].sum())
        normal = normal * (1.0 if (near.mean(axis=0) - centre) @ normal > 0 else -1.0)
    corners = front[faces]
    if triangle_normals(corners).sum(axis=0) @ normal < 0:
        faces = faces[:, ::-1]
    count = len(front)
    tail, head = open_edges(faces)
    walls = np.concatenate(
        [np.stack([head, tail, tail + count], axis=1), np.stack([head, tail + count, head + count], axis=1)]
    )
    solid = np.concatenate([faces, faces[:, ::-1] + count, walls])
    return np.concatenate([front, front - thickness * normal]), solid, thickness
