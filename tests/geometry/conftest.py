"""Small solids that the tests of geometry are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from falsework.geometry import TriangleMesh

BOX_FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
     (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)  # fmt: skip


class Shapes:
    """Makers of closed meshes that look outwards."""

    @staticmethod
    def box(low: ArrayLike, high: ArrayLike, name: str = "box") -> TriangleMesh:
        low, high = np.asarray(low, float), np.asarray(high, float)
        corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
        return TriangleMesh.from_arrays(name, low + corners * (high - low), BOX_FACES)

    @staticmethod
    def extruded(outline: Sequence[tuple[float, float]], low: float, high: float, name: str = "prism") -> TriangleMesh:
        """Prism over a counter-clockwise outline that may be concave."""
        import shapely

        ring = np.asarray(outline, float)
        count = len(ring)
        lookup = {tuple(point): index for index, point in enumerate(ring)}
        caps = []
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(ring)))
        for corners in shapely.get_coordinates(pieces).reshape(-1, 4, 2).tolist():
            i, j, k = (lookup[tuple(corner)] for corner in corners[:3])
            (ax, ay), (bx, by), (cx, cy) = ring[[i, j, k]]
            caps.append((i, j, k) if (bx - ax) * (cy - ay) > (by - ay) * (cx - ax) else (i, k, j))
        top = [(i + count, j + count, k + count) for i, j, k in caps]
        bottom = [(i, k, j) for i, j, k in caps]
        sides = []
        for i in range(count):
            j = (i + 1) % count
            sides += [(i, j, j + count), (i, j + count, i + count)]
        vertices = np.concatenate([np.column_stack([ring, np.full(count, z)]) for z in (low, high)])
        return TriangleMesh.from_arrays(name, vertices, [*bottom, *top, *sides])

    @staticmethod
    def peg(facets: int, radius: float, height: float, phase: float = 0.0) -> TriangleMesh:
        turn = 2 * np.pi * (np.arange(facets) + phase) / facets
        outline = [(radius * np.cos(t), radius * np.sin(t)) for t in turn]
        return Shapes.extruded(outline, 0.0, height, "peg")

    @staticmethod
    def drilled(facets: int, radius: float, size: float, height: float) -> TriangleMesh:
        """Block with a through hole along z, of `facets` facets."""
        count = facets
        turn = 2 * np.pi * np.arange(count) / count
        unit = np.column_stack([np.cos(turn), np.sin(turn)])
        outer = unit / np.abs(unit).max(axis=1, keepdims=True) * size
        rings = [(radius * unit, 0.0), (radius * unit, height), (outer, 0.0), (outer, height)]
        vertices = np.concatenate([np.column_stack([ring, np.full(count, z)]) for ring, z in rings])
        faces = []
        for i in range(count):
            j = (i + 1) % count
            a, b, c, d = 0, count, 2 * count, 3 * count
            quads = [(a + j, a + i, b + i, b + j), (c + i, c + j, d + j, d + i)]
            quads += [(a + i, a + j, c + j, c + i), (b + i, d + i, d + j, b + j)]
            for p, q, r, s in quads:
                faces += [(p, q, r), (p, r, s)]
        return TriangleMesh.from_arrays("drilled", vertices, faces)

    @staticmethod
    def moved(
        mesh: TriangleMesh, shift: ArrayLike = (0, 0, 0), rotation: NDArray | None = None, name: str | None = None
    ) -> TriangleMesh:
        turned = mesh.vertices if rotation is None else mesh.vertices @ rotation.T
        return TriangleMesh.from_arrays(name or mesh.name, turned + np.asarray(shift, float), mesh.faces)

    @staticmethod
    def split(mesh: TriangleMesh, seed: int, rounds: int = 20) -> TriangleMesh:
        """The same surface in more triangles: random edges are cut at random places, in both faces of each."""
        random = np.random.default_rng(seed)
        vertices, faces = list(mesh.vertices), [tuple(face) for face in mesh.faces.tolist()]
        for _ in range(rounds):
            face = faces[random.integers(len(faces))]
            side = int(random.integers(3))
            p, q = face[side], face[(side + 1) % 3]
            share = random.uniform(0.3, 0.7)
            vertices.append(vertices[p] + share * (vertices[q] - vertices[p]))
            new, kept = len(vertices) - 1, []
            for a, b, c in faces:
                for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
                    if {i, j} == {p, q}:
                        kept += [(i, new, k), (new, j, k)]
                        break
                else:
                    kept.append((a, b, c))
            faces = kept
        return TriangleMesh.from_arrays(mesh.name, np.array(vertices), faces)

    @staticmethod
    def rotation(seed: int) -> NDArray[np.float64]:
        matrix, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
        return matrix * np.sign(np.linalg.det(matrix))


@pytest.fixture(scope="session")
def shapes() -> type[Shapes]:
    return Shapes
