"""Cones of blocked directions between parts, which prove that no exit direction lies between those found.

A convex piece of a part, translated along a direction without limit, meets a convex piece of another part if and only
if the direction lies in the cone over the Minkowski difference of the two. That cone is convex and has flat facets
(Lozano-Perez, Spatial Planning: A Configuration Space Approach, 1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.utils.kernels import njit

Array = NDArray[np.float64]

_STRICT = 1e-9
"""A direction this near to a facet, as a sine, counts as outside of the cone."""
_TRIANGLES = 128
"""Number of largest faces that represent a part without one convex piece."""
_CORNERS = 10_000
"""Corners of a Minkowski difference up to which its cone is computed."""
_CROSSES = 1_000
"""Pairs of edges tried for a separating plane between two pieces."""


@dataclass(frozen=True, eq=False)
class Cones:
    """Convex cones of directions in which one part blocks another.

    A direction `d` of unit length lies in cone `k` if `facets @ d > offset` for all its facets
    `start[k]:start[k + 1]`. All offsets are zero or positive, so a cone holds with some directions all
    directions between them.
    """

    facets: Array
    """Inward unit normals, shape (facets, 3)."""
    offset: Array
    """Shape (facets,)."""
    start: NDArray[np.int64]
    """Shape (cones + 1,)."""
    part: NDArray[np.int64]
    """Blocking part, shape (cones,)."""

    def __len__(self) -> int:
        return len(self.part)

    @classmethod
    def from_half_spaces(cls, normals: Array, offset: float, parts: Sequence[int] | NDArray[np.integer]) -> Cones:
        """Return cones of one facet each: all directions with more than `offset` along a normal, shape (cones, 3)."""
        count = len(normals)
        return cls(
            np.asarray(normals, dtype=np.float64).reshape(-1, 3),
            np.full(count, offset),
            np.arange(count + 1),
            np.asarray(parts, dtype=np.int64),
        )

    @classmethod
    def concatenate(cls, several: Sequence[Cones]) -> Cones:
        """Return all cones of several sets."""
        sizes = np.concatenate([np.zeros(0, np.int64), *(np.diff(cones.start) for cones in several)])
        return cls(
            np.concatenate([np.zeros((0, 3)), *(cones.facets for cones in several)]),
            np.concatenate([np.zeros(0), *(cones.offset for cones in several)]),
            np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *(cones.part for cones in several)]),
        )

    def take(self, parts: NDArray[np.integer]) -> Cones:
        """Return the cones of some parts only."""
        kept = np.isin(self.part, parts)
        rows = np.repeat(kept, np.diff(self.start))
        start = np.concatenate([[0], np.cumsum(np.diff(self.start)[kept])]).astype(np.int64)
        return Cones(self.facets[rows], self.offset[rows], start, self.part[kept])


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces of one part."""

    points: Array
    """Corners of all pieces, shape (points, 3), metres."""
    start: NDArray[np.int64]
    """Piece `k` has the corners `start[k]:start[k + 1]`, shape (pieces + 1,)."""
    normals: Array
    """Unit normals of planes that may separate, as many for each piece, shape (pieces, normals, 3)."""
    edges: Array
    """Directions of edges, as many for each piece, shape (pieces, edges, 3)."""

    @classmethod
    def from_mesh(cls, mesh: TriangleMesh, vertices: Array, depth: float) -> Pieces:
        """Cover a shrunken part by convex pieces that lie inside the part.

        Where all vertices lie at least `depth` behind the planes of all faces, so does their convex hull, which is
        then the only piece; what lies behind all planes of faces lies inside. Otherwise the pieces are the
        faces themselves, the largest ones.

        Args:
            mesh: the part.
            vertices: its vertices after shrinking, shape (vertices, 3), metres.
            depth: metres.
        """
        corners = mesh.triangles
        normals = triangle_normals(corners)
        length = np.linalg.norm(normals, axis=1)
        solid = np.flatnonzero(length > 0)
        normals = normals[solid] / length[solid, None]
        level = np.einsum("fi,fi->f", normals, corners[solid, 0])
        faces = mesh.faces[solid]
        if (vertices @ normals.T <= level - depth).all():
            edges = (vertices[faces] - vertices[np.roll(faces, 1, axis=1)]).reshape(-1, 3)
            edges = edges[np.linalg.norm(edges, axis=1) > 0]
            edges *= np.where(edges[:, :1] + 0.1 * edges[:, 1:2] < 0, -1.0, 1.0)
            edges = np.unique(np.round(edges / np.linalg.norm(edges, axis=1)[:, None], 6), axis=0)
            normals = np.unique(np.round(normals, 12), axis=0)
            return cls(vertices, np.array([0, len(vertices)]), normals[None], edges[None])
        chosen = np.argsort(-length[solid], kind="stable")[:_TRIANGLES]
        pieces = vertices[faces[chosen]]
        sides = pieces - np.roll(pieces, 1, axis=1)
        across = np.cross(sides[:, 0], sides[:, 1])[:, None]
        size = np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-300)
        return cls(pieces.reshape(-1, 3), 3 * np.arange(len(chosen) + 1), across / size, sides)


def cones_between(moving: Pieces, obstacle: Pieces, part: int) -> Cones:
    """Return cones of directions in which pieces of one part run into pieces of another, `part`.

    A pair of pieces without a known separating plane is omitted, which gives fewer cones, but correct ones.
    """
    facets, sizes = _cones(
        moving.points, moving.start, moving.normals, moving.edges,
        obstacle.points, obstacle.start, obstacle.normals, obstacle.edges,
    )  # fmt: skip
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return Cones(facets, np.full(len(facets), _STRICT), start, np.full(len(sizes), part, dtype=np.int64))


@njit(cache=True)
def _cones(
    p: Array, p_start: NDArray[np.int64], p_normals: Array, p_edges: Array,
    q: Array, q_start: NDArray[np.int64], q_normals: Array, q_edges: Array,
) -> tuple[Array, NDArray[np.int64]]:  # fmt: skip # pragma: no cover - compiled
    """Return facets of the cones of all pairs of pieces, and how many each cone has."""
    facets = np.empty((64, 3))
    sizes = np.empty(len(p_normals) * len(q_normals), dtype=np.int64)
    used = cones = 0
    for i in range(len(p_normals)):
        a = p[p_start[i] : p_start[i + 1]]
        for j in range(len(q_normals)):
            b = q[q_start[j] : q_start[j + 1]]
            if len(a) * len(b) > _CORNERS:
                continue
            found, axis = _separating(a, b, p_normals[i], q_normals[j], p_edges[i], q_edges[j])
            if not found:
                continue
            cone = _facets(a, b, axis)
            if len(cone) < 3:
                continue
            while used + len(cone) > len(facets):
                facets = np.concatenate((facets, facets))
            for k in range(len(cone)):
                for m in range(3):
                    facets[used, m] = cone[k, m]
                used += 1
            sizes[cones] = len(cone)
            cones += 1
    return facets[:used].copy(), sizes[:cones].copy()


@njit(cache=True)
def _gap(a: Array, b: Array, x: float, y: float, z: float) -> float:  # pragma: no cover - compiled
    """Return the distance by which `b` lies ahead of `a` along an axis."""
    far, near = -np.inf, np.inf
    for k in range(len(a)):
        far = max(far, x * a[k, 0] + y * a[k, 1] + z * a[k, 2])
    for k in range(len(b)):
        near = min(near, x * b[k, 0] + y * b[k, 1] + z * b[k, 2])
        if near < far:
            return near - far
    return near - far


@njit(cache=True)
def _length(a: Array) -> float:  # pragma: no cover - compiled
    return np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@njit(cache=True)
def _cross(a: Array, b: Array) -> tuple[float, float, float]:  # pragma: no cover - compiled
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _separating(
    a: Array, b: Array, a_normals: Array, b_normals: Array, a_edges: Array, b_edges: Array
) -> tuple[bool, Array]:  # pragma: no cover - compiled
    """Return an axis along which `b` lies wholly ahead of `a`: the best face normal, else a product of two edges."""
    best, axis = 1e-9, np.zeros(3)
    for normals in (a_normals, b_normals):
        for k in range(len(normals)):
            x, y, z = normals[k, 0], normals[k, 1], normals[k, 2]
            for sign in (1.0, -1.0):
                gap = _gap(a, b, sign * x, sign * y, sign * z)
                if gap > best:
                    best = gap
                    axis[0], axis[1], axis[2] = sign * x, sign * y, sign * z
    if best > 1e-9 or len(a_edges) * len(b_edges) > _CROSSES:
        return best > 1e-9, axis
    for k in range(len(a_edges)):
        for m in range(len(b_edges)):
            x, y, z = _cross(a_edges[k], b_edges[m])
            size = np.sqrt(x * x + y * y + z * z)
            if size < 1e-6 * _length(a_edges[k]) * _length(b_edges[m]):
                continue
            for sign in (1.0 / size, -1.0 / size):
                gap = _gap(a, b, sign * x, sign * y, sign * z)
                if gap > best:
                    best = gap
                    axis[0], axis[1], axis[2] = sign * x, sign * y, sign * z
    return best > 1e-9, axis


@njit(cache=True)
def _facets(a: Array, b: Array, axis: Array) -> Array:  # pragma: no cover - compiled
    """Return inward normals of the cone over `b - a`, all of which lies ahead along the axis; shape (facets, 3).

    The cone is cut by the plane at one along the axis, and the convex hull of the section is found by Andrew's
    chain. A corner that hardly protrudes is omitted, which makes the cone smaller.
    """
    least = 0
    for k in range(1, 3):
        if abs(axis[k]) < abs(axis[least]):
            least = k
    other, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
    other[least] = 1.0
    u[0], u[1], u[2] = _cross(axis, other)
    size = _length(u)
    for k in range(3):
        u[k] /= size
    v[0], v[1], v[2] = _cross(axis, u)
    count = len(a) * len(b)
    right, up = np.empty(count), np.empty(count)
    row = 0
    for i in range(len(a)):
        for j in range(len(b)):
            x, y, z = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1], b[j, 2] - a[i, 2]
            ahead = x * axis[0] + y * axis[1] + z * axis[2]
            right[row] = (x * u[0] + y * u[1] + z * u[2]) / ahead
            up[row] = (x * v[0] + y * v[1] + z * v[2]) / ahead
            row += 1
    order = np.argsort(up, kind="mergesort")
    order = order[np.argsort(right[order], kind="mergesort")]
    hull = np.empty(2 * count, dtype=np.int64)
    size = 0
    for turn in range(2):
        floor = size + 1
        for step in range(turn, count):
            k = order[step] if turn == 0 else order[count - 1 - step]
            while size > floor - turn:
                o, m = hull[size - 2], hull[size - 1]
                ax, ay = right[m] - right[o], up[m] - up[o]
                bx, by = right[k] - right[o], up[k] - up[o]
                if ax * by - ay * bx > 1e-9 * np.sqrt((ax * ax + ay * ay) * (bx * bx + by * by)):
                    break
                size -= 1
            hull[size] = k
            size += 1
    size -= 1
    if size < 3:
        return np.empty((0, 3))
    middle, one, two = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(size):
        for m in range(3):
            middle[m] += (right[hull[k]] * u[m] + up[hull[k]] * v[m] + axis[m]) / size
    facets = np.empty((size, 3))
    for k in range(size):
        for m in range(3):
            one[m] = right[hull[k]] * u[m] + up[hull[k]] * v[m] + axis[m]
            two[m] = right[hull[(k + 1) % size]] * u[m] + up[hull[(k + 1) % size]] * v[m] + axis[m]
        x, y, z = _cross(one, two)
        length = np.sqrt(x * x + y * y + z * z)
        if length < 1e-12:
            return np.empty((0, 3))
        if x * middle[0] + y * middle[1] + z * middle[2] < 0:
            length = -length
        facets[k, 0], facets[k, 1], facets[k, 2] = x / length, y / length, z / length
    return facets
