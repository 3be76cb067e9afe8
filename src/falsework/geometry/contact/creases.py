"""Convex edges and corners of parts, which can touch another part along a line or at a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import Rows
from falsework.geometry.mesh.edges import directed_edges
from falsework.geometry.mesh.mesh import TriangleMesh, joined_faces, unit_normals

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_STRAIGHT = np.cos(np.radians(0.5))
"""Cosine of the largest turn between two edges that continue each other."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Faces and vertices of all parts, concatenated; faces without area, which carry no force, are left out."""

    points: Array
    """Shape (vertices, 3), metres."""
    faces: Index
    """Indices into `points`, shape (faces, 3)."""
    part: NDArray[np.int32]
    """Part of every face, shape (faces,)."""
    normals: Array
    """Outwards, unit length, shape (faces, 3)."""

    @staticmethod
    def from_meshes(meshes: Sequence[TriangleMesh]) -> Surface:
        """Collect the faces of all parts."""
        points, faces = joined_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
        part = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
        normals, solid = unit_normals(points[faces])
        return Surface(points, faces[solid], part[solid], normals)

    @cached_property
    def hanging(self) -> Array:
        """Unit vectors along two edges at each vertex, away from it; zero where it has none; shape (vertices, 2, 3)."""
        edges = np.zeros((len(self.points), 2, 3))
        for side in range(3):
            at = self.faces[:, side]
            for step in (1, 2):
                edges[at, step - 1] = self.points[self.faces[:, (side + step) % 3]] - self.points[at]
        return edges / np.maximum(np.linalg.norm(edges, axis=2), 1e-300)[:, :, None]

    @cached_property
    def corners(self) -> Array:
        """Corners of the faces, shape (faces, 3, 3), metres."""
        return self.points[self.faces]

    @cached_property
    def balls(self) -> tuple[Array, Array]:
        """Centres, shape (faces, 3), and radii, shape (faces,), of balls around the faces, metres."""
        centre: Array = self.corners.mean(axis=1)
        radius: Array = np.linalg.norm(self.corners - centre[:, None], axis=2).max(axis=1)
        return centre, radius


@dataclass(frozen=True, eq=False)
class Creases(Rows):
    """Convex edges of all parts, sorted by part."""

    tail: Array
    """Shape (edges, 3), metres."""
    along: Array
    """Unit vector from tail to head, shape (edges, 3)."""
    length: Array
    """Shape (edges,), metres."""
    into: Array
    """Unit vectors square to the edge, each along one of its two faces and away from it, shape (edges, 2, 3)."""
    turn: Array
    """Angle between the normals of the two faces, radians, shape (edges,)."""
    part: NDArray[np.int32]
    """Shape (edges,)."""
    face: Index
    """One face of each edge, shape (edges,)."""
    ends: NDArray[np.bool_]
    """Whether the tail and the head are ends: no convex edge goes straight on from there; shape (edges, 2)."""

    @staticmethod
    def from_surface(surface: Surface, least: float) -> Creases:
        """Find the convex edges whose faces differ by more than `least` degrees.

        Edges that more than two faces share are left out: which of them bound one solid wedge is not known.
        """
        tail, head = directed_edges(surface.faces)
        count = len(surface.points)
        ways, sides = tail * count + head, head * count + tail
        up, down = np.flatnonzero(tail < head), np.flatnonzero(tail > head)
        up = up[_single(ways[up])]
        down = down[_single(sides[down])]
        _, one, two = np.intersect1d(ways[up], sides[down], assume_unique=True, return_indices=True)
        one, two = up[one], down[two]
        a, b = one // 3, two // 3
        along = surface.points[head[one]] - surface.points[tail[one]]
        length = np.linalg.norm(along, axis=1)
        along = along / np.maximum(length, 1e-300)[:, None]
        first, second = surface.normals[a], surface.normals[b]
        sine = np.einsum("ij,ij->i", np.cross(first, second), along)
        turn = np.arctan2(sine, np.einsum("ij,ij->i", first, second))
        sharp = np.flatnonzero((turn > np.radians(least)) & (length > 0))
        sharp = sharp[np.argsort(surface.part[a[sharp]], kind="stable")]
        into = np.stack([np.cross(first[sharp], along[sharp]), np.cross(along[sharp], second[sharp])], axis=1).astype(
            np.float64, copy=False
        )
        vertices = np.stack([tail[one[sharp]], head[one[sharp]]], axis=1)
        return Creases(
            tail=surface.points[vertices[:, 0]],
            along=along[sharp],
            length=length[sharp],
            into=into,
            turn=turn[sharp],
            part=surface.part[a[sharp]],
            face=a[sharp],
            ends=_ends(vertices, along[sharp]),
        )


def _single(keys: Index) -> NDArray[np.bool_]:
    """Return the keys that occur once."""
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return counts[inverse] == 1


def _ends(vertices: Index, along: Array) -> NDArray[np.bool_]:
    """Return tails and heads of edges from which no other goes straight on, shape (edges, 2)."""
    at = vertices.T.ravel()
    away = np.concatenate([along, -along])
    order = np.argsort(at, kind="stable")
    start = np.searchsorted(at[order], at)
    row, place = expand(start, np.searchsorted(at[order], at, side="right"))
    straight = np.einsum("ij,ij->i", away[row], away[order[place]]) <= -_STRAIGHT
    goes_on = np.zeros(len(at), dtype=bool)
    goes_on[row[straight]] = True
    return ~goes_on.reshape(2, -1).T


def expand(start: NDArray[np.integer], stop: NDArray[np.integer]) -> tuple[Index, Index]:
    """Return all indices of the ranges `start[k]:stop[k]`, each with its `k`; shapes (sum of lengths,)."""
    counts = stop - start
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(start, counts)


def rises(surface: Surface, vertices: Index, normals: Array, least: float) -> NDArray[np.bool_]:
    """Return whether parts stand on planes through their vertices like a tip: all edges rise, and the tip is solid.

    Args:
        vertices: shape (candidates,).
        normals: of the planes, upwards, shape (candidates, 3).
        least: sine of the angle to the plane that every edge has to exceed.
    """
    corner = surface.faces.ravel()
    order = np.argsort(corner, kind="stable")
    start = np.searchsorted(corner[order], vertices)
    row, place = expand(start, np.searchsorted(corner[order], vertices, side="right"))
    at = order[place]
    face, side = at // 3, at % 3
    origin = surface.points[vertices[row]]
    height, foot = [], []
    for step in (1, 2):
        edge = surface.points[surface.faces[face, (side + step) % 3]] - origin
        up = np.einsum("ij,ij->i", edge, normals[row])
        height.append(up / np.maximum(np.linalg.norm(edge, axis=1), 1e-300))
        foot.append(edge / np.where(up > 0, up, 1.0)[:, None])
    lowest = np.full(len(vertices), np.inf)
    np.minimum.at(lowest, row, np.minimum(height[0], height[1]))
    # The faces, cut level above the tip, and their cut close a cone: they look down in sum if the inside is solid.
    area = np.einsum("ij,ij->i", np.cross(foot[0], foot[1]), normals[row])
    return (lowest > least) & (np.bincount(row, area, len(vertices)) < 0)
