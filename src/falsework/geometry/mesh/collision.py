"""Collision queries on closed meshes, slightly shrunken for robustness, with the Flexible Collision Library."""

from __future__ import annotations

from collections.abc import Sequence

import fcl
import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import segment_sum
from falsework.geometry.mesh.mesh import TriangleMesh, unit_normals

Array = NDArray[np.float64]

_MITRE = 10.0
"""A vertex moves at most this many times the distance by which its faces move: sharp edges give way."""
MORE, LESS = 0.56, 0.45
"""Shares of an overlap that is allowed by which two solids shrink: together a little more than all of it."""


def shrink(mesh: TriangleMesh, distance: float) -> Array:
    """Return vertices of the mesh with every face moved inwards by `distance`, shape (vertices, 3), metres.

    Parts that touch, or overlap by less than twice `distance`, come apart when both are shrunk, so that a remaining
    collision is one of the parts and not of rounding. Each vertex moves by the least vector that moves all planes of
    its faces by the distance; where more than three planes meet, in the sense of least squares. The distance must be
    small beside the thickness of the part.
    """
    return mesh.vertices - distance * outwards(mesh)


def outwards(mesh: TriangleMesh) -> Array:
    """Return for each vertex the vector that moves all planes of its faces outwards by one, shape (vertices, 3)."""
    normals, solid = unit_normals(mesh.triangles)
    vertex = mesh.faces[solid].ravel()
    at = np.repeat(normals, 3, axis=0)
    count = len(mesh.vertices)
    outer = (at[:, :, None] * at[:, None, :]).reshape(-1, 9)
    gram, total = segment_sum(outer, vertex, count).reshape(-1, 3, 3), segment_sum(at, vertex, count)
    # Directions in which the planes hardly differ say nothing about where the vertex should go.
    move = np.einsum("vij,vj->vi", np.linalg.pinv(gram, rcond=1e-3, hermitian=True), total)
    size = np.linalg.norm(move, axis=1)
    move *= np.minimum(1.0, _MITRE / np.maximum(size, 1e-12))[:, None]
    return move


class Body:
    """Triangle surface for collision and distance queries."""

    def __init__(self, vertices: Array, faces: NDArray[np.integer]) -> None:
        model = fcl.BVHModel()
        model.beginModel(len(vertices), len(faces))
        model.addSubModel(vertices, faces)
        model.endModel()
        self._object = fcl.CollisionObject(model)

    def hits(self, other: Body) -> bool:
        """Return whether the two surfaces cross; one inside the other is no hit."""
        return fcl.collide(self._object, other._object, fcl.CollisionRequest(), fcl.CollisionResult()) > 0

    def distance(self, other: Body) -> float:
        """Return the smallest distance between the two surfaces, metres; zero or below where they cross."""
        return fcl.distance(self._object, other._object, fcl.DistanceRequest(), fcl.DistanceResult())

    def distances(self, points: Array) -> Array:
        """Return the distance of points from the surface, shape (points,), metres."""
        probe = fcl.CollisionObject(fcl.Sphere(1e-12))
        request = fcl.DistanceRequest()
        found = np.empty(len(points))
        for index, point in enumerate(points):
            probe.setTranslation(point)
            found[index] = fcl.distance(probe, self._object, request, fcl.DistanceResult())
        return found


def inside(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Return whether a closed surface encloses each point, by its solid angle as seen from there.

    Args:
        points: shape (points, 3), metres.
        corners: triangles of the surface, shape (faces, 3, 3), metres.
    """
    enclosed = np.zeros(len(points), dtype=bool)
    step = max(1, 2_000_000 // max(len(corners), 1))
    for start in range(0, len(points), step):
        arms = corners[None] - points[start : start + step, None, None, :]
        length = np.linalg.norm(arms, axis=3)
        a, b, c = arms[:, :, 0], arms[:, :, 1], arms[:, :, 2]
        above = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
        below = (
            length.prod(axis=2)
            + np.einsum("pfi,pfi->pf", a, b) * length[:, :, 2]
            + np.einsum("pfi,pfi->pf", b, c) * length[:, :, 0]
            + np.einsum("pfi,pfi->pf", c, a) * length[:, :, 1]
        )
        enclosed[start : start + step] = np.arctan2(above, below).sum(axis=1) > np.pi
    return enclosed


def interpenetrate(a: TriangleMesh, b: TriangleMesh, allowed: float) -> bool:
    """Return whether two solids, shrunk by half of the allowed overlap, still share space.

    They are not shrunk by the same amount: solids that coincide would leave surfaces that coincide, and
    none that cross.
    """
    a_points, b_points = shrink(a, MORE * allowed), shrink(b, LESS * allowed)
    return Body(a_points, a.faces).hits(Body(b_points, b.faces)) or nested(a, a_points, b, b_points)


def nested(a: TriangleMesh, a_points: Array, b: TriangleMesh, b_points: Array) -> bool:
    """Return whether one of two surfaces that do not cross lies inside the other."""
    a_low, a_high, b_low, b_high = a_points.min(0), a_points.max(0), b_points.min(0), b_points.max(0)
    if (a_low >= b_low).all() and (a_high <= b_high).all() and inside(a_points[:1], b_points[b.faces])[0]:
        return True
    return bool((b_low >= a_low).all() and (b_high <= a_high).all() and inside(b_points[:1], a_points[a.faces])[0])


def nearest(part: int, meshes: Sequence[TriangleMesh]) -> tuple[int, float]:
    """Return the part nearest to a part, and the gap between the two in metres."""
    body = Body(meshes[part].vertices, meshes[part].faces)
    bounds = np.array([mesh.bounds for mesh in meshes])
    apart = np.maximum(bounds[:, 0] - bounds[part, 1], bounds[part, 0] - bounds[:, 1]).max(axis=1)
    best, gap = -1, np.inf
    for other in np.argsort(apart, kind="stable").tolist():
        if other == part:
            continue
        if apart[other] >= gap:
            break
        distance = max(body.distance(Body(meshes[other].vertices, meshes[other].faces)), 0.0)
        if distance < gap:
            best, gap = other, distance
    return best, gap
