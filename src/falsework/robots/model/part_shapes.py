"""Parts of a structure as bodies in a cell: placed, scaled and covered by convex pieces.

The cover is exact for unions of boxes, tight for most meshes, and never smaller than the solid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from falsework.assembly.groups import groups_of
from falsework.assembly.model import Assembly
from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.model.cell import Placement
from falsework.robots.model.shapes import Pieces, hull, move, move_pieces
from falsework.utils.arrays import Array

MAX_PIECES = 32
"""Largest number of pieces per part; beyond it the cover stays looser than the tolerance."""
IDLE_CUTS = 2
"""Consecutive cuts that may gain nothing: a ring must be halved before a cut of the halves helps."""
CUT_PLANES = 10
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

    @cached_property
    def normals(self) -> Array:
        """Normals of the triangles, as long as twice their areas, shape (triangles, 3)."""
        (x, y, z), (u, v, w) = (
            (self.triangles[:, 1] - self.triangles[:, 0]).T,
            (self.triangles[:, 2] - self.triangles[:, 0]).T,
        )
        return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)

    @cached_property
    def size(self) -> float:
        """Largest extent along an axis, metres."""
        return float(np.ptp(self.corners, axis=0).max())

    @cached_property
    def indexed(self) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """Distinct corners of the triangles, shape (corners, 3), and those of each triangle and edge, by index."""
        corners, index = np.unique(self.triangles.reshape(-1, 3), axis=0, return_inverse=True)
        faces = index.reshape(-1, 3)
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
        edges = np.unique(np.sort(ends, axis=1), axis=0)
        return corners, faces, edges

    def heights(self, points: Array, plane: Array) -> Array:
        """Return heights of points of the surface above a plane, zero where they hardly differ from it."""
        height = points @ plane[:3] - plane[3]
        height[np.abs(height) < 1e-9 * max(self.size, 1e-9)] = 0.0
        return height


def convex_pieces(mesh: TriangleMesh, tolerance: float = 0.05, pieces: int = MAX_PIECES) -> Pieces:
    """Return at most some convex pieces whose union contains the solid that a mesh encloses.

    The solid is cut by planes, in each step where that reduces the volume of the convex hulls most, until together
    they exceed the solid by at most the share `tolerance`. Every piece is the hull of what it covers, so no part of the
    solid is ever outside; where the limit of pieces is reached first, or a surface is curved, the cover is larger than
    the solid and motions keep a larger distance than necessary. InputError if the mesh spans no volume.
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
        total = _volume_of_halves(part, plane)
        if total < best * (1 - 1e-9):
            best, chosen = total, plane
    if chosen is None:
        return None
    one, other = _clip(part, chosen, mesh), _clip(part, -chosen, mesh)
    if one is None or other is None or one.volume + other.volume >= most:
        return None
    return one, other


def _candidates(part: _Cut) -> list[Array]:
    """Return planes of faces inside the hull, and planes across its middle; shape (4,) each."""
    area, size = np.linalg.norm(part.normals, axis=1), part.size
    good = area > area.max() * 1e-6
    normals = part.normals[good] / area[good, None]
    levels = np.einsum("ij,ij->i", normals, part.triangles[good, 0])
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


def _volume_of_halves(part: _Cut, plane: Array) -> float:
    """Return about the volume of the hulls of both sides of a plane, infinite if either is negligible."""
    corners, faces, edges = part.indexed
    height = part.heights(corners, plane)
    levels = height[faces]
    ends = height[edges]
    cut = ends[:, 0] * ends[:, 1] < 0
    tail, head = corners[edges[cut, 0]], corners[edges[cut, 1]]
    between = tail + (ends[cut, 0] / (ends[cut, 0] - ends[cut, 1]))[:, None] * (head - tail)
    total = 0.0
    for side in (-1.0, 1.0):
        # Corners in the plane count where a triangle leads from them to this side.
        there = np.zeros(len(corners), bool)
        there[faces[(side * levels > 0).any(axis=1)]] = True
        there &= side * height >= 0
        try:
            total += float(ConvexHull(np.concatenate([corners[there], between])).volume)
        except (QhullError, ValueError):
            return np.inf
    return total


def _clip(part: _Cut, plane: Array, mesh: TriangleMesh) -> _Cut | None:
    """Return the part behind a plane, or None if it is negligible."""
    height = part.heights(part.triangles, plane)
    below, above = (height < 0).any(axis=1), (height > 0).any(axis=1)
    # A face in the plane bounds the part behind it if its normal agrees, else the part in front.
    whole, across = ~above & (below | (part.normals @ plane[:3] > 0)), below & above
    triangles = np.concatenate([part.triangles[whole], _split(part.triangles[across], height[across])])
    if len(triangles) < 2:
        return None
    planes = (*part.planes, plane)
    points = np.concatenate([triangles.reshape(-1, 3), _inner_corners(planes, mesh, part.size)])
    try:
        made = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    return _Cut(triangles, planes, hull(points[made.vertices]), float(made.volume))


def _split(triangles: Array, height: Array) -> Array:
    """Return the parts of triangles behind a plane, as triangles."""
    ahead, following = np.roll(triangles, -1, axis=1), np.roll(height, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = triangles + (height / (height - following))[:, :, None] * (ahead - triangles)
    # Every corner that is not before the plane, and the crossing on the edge that begins at it, in turn.
    points = np.stack([triangles, crossing], axis=2).reshape(-1, 6, 3)
    there = np.stack([height <= 0, height * following < 0], axis=2).reshape(-1, 6)
    order = np.argsort(~there, axis=1, kind="stable")[:, :4, None]
    polygon = np.take_along_axis(points, order, axis=1)
    fans = np.stack([polygon[:, [0, 1, 2]], polygon[:, [0, 2, 3]]], axis=1)
    return fans[np.stack([np.ones(len(fans), bool), there.sum(axis=1) == 4], axis=1)]


def _inner_corners(planes: tuple[Array, ...], mesh: TriangleMesh, size: float) -> Array:
    """Return the points where three cuts meet inside the solid. Shape (corners, 3)."""
    three = list(combinations(range(len(planes)), 3))
    if not three:
        return np.zeros((0, 3))
    all_planes = np.array(planes)
    chosen = all_planes[three]
    meet = np.abs(np.linalg.det(chosen[:, :, :3])) > 1e-6
    points: Array = np.linalg.solve(chosen[meet, :, :3], chosen[meet, :, 3:])[:, :, 0].astype(np.float64)
    behind = (points @ all_planes[:, :3].T - all_planes[:, 3] <= 1e-9 * size).all(axis=1)
    points = points[behind]
    return points[inside(points, mesh.triangles)] if len(points) else np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class PartShapes:
    """Parts of a structure at their places in a cell; the pose of a part is its displacement from there."""

    names: tuple[str, ...]
    boundary: NDArray[np.bool_]
    """Shape (parts,)."""
    meshes: tuple[TriangleMesh, ...]
    """Exact surfaces in the world frame, metres."""
    pieces: tuple[Pieces, ...]
    """Convex pieces in the world frame that cover each part; exact for convex parts."""
    mass: Array
    """Masses in the cell, kg, shape (parts,)."""
    center: Array
    """Centres of mass in the world frame, shape (parts, 3)."""
    turn: Array
    """Rotation from the structure's frame to the world, shape (3, 3): for directions of the clearance table."""
    gripped: Mapping[int, int] = field(default_factory=dict)
    """Of joined parts, the number of their first faces: those of the part that robots hold."""

    def surface(self, part: int) -> TriangleMesh:
        """Return the faces of a part that robots may grip: all, but of joined parts those of the one that is held."""
        mesh = self.meshes[part]
        return TriangleMesh(mesh.name, mesh.vertices, mesh.faces[: self.gripped.get(part, len(mesh.faces))])

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.names)


def place_parts(assembly: Assembly, placement: Placement = Placement(), *, tolerance: float = 0.05) -> PartShapes:
    """Place the parts of a structure in a cell; convex pieces may exceed them by a share, as of `convex_pieces`."""
    scale, world = placement.scale, placement.pose
    meshes = tuple(
        TriangleMesh(mesh.name, np.ascontiguousarray(move(world, scale * mesh.vertices)), mesh.faces)
        for mesh in assembly.meshes
    )
    pieces = tuple(
        move_pieces(world, tuple(scale * piece for piece in convex_pieces(mesh, tolerance))) for mesh in assembly.meshes
    )
    density = 1.0 if placement.density is None else placement.density / assembly.density
    mass = assembly.mass.mass * density * scale**3
    center = move(world, scale * assembly.mass.center)
    for array in (mass, center):
        array.setflags(write=False)
    groups = groups_of(assembly)
    gripped = {} if groups is None else groups.carried_faces
    return PartShapes(assembly.names, assembly.boundary, meshes, pieces, mass, center, world[:3, :3], gripped)
