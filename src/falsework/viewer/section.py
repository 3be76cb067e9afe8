"""Meshes cut by a plane across an axis, with the cut closed where its outline is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from trimesh import Trimesh
from trimesh.intersections import mesh_plane, slice_faces_plane

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
Axis = Literal["x", "y", "z"]

_SAME = 1e-6
"""Distance below which ends of an outline count as one point, as a share of the size of the mesh."""


@dataclass(frozen=True)
class Plane:
    """Plane across an axis; what lies on one side of it is cut away."""

    axis: Axis
    at: float
    """Coordinate along the axis."""
    keeps_high: bool = False
    """Whether the side with higher coordinates stays."""

    @property
    def column(self) -> int:
        """Coordinate along the axis, 0 to 2."""
        return "xyz".index(self.axis)

    def heights(self, points: Array) -> Array:
        """Return the signed distances of points from the plane, positive where they stay; shape (...,)."""
        away = points[..., self.column] - self.at
        return away if self.keeps_high else -away


def cut(vertices: Array, faces: Faces, plane: Plane) -> tuple[Array, Faces]:
    """Return the rest of a mesh.

    Args:
        plane: where it is cut; points on it stay.

    Returns:
        Vertices and faces of what is left. The cut is closed as far as its outline is.
    """
    height = plane.heights(vertices)[faces]
    if not ((height < 0).any(axis=1) & (height > 0).any(axis=1)).any():
        return vertices, faces[(height >= 0).all(axis=1)]
    normal = np.zeros(3)
    normal[plane.column] = 1.0 if plane.keeps_high else -1.0
    origin = plane.at * np.abs(normal)
    points, rest = slice_faces_plane(vertices, faces, normal, origin)[:2]
    cap = _cap(mesh_plane(Trimesh(vertices, faces, process=False), normal, origin), plane)
    closed = np.arange(3 * len(cap)).reshape(-1, 3) + len(points)
    return np.concatenate([points, cap.reshape(-1, 3)]), np.concatenate([rest, closed])


def _cap(outline: Array, plane: Plane) -> Array:
    """Return triangles that fill an outline in the plane, shape (count, 3, 3); none where it is open.

    Args:
        outline: ends of its segments, shape (segments, 2, 3).
    """
    none = np.zeros((0, 3, 3))
    if not hasattr(shapely, "constrained_delaunay_triangles"):  # before shapely 2.1
        return none
    flat = [k for k in range(3) if k != plane.column]
    size = float(np.ptp(outline.reshape(-1, 3), axis=0).max(initial=0.0))
    if size == 0.0:
        return none
    ends = np.round(outline[:, :, flat] / (_SAME * size)) * (_SAME * size)
    ends = ends[(ends[:, 0] != ends[:, 1]).any(axis=1)]
    later = (ends[:, 0, 0] > ends[:, 1, 0]) | ((ends[:, 0, 0] == ends[:, 1, 0]) & (ends[:, 0, 1] > ends[:, 1, 1]))
    ends[later] = ends[later][:, ::-1]
    segments = shapely.multilinestrings(shapely.linestrings(np.unique(ends, axis=0)))
    area = shapely.build_area(segments)  # of nested outlines every other one is a hole
    corners = shapely.get_coordinates(shapely.constrained_delaunay_triangles(area)).reshape(-1, 4, 2)[:, :3]
    filled = np.full((*corners.shape[:2], 3), plane.at)
    filled[:, :, flat] = corners
    turned = np.cross(filled[:, 1] - filled[:, 0], filled[:, 2] - filled[:, 0])[:, plane.column] > 0
    back = turned == plane.keeps_high  # the cap faces the side that is cut away
    filled[back] = filled[back][:, ::-1]
    return filled
