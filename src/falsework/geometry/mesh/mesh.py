"""Triangle meshes of parts and their mass properties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import MeshError
from falsework.geometry.arrays import box_around, read_only
from falsework.utils.quantity import format_quantity


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Closed surface of one rigid part, in metres."""

    name: str
    vertices: NDArray[np.float64]
    """Shape (vertices, 3), metres, read-only."""
    faces: NDArray[np.int32]
    """Shape (faces, 3), counter-clockwise seen from outside, read-only."""

    def __repr__(self) -> str:
        return f"<TriangleMesh {self.name}: {len(self.vertices)} vertices, {len(self.faces)} faces>"

    @staticmethod
    def from_arrays(name: str, vertices: ArrayLike, faces: ArrayLike) -> TriangleMesh:
        """Copy arrays into a mesh after checking shapes and indices only.

        Args:
            name: name of the part in messages.
            vertices: shape (vertices, 3), metres.
            faces: indices into `vertices`, shape (faces, 3).

        Raises:
            MeshError: wrong shapes, or indices that no vertex has.
        """
        points = np.array(vertices, dtype=np.float64, order="C")
        corners = np.array(faces, dtype=np.int32, order="C")
        if points.ndim != 2 or points.shape[1] != 3:
            raise MeshError(f"part {name}: vertices have shape {points.shape}; expected (vertices, 3)")
        if corners.ndim != 2 or corners.shape[1] != 3:
            raise MeshError(f"part {name}: faces have shape {corners.shape}; expected (faces, 3)")
        if len(corners) and (corners.min() < 0 or corners.max() >= len(points)):
            raise MeshError(f"part {name}: a face uses a vertex that does not exist; there are {len(points)} vertices")
        return TriangleMesh(name, *read_only(points, corners))

    @property
    def triangles(self) -> NDArray[np.float64]:
        """Corners of the faces, shape (faces, 3, 3), metres."""
        return self.vertices[self.faces]

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest coordinates, shape (2, 3), metres."""
        return read_only(box_around(self.vertices))[0]

    @property
    def volume(self) -> float:
        """Signed volume, m3; negative if the faces look inwards."""
        local = self.triangles - self.vertices[0]
        return float(np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])).sum() / 6.0)

    @cached_property
    def thickness(self) -> float:
        """Twice the volume by the surface, metres: the thickness of a plate, a third of the edge of a cube."""
        corners = self.triangles
        cross = triangle_normals(corners)
        return 4.0 * self.volume / float(np.linalg.norm(cross, axis=1).sum())


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Masses, centres and inertias of all parts of a structure."""

    mass: NDArray[np.float64]
    """Shape (parts,), kg."""
    center: NDArray[np.float64]
    """Centres of mass, shape (parts, 3), metres."""
    inertia: NDArray[np.float64]
    """About the centre of mass in world axes, shape (parts, 3, 3), kg m2."""
    volume: NDArray[np.float64]
    """Shape (parts,), m3."""

    @property
    def gyration(self) -> NDArray[np.float64]:
        """Largest radius of gyration of each part, about an axis through its centre of mass: shape (parts,), metres."""
        return np.sqrt(np.linalg.eigvalsh(self.inertia)[:, -1] / self.mass)


def triangle_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return normals of triangles by the right-hand rule, twice as long as the areas, shape (triangles, 3).

    Args:
        corners: shape (triangles, 3, 3).
    """
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def unit_normals(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the unit normals of triangles with an area, shape (count, 3), and which of them have one, (triangles,)."""
    normals = triangle_normals(corners)
    length = np.linalg.norm(normals, axis=1)
    solid = length > 0
    return normals[solid] / length[solid, None], solid


def joined_faces(
    vertices: Sequence[NDArray[Any]], faces: Sequence[NDArray[Any]]
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return the vertices of several surfaces after each other, and the faces of all with indices into these."""
    first = np.cumsum([0, *map(len, vertices)])
    return np.concatenate(vertices), np.concatenate([some + at for some, at in zip(faces, first, strict=False)])


def mass_properties(meshes: Sequence[TriangleMesh], density: NDArray[np.float64]) -> MassProperties:
    """Return mass, centre of mass and inertia of homogeneous parts, exact for their meshes.

    Every face spans a tetrahedron with the centre of the part's bounding box; moments of signed
    tetrahedra add up to those of the solid (divergence theorem).

    Args:
        meshes: closed meshes that face outwards.
        density: shape (parts,), kg/m3.

    Raises:
        MeshError: a part whose volume is not positive.
    """
    counts = np.array([len(mesh.faces) for mesh in meshes])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    anchor = np.array([mesh.bounds.mean(axis=0) for mesh in meshes])
    corners = np.concatenate([mesh.triangles for mesh in meshes]) - np.repeat(anchor, counts, axis=0)[:, None, :]
    six_volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    corner_sum = corners.sum(axis=1)
    products = np.einsum("fvi,fvj->fij", corners, corners) + corner_sum[:, :, None] * corner_sum[:, None, :]

    volume = np.add.reduceat(six_volumes, first) / 6.0
    if not (volume > 0).all():
        part = int(np.argmin(volume > 0))
        raise MeshError(
            f"part {meshes[part].name} has volume {format_quantity(volume[part], 'volume')}; it must enclose a "
            f"positive volume"
        )
    offset = np.add.reduceat(six_volumes[:, None] * corner_sum, first) / 24.0 / volume[:, None]
    second = np.add.reduceat(six_volumes[:, None, None] * products, first) / 120.0
    second -= volume[:, None, None] * offset[:, :, None] * offset[:, None, :]
    trace = np.trace(second, axis1=1, axis2=2)
    inertia = trace[:, None, None] * np.eye(3) - second
    return MassProperties(*read_only(density * volume, anchor + offset, density[:, None, None] * inertia, volume))


def ground_slab(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return a slab whose top is level with the lowest point and that reaches past the parts on all sides."""
    low = np.min([mesh.bounds[0] for mesh in meshes], axis=0)
    high = np.max([mesh.bounds[1] for mesh in meshes], axis=0)
    size = float((high - low).max())
    bottom = np.array([low[0] - 0.1 * size, low[1] - 0.1 * size, low[2] - 0.05 * size])
    top = np.array([high[0] + 0.1 * size, high[1] + 0.1 * size, low[2]])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]  # fmt: skip
    taken = {mesh.name for mesh in meshes}
    name = next(name for name in ("ground", *(f"ground-{n}" for n in range(len(meshes)))) if name not in taken)
    return TriangleMesh.from_arrays(name, np.where(corners, top, bottom), faces)
