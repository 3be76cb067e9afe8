"""Pairs of parts of very many faces that touch, or that fit into each other with clearance."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.geometry import TriangleMesh

Array = NDArray[np.float64]
Height = Callable[[Array, Array], Array]

RADIUS, LENGTH, CLEARANCE = 0.01, 0.1, 1e-4


def solid_of_revolution(name: str, profile: ArrayLike, sides: int, phase: float = 0.0) -> TriangleMesh:
    """Turn a closed polygon of radii and heights about the z axis.

    Args:
        name: of the part.
        profile: shape (corners, 2), metres, radii above zero.
        sides: number of facets around the axis.
        phase: by how many facets it is turned.
    """
    radius, height = np.array(profile, dtype=float).T
    angle = 2 * np.pi * (np.arange(sides) + phase) / sides
    points = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones(sides))], axis=-1
    )
    a = np.arange(points[..., 0].size).reshape(len(radius), sides)
    b, c, d = np.roll(a, -1, axis=0), np.roll(a, -1, axis=1), np.roll(a, (-1, -1), axis=(0, 1))
    return _outwards(name, points.reshape(-1, 3), _halves(a, c, d, b))


def plate(name: str, height: Height, far: float, cells: int) -> TriangleMesh:
    """Return a square plate of 0.1 m, with one face a height field of square cells and the opposite one flat.

    Args:
        name: of the part.
        height: of the face over x and y, metres.
        far: height of the flat face, metres.
        cells: along each side.
    """
    line = np.linspace(0.0, LENGTH, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    points = np.concatenate([np.stack([x, y, z], axis=-1).reshape(-1, 3) for z in (height(x, y), np.full_like(x, far))])
    a, b = np.arange(len(points)).reshape(2, cells + 1, cells + 1)
    faces = [
        _halves(a[:-1, :-1], a[1:, :-1], a[1:, 1:], a[:-1, 1:]),
        _halves(b[:-1, :-1], b[:-1, 1:], b[1:, 1:], b[1:, :-1]),
    ]
    for upper, lower in ((a[:, 0], b[:, 0]), (a[::-1, -1], b[::-1, -1]), (a[0, ::-1], b[0, ::-1]), (a[-1], b[-1])):
        faces.append(_halves(lower[:-1], lower[1:], upper[1:], upper[:-1]))
    return _outwards(name, points, np.concatenate(faces))


def _halves(*corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return two triangles for each quadrilateral."""
    p, q, r, s = corners
    return np.concatenate([np.stack(half, axis=-1).reshape(-1, 3) for half in ((p, q, r), (p, r, s))])


def _outwards(name: str, points: Array, faces: NDArray[np.int64]) -> TriangleMesh:
    mesh = TriangleMesh.from_arrays(name, points, faces)
    return mesh if mesh.volume > 0 else TriangleMesh.from_arrays(name, points, faces[:, ::-1])


def _flat(x: Array, y: Array) -> Array:
    return 0 * x


def _waves(x: Array, y: Array) -> Array:
    return 0.004 * np.sin(80 * x) * np.sin(80 * y)


def _plates(height: Height, other: int, faces: int) -> tuple[TriangleMesh, TriangleMesh]:
    """Return two plates that touch in a height field, the second cut into `other` cells fewer along each side."""
    cells = int(np.sqrt(faces / 4))
    return plate("lower", height, -0.05, cells), plate("upper", height, 0.05, cells - other)


def _bearing(clearance: float, phase: float, faces: int) -> tuple[TriangleMesh, TriangleMesh]:
    """Return a shaft and a bushing."""
    sides = int(np.sqrt(faces / 4))
    rows = faces // 4 // sides
    up, down = np.linspace(-LENGTH / 2, LENGTH / 2, rows), np.linspace(0.4 * LENGTH, -0.4 * LENGTH, rows)
    shaft = [(RADIUS, z) for z in up] + [(0.3 * RADIUS, z) for z in up[::-1]]
    bushing = [(RADIUS + clearance, z) for z in down] + [(2 * RADIUS, z) for z in down[::-1]]
    return solid_of_revolution("shaft", shaft, sides), solid_of_revolution("bushing", bushing, sides, phase)


FINE_PAIRS: dict[str, Callable[[int], tuple[TriangleMesh, TriangleMesh]]] = {
    "flat": partial(_plates, _flat, 3),
    "waves": partial(_plates, _waves, 0),
    "waves cut differently": partial(_plates, _waves, 3),
    "bearing": partial(_bearing, 0.0, 0.0),
    "bearing with clearance": partial(_bearing, CLEARANCE, 0.3),
}
"""Pairs by name, for a number of faces of each part."""
