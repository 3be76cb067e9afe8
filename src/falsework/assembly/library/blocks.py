"""Convex blocks and assemblies of them, as the generators of built-in structures return them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solid:
    """Closed polyhedron with flat faces that look outwards, not yet numbered."""

    kind: str
    """What the block is, such as `voussoir`; parts are named `voussoir-0`, `voussoir-1`, ..."""
    vertices: Array
    """Shape (vertices, 3), metres."""
    rings: tuple[tuple[int, ...], ...]
    """Corners of the faces, counter-clockwise seen from outside; each ring is convex."""
    fixed: bool = False
    """Whether the block is boundary."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Meshes of a structure and which of them are boundary; boundary parts come last."""

    meshes: tuple[TriangleMesh, ...]
    boundary: NDArray[np.bool_]
    """Shape (parts,)."""


def gather(solids: Iterable[Solid]) -> Blocks:
    """Return the number solids, free ones first, and cut their faces into triangles."""
    ordered = sorted(solids, key=lambda solid: solid.fixed)
    meshes = tuple(
        TriangleMesh.from_arrays(f"{solid.kind}-{number}", solid.vertices, _triangles(solid.rings))
        for number, solid in enumerate(ordered)
    )
    return Blocks(meshes, np.array([solid.fixed for solid in ordered], dtype=bool))


def _triangles(rings: Iterable[Sequence[int]]) -> NDArray[np.int32]:
    fans = [(ring[0], ring[k], ring[k + 1]) for ring in rings for k in range(1, len(ring) - 1)]
    return np.array(fans, dtype=np.int32)


def box(kind: str, low: ArrayLike, high: ArrayLike, *, fixed: bool = False) -> Solid:
    """Return the box between two corners, metres."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    base = np.array([(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)])
    return prism(kind, base, (0.0, 0.0, z1 - z0), fixed=fixed)


def prism(kind: str, base: ArrayLike, along: ArrayLike, *, fixed: bool = False) -> Solid:
    """Sweep a flat convex polygon along a vector.

    Args:
        base: corners in order, either way round, shape (corners, 3), metres.
        along: sweep, shape (3,), metres.
    """
    base, along = np.asarray(base, float), np.asarray(along, float)
    normal = np.cross(base[1] - base[0], base[2] - base[1])
    return loft(
        kind,
        base if normal @ along > 0 else base[::-1],
        base + along if normal @ along > 0 else base[::-1] + along,
        fixed=fixed,
    )


def loft(kind: str, bottom: Array, top: Array, *, fixed: bool = False) -> Solid:
    """Join two polygons of equal corner counts by one quadrilateral an edge.

    Args:
        bottom: corners, counter-clockwise seen from the top, shape (corners, 3), metres.
        top: corners above those of `bottom`, shape (corners, 3), metres.
    """
    count = len(bottom)
    after = [*range(1, count), 0]
    sides = tuple((k, after[k], count + after[k], count + k) for k in range(count))
    rings = (tuple(range(count - 1, -1, -1)), tuple(range(count, 2 * count)), *sides)
    return Solid(kind, np.concatenate([bottom, top]), rings, fixed)


def ground(low: ArrayLike, high: ArrayLike, *, margin: float, depth: float) -> Solid:
    """Return the fixed slab whose top is the plane z = 0.

    Args:
        low: lowest x and y of what stands on it, metres.
        high: highest x and y, metres.
        margin: how far the slab reaches beyond, metres.
        depth: thickness of the slab, metres.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    return box("ground", [*(low - margin), -depth], [*(high + margin), 0.0], fixed=True)
