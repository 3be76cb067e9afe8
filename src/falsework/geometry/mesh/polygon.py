"""Triangulation of planar polygons without new vertices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.mesh.bounds import LARGEST_POLYGON

Array = NDArray[np.float64]


def newell_normal(points: Array) -> Array:
    """Return the area vector of a closed polygon in space, shape (3,), m2; its length is the area if it is flat."""
    local = points - points[0]
    return np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0) / 2


def triangulate(points: Array) -> list[tuple[int, int, int]]:
    """Cut a flat simple polygon into triangles with the same orientation, by cutting off ears.

    A fan from one corner, as most readers produce it, folds over where the polygon is concave.

    Args:
        points: corners in order, shape (corners, 3), metres.

    Returns:
        Triples of indices into `points`; one fewer than two less than the corners where corners coincide.

    Raises:
        MeshError: there are more corners than `LARGEST_POLYGON`.
    """
    count = len(points)
    if count > LARGEST_POLYGON:
        raise MeshError(_too_many(count))
    if count == 3:
        return [(0, 1, 2)]
    normal = newell_normal(points)
    drop = int(np.argmax(np.abs(normal)))
    flat = np.delete(points - points.mean(axis=0), drop, axis=1)
    if (normal[drop] < 0) != (drop == 1):
        flat = flat[:, ::-1]
    x, y = flat[:, 0].tolist(), flat[:, 1].tolist()

    def turn(i: int, j: int, k: int) -> float:
        return (x[j] - x[i]) * (y[k] - y[i]) - (y[j] - y[i]) * (x[k] - x[i])

    def is_ear(ring: Sequence[int], at: int) -> bool:
        i, j, k = ring[at - 1], ring[at], ring[(at + 1) % len(ring)]
        if turn(i, j, k) <= 0:
            return False
        return not any(
            turn(i, j, p) >= 0 and turn(j, k, p) >= 0 and turn(k, i, p) >= 0
            for p in ring
            if inward[p] and p not in (i, j, k) and (x[p], y[p]) not in ((x[i], y[i]), (x[j], y[j]), (x[k], y[k]))
        )

    ring = list(range(count))
    # A cut never turns a corner inwards, and only such corners can lie in an ear.
    inward = [turn(at - 1, at, (at + 1) % count) <= 0 for at in ring]
    triangles: list[tuple[int, int, int]] = []
    while len(ring) > 3:
        at = next((at for at in range(len(ring)) if is_ear(ring, at)), None)
        if at is None:  # corners in a line, or a polygon that crosses itself: any cut keeps the surface closed
            at = min(range(len(ring)), key=lambda at: abs(turn(ring[at - 1], ring[at], ring[(at + 1) % len(ring)])))
        triangles.append((ring[at - 1], ring[at], ring[(at + 1) % len(ring)]))
        del ring[at]
    triangles.append((ring[0], ring[1], ring[2]))
    return triangles


def triangles_of(file: str, points: Array, polygons: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return triangles of polygons in their order, shape (triangles, 3).

    Args:
        file: where they are from, for messages.
        points: shape (vertices, 3).
        polygons: indices into `points`, three or more each.

    Raises:
        MeshError: a polygon with a vertex that does not exist, or with more corners than `LARGEST_POLYGON`.
    """
    if not polygons:
        return np.zeros((0, 3), dtype=np.int64)
    if max(map(max, polygons)) >= len(points) or min(map(min, polygons)) < 0:
        raise MeshError(f"a face in {file} uses a vertex that does not exist; there are {len(points)}; export it again")
    if all(len(polygon) == 3 for polygon in polygons):
        return np.array(polygons, dtype=np.int64)
    faces: list[list[int]] = []
    for polygon in polygons:
        if len(polygon) > LARGEST_POLYGON:
            raise MeshError(f"{file}: {_too_many(len(polygon))}")
        faces.extend([polygon[corner] for corner in triangle] for triangle in triangulate(points[list(polygon)]))
    return np.array(faces, dtype=np.int64)


def _too_many(corners: int) -> str:
    return f"a face has {corners} corners, at most {LARGEST_POLYGON} are read; cut it into triangles"
