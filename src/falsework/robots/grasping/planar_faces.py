"""Nearly planar faces of a part, as grasp surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.robots.model.cell import FLAT_DEGREES
from falsework.utils.arrays import Array


@dataclass(frozen=True, eq=False)
class Face:
    """Neighbouring triangles with nearly the same normal."""

    normal: Array
    """Outward normal, shape (3,)."""
    frame: Array
    """Two orthogonal directions in the face, shape (2, 3)."""
    outline: shapely.Geometry
    """Projection of the face along its normal, in the coordinates of `frame`, metres."""
    triangles: Array
    """Shape (triangles, 3, 3), metres."""
    area: float

    def flat(self, point: Array) -> Array:
        """Return a point in the coordinates of the frame, shape (3,) to (2,)."""
        return self.frame @ point

    def lift(self, at: Array) -> Array:
        """Return the point of the surface over coordinates of the frame, shape (2,) to (3,)."""
        flat = self.triangles @ self.frame.T
        a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
        whole = _cross(b - a, c - a)
        weights = np.stack([_cross(b - at, c - at), _cross(c - at, a - at), _cross(a - at, b - at)], axis=1)
        weights = weights / np.where(np.abs(whole) > 1e-18, whole, 1.0)[:, None]
        best = int(np.argmax(np.where(np.abs(whole) > 1e-18, weights.min(axis=1), -np.inf)))
        return weights[best] @ self.triangles[best]


def faces_of(mesh: TriangleMesh, smallest: float = 0.0) -> list[Face]:
    """Return the faces of a mesh with at least some area, m2, largest first.

    The largest remaining triangle collects its neighbours, and theirs, whose normals are within `FLAT_DEGREES` of
    its own.
    """
    corners = mesh.triangles
    cross = triangle_normals(corners)
    size = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(size, 1e-300)[:, None]
    beside = _neighbours(mesh)
    left = np.ones(len(size), bool)
    limit = np.cos(np.radians(FLAT_DEGREES))
    found = []
    for seed in np.argsort(-np.round(size, 12), kind="stable").tolist():
        if not left[seed] or size[seed] <= 0:
            continue
        left[seed] = False
        members, stack = [seed], [seed]
        while stack:
            for other in beside[stack.pop()]:
                if left[other] and normals[other] @ normals[seed] >= limit:
                    left[other] = False
                    members.append(other)
                    stack.append(other)
        area = float(size[members].sum() / 2)
        if area >= smallest:
            found.append(_face(corners[members], cross[members].sum(axis=0), area))
    return sorted(found, key=lambda face: -face.area)


def _face(triangles: Array, normal: Array, area: float) -> Face:
    normal = normal / np.linalg.norm(normal)
    # The frame does not depend on the triangulation of the mesh: horizontal first, where there is a horizontal.
    helper = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(normal, first)])
    flat = np.atleast_1d(np.asarray(shapely.polygons(triangles @ frame.T)))
    outline = shapely.union_all(shapely.buffer(flat, 1e-9)) if len(flat) > 1 else flat[0]
    return Face(normal, frame, outline, triangles, area)


def _neighbours(mesh: TriangleMesh) -> list[list[int]]:
    """Return triangles that share an edge, by vertex position, since some meshes repeat their vertices."""
    scale = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    _, same = np.unique(np.round(mesh.vertices / scale * 1e7).astype(np.int64), axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    owners: dict[tuple[int, int], list[int]] = {}
    for index, face in enumerate(faces.tolist()):
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            owners.setdefault((min(a, b), max(a, b)), []).append(index)
    beside: list[list[int]] = [[] for _ in faces]
    for members in owners.values():
        for a in members:
            beside[a] += [b for b in members if b != a]
    return beside


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
