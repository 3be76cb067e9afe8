"""Parts of a structure as bodies in a cell: placed, scaled and covered by convex pieces.

The cover is exact for unions of boxes, tight for most meshes, and not smaller than the solid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.assembly.groups import groups_of
from falsework.assembly.model import Assembly
from falsework.geometry.arrays import apply
from falsework.geometry.clearance.moves import PathMove
from falsework.geometry.mesh.bodies import merge_equal
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.robots.model.cell import Placement
from falsework.robots.model.shapes import Array, Pieces, hull, move_pieces
from falsework.utils.lazy import importing

MAX_PIECES = 32
"""Largest number of pieces per part; beyond it the cover stays looser than the tolerance."""
IDLE_CUTS = 2
"""Consecutive cuts that may gain nothing: a ring must be halved before a cut of the halves helps."""
CUT_PLANES = 10
"""Number of planes of faces tried per cut."""
_SKIN = 1e-7
"""Share of the size of a solid below which a detail of it is a rounding error."""


class _Solid:
    """Solid that manifold3d cuts, with its convex hull."""

    def __init__(self, solid: Any, idle: int = 0) -> None:
        """Take a solid that came about by `idle` cuts in succession that gained nothing."""
        hull = solid.hull()
        self.solid, self.idle, self.volume = solid, idle, float(hull.volume())
        self.corners: Array = np.array(hull.to_mesh64().vert_properties[:, :3])
        self.size = float(np.ptp(self.corners, axis=0).max())
        self.whole = False
        """Whether no cut gains anything."""

    def cut(self, plane: Array, idle: int = 0) -> tuple[_Solid, _Solid] | None:
        """Return what is in front of a plane `n . x = d`, (n, d) of shape (4,), and behind it; None if that is all."""
        # Where a plane goes through a face, rounding leaves skins as wide as the face.
        halves = [half.simplify(_SKIN * self.size) for half in self.solid.split_by_plane(plane[:3], plane[3])]
        if min(half.volume() for half in halves) <= _SKIN * self.volume:
            return None
        return _Solid(halves[0], idle), _Solid(halves[1], idle)

    def best_cut(self) -> tuple[_Solid, _Solid] | None:
        """Return the cut with the least hull volume of its two sides together; None if none gains a thousandth."""
        best, chosen = self.volume * (1 - 1e-3), None
        for plane in self._planes():
            halves = self.cut(plane)
            if halves is not None and sum(half.volume for half in halves) < best * (1 - 1e-9):
                best, chosen = sum(half.volume for half in halves), halves
        self.whole = chosen is None
        return chosen

    def halves(self) -> tuple[_Solid, _Solid] | None:
        """Return the cut across the middle of the longest side, even without gain."""
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        axis = int(np.argmax(high - low))
        return self.cut(np.append(np.eye(3)[axis], (low[axis] + high[axis]) / 2), self.idle + 1)

    def _planes(self) -> list[Array]:
        """Return planes of faces inside the hull, each once and the largest first, and planes across its middle."""
        mesh = self.solid.to_mesh64()
        corners = mesh.vert_properties[:, :3][mesh.tri_verts]
        normals = triangle_normals(corners)
        area = np.linalg.norm(normals, axis=1)
        good = area > area.max() * 1e-6
        normals = normals[good] / area[good, None]
        levels = np.einsum("ij,ij->i", normals, corners[good, 0])
        # A face plane cuts if there is solid in front of it.
        front = (self.corners @ normals.T).max(axis=0) - levels > 1e-4 * self.size
        key = np.round(np.c_[normals, levels / self.size][front] * 1e4).astype(np.int64)
        flip = np.sign(key[np.arange(len(key)), np.argmax(np.abs(key) > 10, axis=1)])
        _, first, where = np.unique(key * flip[:, None], axis=0, return_index=True, return_inverse=True)
        weight = np.bincount(where.reshape(-1), area[good][front])
        order = np.argsort(-np.round(weight, 12), kind="stable")[:CUT_PLANES]
        planes = [np.append(normals[front][first[k]], levels[front][first[k]]) for k in order.tolist()]
        axes = np.linalg.svd(self.corners - self.corners.mean(axis=0), full_matrices=False)[2]
        for axis in (*np.eye(3), *axes):
            low, high = (self.corners @ axis).min(), (self.corners @ axis).max()
            planes.append(np.append(axis, (low + high) / 2))
        return planes


def convex_pieces(mesh: TriangleMesh, tolerance: float = 0.05, pieces: int = MAX_PIECES) -> Pieces:
    """Return at most some convex pieces whose union contains the solid that a mesh encloses.

    The solid is cut by planes, in each step where that reduces the volume of the convex hulls most, until together
    they exceed the solid by at most the share `tolerance`. Every piece is the hull of what it covers, so no part of the
    solid is ever outside by more than `_SKIN` of its size; where the limit of pieces is reached first, or a surface is
    curved, the cover is larger than the solid and motions keep a larger distance than necessary. A surface that is no
    manifold gets one piece.
    """
    corners, solid = hull(mesh.vertices), mesh.volume
    if float(ConvexHull(corners).volume) <= solid * (1 + tolerance):
        return (corners,)
    with importing("parts that are not convex need manifold3d: pip install 'falsework[robots]'"):
        import manifold3d
    kernel: Any = manifold3d
    points, faces = merge_equal(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))
    whole = kernel.Manifold(kernel.Mesh64(points, faces.astype(np.uint64)))
    if whole.status() != kernel.Error.NoError or whole.is_empty():
        return (corners,)
    parts = [_Solid(whole)]
    while len(parts) < pieces and sum(part.volume for part in parts) > solid * (1 + tolerance):
        order = np.argsort([-part.volume for part in parts], kind="stable").tolist()
        tried = ((index, parts[index].best_cut()) for index in order if not parts[index].whole)
        index, halves = next((cut for cut in tried if cut[1] is not None), (-1, None))
        if halves is None:
            index = next((k for k in order if parts[k].idle < IDLE_CUTS), -1)
            halves = parts[index].halves() if index >= 0 else None
        if halves is None:
            break
        parts[index : index + 1] = halves
    return tuple(hull(part.corners) for part in parts)


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
        TriangleMesh(mesh.name, np.ascontiguousarray(apply(world, scale * mesh.vertices)), mesh.faces)
        for mesh in assembly.meshes
    )
    pieces = tuple(
        move_pieces(world, tuple(scale * piece for piece in _cover(mesh, tolerance))) for mesh in assembly.meshes
    )
    mass = placed_mass(assembly, placement)
    center = apply(world, scale * assembly.mass.center)
    for array in (mass, center):
        array.setflags(write=False)
    groups = groups_of(assembly)
    gripped = {} if groups is None else groups.carried_faces
    return PartShapes(assembly.names, assembly.boundary, meshes, pieces, mass, center, world[:3, :3], gripped)


def _cover(mesh: TriangleMesh, tolerance: float) -> Pieces:
    """Return `convex_pieces` of a mesh, or those of the last call with this tolerance again."""
    known = _covers.get(mesh)
    if known is None or known[0] != tolerance:
        known = _covers[mesh] = tolerance, convex_pieces(mesh, tolerance)
    return known[1]


_covers: WeakKeyDictionary[TriangleMesh, tuple[float, Pieces]] = WeakKeyDictionary()
"""Tolerance and convex pieces of each mesh that was asked for last; plans and checks of one structure share them."""


def placed_mass(assembly: Assembly, placement: Placement) -> Array:
    """Return the masses of the parts in a cell, which may scale them and change their density, kg, shape (parts,)."""
    density = 1.0 if placement.density is None else placement.density / assembly.density
    return assembly.mass.mass * density * placement.scale**3


def placed_move(move: PathMove, placement: Placement) -> PathMove:
    """Return a move of a part of the structure in the frame of the world."""
    x, y, z = (placement.pose[:3, :3] @ move.direction).tolist()
    a, b, c = apply(placement.pose, placement.scale * np.array(move.point)).tolist()
    return replace(move, direction=(x, y, z), distance=placement.scale * move.distance, point=(a, b, c))
