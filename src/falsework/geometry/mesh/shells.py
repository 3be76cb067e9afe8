"""Closed surfaces of one part: hollows, overlaps and union."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.mesh.bodies import surfaces_of
from falsework.geometry.mesh.collision import Body, inside, interpenetrate, shrink
from falsework.geometry.mesh.edges import components, edge_mates, is_closed
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

_SHALLOW = 1e-6
"""Depth, relative to the diagonal of a part, up to which surfaces that overlap count as touching."""


@dataclass(frozen=True, eq=False)
class Shells:
    """The closed surfaces of a part, each as a solid of its own that faces outwards."""

    surface: NDArray[np.int64]
    """Shell that each face belongs to, shape (faces,)."""
    outward: NDArray[np.bool_]
    """Whether the shell faced outwards as it was given, shape (shells,)."""
    solids: tuple[TriangleMesh, ...]

    @staticmethod
    def from_mesh(points: Array, corners: Faces) -> Shells:
        """Split a closed mesh, shapes (vertices, 3) and (faces, 3)."""
        surface = _surfaces(points, corners)
        local = points[corners] - points.mean(axis=0)
        six_volumes = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2]))
        outward = np.bincount(surface, six_volumes) > 0
        solids = []
        for shell in range(len(outward)):
            used, faces = np.unique(corners[surface == shell], return_inverse=True)
            faces = faces.reshape(-1, 3)
            solids.append(TriangleMesh.from_arrays("", points[used], faces if outward[shell] else faces[:, ::-1]))
        return Shells(surface, outward, tuple(solids))

    @property
    def count(self) -> int:
        """Number of separate solids, if none overlap: shells that bound no hollow and have a volume worth the name."""
        volume = np.array([solid.volume for solid in self.solids])
        return int((~self._hollow & (volume > _SHALLOW * volume.max())).sum())

    def outward_faces(self, corners: Faces) -> Faces:
        """Return faces turned away from the material: outwards, or inwards where a shell bounds a hollow."""
        turned = corners.copy()
        wrong = (self.outward == self._hollow)[self.surface]
        turned[wrong] = turned[wrong][:, ::-1]
        return turned

    def overlap(self) -> bool:
        """Return whether shells share space and neither encloses the other."""
        return any(
            interpenetrate(self.solids[a], self.solids[b], self._shallow)
            for a, b in combinations(range(len(self.solids)), 2)
            if not (self._within[a, b] or self._within[b, a]) and self._near(a, b)
        )

    def unite(self, name: str) -> tuple[Array, Faces, float]:
        """Return vertices and faces of the union, and the volume that counted more than once, m3.

        Raises:
            MeshError: manifold3d is not installed, or it cannot use the shells.
        """
        try:
            import manifold3d
        except ImportError:
            raise MeshError(
                f"part {name}: closed surfaces in it overlap, and what they have in common would count twice; "
                "unite them in the modeller, or let this be done: pip install 'falsework[repair]'"
            ) from None
        kernel: Any = manifold3d
        solids = [
            kernel.Manifold(kernel.Mesh64(np.array(solid.vertices), np.array(solid.faces, dtype=np.uint64)))
            for solid in self.solids
        ]
        depth = self._within.sum(axis=1)
        filled = []
        for outer in np.flatnonzero(~self._hollow).tolist():
            hollows = np.flatnonzero(self._within[:, outer] & (depth == depth[outer] + 1)).tolist()
            filled.append(
                solids[outer] - kernel.Manifold.batch_boolean([solids[k] for k in hollows], kernel.OpType.Add)
            )
        union = kernel.Manifold.batch_boolean(filled, kernel.OpType.Add)
        if union.status() != kernel.Error.NoError:
            raise MeshError(f"part {name}: closed surfaces in it overlap; unite them in the modeller")
        mesh = union.to_mesh64()
        twice = sum(solid.volume() for solid in filled) - union.volume()
        return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64), twice

    @cached_property
    def _within(self) -> NDArray[np.bool_]:
        """Whether the first shell lies inside the second, shape (shells, shells)."""
        count = len(self.solids)
        found = np.zeros((count, count), dtype=bool)
        for inner, outer in ((a, b) for a in range(count) for b in range(count) if a != b and self._near(a, b)):
            small, large = self.solids[inner], self.solids[outer]
            if inside(small.vertices, large.triangles).all():
                # Of a shell that is bent, one can leave between its corners.
                shrunk = Body(shrink(small, self._shallow), small.faces)
                found[inner, outer] = not shrunk.hits(Body(large.vertices, large.faces))
        return found

    @property
    def _hollow(self) -> NDArray[np.bool_]:
        """Shells inside an odd number of others, shape (shells,)."""
        return self._within.sum(axis=1) % 2 == 1

    @cached_property
    def _shallow(self) -> float:
        bounds = np.array([solid.bounds for solid in self.solids])
        return _SHALLOW * float(np.linalg.norm(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)))

    def _near(self, a: int, b: int) -> bool:
        """Return whether the boxes around two shells overlap."""
        one, other = self.solids[a].bounds, self.solids[b].bounds
        return bool((np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]) > self._shallow).all())


def _surfaces(points: Array, corners: Faces) -> NDArray[np.int64]:
    """Return the shell of each face: a surface that is closed by itself, or faces connected by edges otherwise."""
    surface = surfaces_of(points, corners)
    if surface is not None and all(is_closed(corners[surface == shell]) for shell in range(int(surface.max()) + 1)):
        return surface
    one, two, _ = edge_mates(corners)
    return components(one // 3, two // 3, len(corners))
