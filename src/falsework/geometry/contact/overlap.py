"""Overlap between parts: detection by collision queries, and penetration depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.errors import AssemblyError
from falsework.geometry.contact.creases import Surface
from falsework.geometry.contact.patches import intersect_faces, opposed_faces
from falsework.geometry.mesh.boxes import box_pairs
from falsework.geometry.mesh.collision import LESS, MORE, Body, inside, interpenetrate, nested, outwards
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]

_OPPOSED = 3.0
"""Largest angle between opposed faces of which an overlap is a mistake and no bevel, degrees."""
_ASKED = 32
"""Points of which it is asked at first whether they are inside a part."""


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Pairs of parts that overlap by more than modelling errors."""

    parts: NDArray[np.int64]
    """Shape (pairs, 2), the lower one first, sorted."""
    limit: Array
    """Depth that is allowed, shape (pairs,), metres."""
    layer: NDArray[np.bool_]
    """Whether faces that are almost parallel overlap, not only corners and edges, shape (pairs,)."""

    def any_deeper(self, meshes: Sequence[TriangleMesh]) -> bool:
        """Return whether a pair is deeper than allowed, as measured."""
        pairs = zip(self.parts.tolist(), self.limit.tolist(), strict=True)
        return any(
            vertex_depth(meshes[a], meshes[b], limit) > limit or depth(meshes[a], meshes[b]) > limit
            for (a, b), limit in pairs
        )

    def raise_first(self, meshes: Sequence[TriangleMesh], among: Sequence[int]) -> None:
        """Raise for the first pair `among` all that is deeper than allowed; return if none is.

        Raises:
            AssemblyError: names the parts and the depth.
        """
        for row in among:
            (a, b), limit = self.parts[row].tolist(), float(self.limit[row])
            deep = depth(meshes[a], meshes[b])
            if deep > limit:
                allowed = f"{format_quantity(limit, 'length')} is allowed where they have no joint; move them apart"
                how = '("contact": {"overlap": metres} in assembly.json)'
                raise too_deep(meshes[a], meshes[b], deep, f"{allowed}, or raise the tolerance {how}")


def too_deep(one: TriangleMesh, other: TriangleMesh, deep: float, allowed: str) -> AssemblyError:
    """Return the error of parts that pass through each other by a depth, metres; `allowed` says what is, and a way."""
    how = f"parts {one.name} and {other.name} pass through each other by {format_quantity(deep, 'length')}"
    return AssemblyError(f"{how}, and {allowed}")


def find_overlaps(meshes: Sequence[TriangleMesh], tolerance: float, *, corner: float | None) -> Overlaps:
    """Find parts that overlap by more than modelling errors.

    Opposed faces, which should touch, may overlap by `tolerance`. Corners and edges that cut into a
    neighbour lose no contact and may go deeper, to `corner`: where four stones of a dome meet, their
    bevelled corners often do.

    Each part is shrunk by half of what is allowed, so that shallower overlaps vanish; what then still
    collides, or lies one inside the other, is a candidate, whose depth `Overlaps.raise_first` measures.

    Args:
        meshes: closed meshes that face outwards.
        tolerance: metres.
        corner: metres. None: for each pair 1/50 of the diagonal of its smaller part, or 1/5 of the
            thickness of the thinner one, if that is less.
    """
    size = np.array([min(np.linalg.norm(np.ptp(mesh.bounds, axis=0)) / 50, mesh.thickness / 5) for mesh in meshes])
    pairs = np.array(_suspects(meshes, tolerance), dtype=np.int64).reshape(-1, 2)
    limit = np.maximum(size[pairs].min(axis=1) if corner is None else np.full(len(pairs), corner), tolerance)
    layer = _have_layer(meshes, pairs, tolerance, limit)
    deep = layer.copy()
    for row in np.flatnonzero(~layer).tolist():
        a, b = pairs[row].tolist()
        deep[row] = interpenetrate(meshes[a], meshes[b], float(limit[row]))
    return Overlaps(pairs[deep], np.where(layer, tolerance, limit)[deep], layer[deep])


def _have_layer(
    meshes: Sequence[TriangleMesh], pairs: NDArray[np.int64], tolerance: float, limit: Array
) -> NDArray[np.bool_]:
    """Return whether faces of pairs of parts that should touch overlap by more than the tolerance, shape (pairs,)."""
    if not len(pairs):
        return np.zeros(0, dtype=bool)
    faces = Surface.from_meshes(meshes)
    row = np.full((len(meshes), len(meshes)), -1)
    row[pairs[:, 0], pairs[:, 1]] = np.arange(len(pairs))
    deepest = np.full(len(faces.part), limit.max())
    area = np.zeros(len(pairs))
    for i, j in opposed_faces(faces, np.full(len(faces.part), -tolerance), deepest, _OPPOSED, row >= 0):
        depth_limit = limit[row[faces.part[i], faces.part[j]]]
        patches = intersect_faces(faces, i, j, gap=np.full(len(i), -tolerance), overlap=depth_limit)
        area += np.bincount(row[patches.parts[:, 0], patches.parts[:, 1]], patches.areas, len(pairs))
    return area > limit**2


def _suspects(meshes: Sequence[TriangleMesh], tolerance: float) -> list[tuple[int, int]]:
    """Return pairs of parts that still collide after shrinking, in order."""
    bounds = np.array([mesh.bounds for mesh in meshes])
    low, high = bounds[:, 0] + tolerance / 2, bounds[:, 1] - tolerance / 2
    i, j = box_pairs(low, np.maximum(low, high))
    bodies: dict[tuple[int, bool], Body] = {}
    moves: dict[int, Array] = {}
    vertices: dict[tuple[int, bool], Array] = {}

    def body(part: int, second: bool) -> Body:
        if (part, second) not in bodies:
            if part not in moves:
                moves[part] = outwards(meshes[part])
            vertices[part, second] = meshes[part].vertices - (LESS if second else MORE) * tolerance * moves[part]
            bodies[part, second] = Body(vertices[part, second], meshes[part].faces)
        return bodies[part, second]

    found = []
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        if body(a, False).hits(body(b, True)) or nested(meshes[a], vertices[a, False], meshes[b], vertices[b, True]):
            found.append((a, b))
    return found


def depth(a: TriangleMesh, b: TriangleMesh) -> float:
    """Return the penetration depth of two parts, metres; zero if they only touch or are apart.

    It is the largest distance to the surface of one part from a point of the other inside it: the thickness
    of the common region where that is a layer, and how far a corner sticks in where it is a tip. Points are
    taken on both surfaces, and in the common region for parts that coincide, at about 1/40 of its size; the
    depth is then low by at most that, and exact where the deepest point is a vertex or the faces are parallel.
    """
    low = np.maximum(a.bounds[0], b.bounds[0])
    high = np.minimum(a.bounds[1], b.bounds[1])
    if (low >= high).any():
        return 0.0
    spacing = float(np.linalg.norm(high - low)) / 40
    deepest = 0.0
    for one, other in ((a, b), (b, a)):
        deepest = _deepest(_surface_points(one, low, high, spacing), (other,), deepest)
    return _deepest(_grid(low, high), (a, b), deepest)


def coarse_depth(a: TriangleMesh, b: TriangleMesh, least: float = 0.0) -> float:
    """Return the depth at vertices, or if it is not more than `least`, on a grid over what the parts may share, metres.

    It is fast, and no larger than `depth`, but for `least`, which is returned where it is smaller than that.
    """
    low, high = np.maximum(a.bounds[0], b.bounds[0]), np.minimum(a.bounds[1], b.bounds[1])
    if (low >= high).any():
        return least
    found = vertex_depth(a, b, least)
    return found if found > least else _deepest(_grid(low, high), (a, b), least)


def _grid(low: Array, high: Array) -> Array:
    """Return points inside a box, shape (points, 3), metres."""
    steps = [np.linspace(low[axis], high[axis], 15)[1:-1] for axis in range(3)]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def vertex_depth(a: TriangleMesh, b: TriangleMesh, least: float = 0.0) -> float:
    """Return the largest distance to the surface of one part from a vertex of the other inside it, metres.

    It is fast, and no larger than `depth`, but for `least`, which is returned where it is smaller than that.
    """
    for one, other in ((a, b), (b, a)):
        least = _deepest(one.vertices, (other,), least)
    return least


def _deepest(points: Array, parts: Sequence[TriangleMesh], least: float) -> float:
    """Return how far the deepest of the points inside all parts is from their surfaces, or `least` if that is more.

    Distances take much less time than the question whether a point is inside: that is asked of the farthest points
    first, in groups that grow, and the first one inside is the deepest.
    """
    # A ball around the point, as large as it is deep, lies in all parts and so in their boxes.
    low = np.max([part.bounds[0] for part in parts], axis=0) + least
    high = np.min([part.bounds[1] for part in parts], axis=0) - least
    points = points[((points > low) & (points < high)).all(axis=1)]
    if not len(points):
        return least
    away = np.min([Body(part.vertices, part.faces).distances(points) for part in parts], axis=0)
    order = np.argsort(-away, kind="stable")
    order = order[away[order] > least]
    first, count = 0, _ASKED
    while first < len(order):
        some = order[first : first + count]
        for part in parts:
            some = some[inside(points[some], part.triangles)]
        if len(some):
            return float(away[some[0]])
        first, count = first + count, 2 * count
    return least


def _surface_points(mesh: TriangleMesh, low: Array, high: Array, spacing: float) -> Array:
    """Return points of a surface in a box, corners of faces among them, about `spacing` apart. Shape (points, 3)."""
    corners = mesh.triangles
    near = (corners.min(axis=1) <= high).all(axis=1) & (corners.max(axis=1) >= low).all(axis=1)
    found = []
    for triangle in corners[near]:
        longest = max(np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1))
        count = int(np.clip(np.ceil(longest / spacing), 1, 200))
        first, second = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        keep = first + second <= count
        weights = np.stack([first[keep], second[keep], count - first[keep] - second[keep]], axis=1) / count
        points = weights @ triangle
        found.append(points[((points >= low) & (points <= high)).all(axis=1)])
    return np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 3))
