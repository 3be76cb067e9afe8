"""Random pairs of bodies whose surfaces do not fit, and linear programs with the normals of either.

One is a tessellation of its own of the other, tilted and twisted against it.

The unsimplified contact is known: the pieces of facets of the body that lie on pieces of facets of the bed, midway
between the two. Nothing here uses the contacts, masses or solvers of falsework.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from curved_pairs import Array, least_residual, solid, tessellation
from numpy.typing import NDArray

from falsework import Assembly
from falsework.geometry import ContactSettings, TriangleMesh

_STEEPEST = 0.25
"""Least cosine between the normal of a facet and the direction in which both surfaces are projected."""
_TILT, _TWIST = 0.06, 0.03
"""Largest slope by which a surface is tilted against the other, and at its rim by which it is twisted."""


@dataclass(frozen=True)
class InclinedPair:
    """A body on a bed whose facets are others than its own."""

    surface: str
    vertices: tuple[Array, Array]
    """Of body and bed, metres."""
    faces: tuple[NDArray[np.int64], NDArray[np.int64]]
    """Of body and bed, facing outwards."""
    points: Array
    """Corners of the pieces of facets that lie on each other, shape (points, 3), metres."""
    normals: tuple[Array, Array]
    """Into the body, those of its own facets and those of the bed, shape (points, 3)."""
    pieces: int
    """Number of these pieces."""
    away: float
    """Largest distance between the two surfaces, metres."""

    def assembly(self, friction: float, *, fitted: bool = False) -> Assembly:
        """Return body and bed, which is fixed.

        Args:
            friction: coefficient.
            fitted: whether gaps and overlaps beyond the default tolerance are left to a fitted joint, or allowed.
        """
        meshes = [
            TriangleMesh.from_arrays(name, points, faces)
            for name, points, faces in zip(("body", "bed"), self.vertices, self.faces, strict=True)
        ]
        settings = None if fitted else ContactSettings(gap=1.1 * self.away, overlap=1.1 * self.away)
        return Assembly.from_meshes(meshes, boundary=[1], friction=friction, contact_settings=settings)

    @property
    def angle(self) -> Array:
        """Angle between the facets at each point, shape (points,), degrees."""
        apart = np.linalg.norm(self.normals[0] - self.normals[1], axis=1)
        return np.degrees(2 * np.arcsin(np.minimum(apart / 2, 1.0)))

    def residual(self, friction: float) -> float:
        """Return the least residual of the body with the normals of one surface, where it is larger than the other's.

        As `CurvedPair.residual` for either: only a state that stands with both stands whichever is the true one.
        """
        body = self.vertices[0][self.faces[0]]
        return max(least_residual(body, self.points, normals, friction) for normals in self.normals)


def random_inclined_pair(rng: np.random.Generator, surface: str, largest: float = 6.0) -> InclinedPair:
    """Make a pair on a random piece of a surface, each cut into facets of its own, one of them tilted and twisted.

    Args:
        rng: randomness.
        surface: one of `SURFACES`.
        largest: angle between facets that lie on each other, degrees.
    """
    while True:
        piece = int(rng.integers(2**32))
        (body, of_body), (bed, of_bed) = (tessellation(rng, surface, piece) for _ in range(2))
        way = rng.normal(size=2)
        body = _warped(body, rng.uniform(0.0, _TILT) * way / np.linalg.norm(way), rng.uniform(-_TWIST, _TWIST))
        (of_body, mine), (of_bed, its) = _upwards(body, of_body), _upwards(bed, of_bed)
        up = its.sum(axis=0) / np.linalg.norm(its.sum(axis=0)) + rng.normal(0.0, 0.15, 3)
        if min((normals @ up).min() for normals in (_unit(mine), _unit(its))) < _STEEPEST:
            continue
        rise = up * float(np.linalg.norm(np.ptp(bed, axis=0))) * rng.uniform(0.1, 0.6)
        pair = inclined_pair_on(surface, (body, of_body), (bed, of_bed), rise)
        if pair.angle.max() < largest:
            return pair


def inclined_pair_on(
    surface: str, body: tuple[Array, NDArray[np.int64]], bed: tuple[Array, NDArray[np.int64]], rise: Array
) -> InclinedPair:
    """Make the body between its surface and a copy moved by `rise`, and the bed below its own.

    Args:
        surface: name.
        body: points, metres, and facets, which look upwards, of the lower side of the body.
        bed: the same of the upper side of the bed.
        rise: shape (3,), metres; against no facet.
    """
    (mine, my_facets), (its, its_facets) = body, bed
    vertices = np.vstack([mine + rise, mine]), np.vstack([its, its - rise])
    faces = solid(my_facets, len(mine)), solid(its_facets, len(its))
    return InclinedPair(surface, vertices, faces, *_common(mine[my_facets], its[its_facets], rise))


def _common(body: Array, bed: Array, rise: Array) -> tuple[Array, tuple[Array, Array], int, float]:
    """Return corners of pieces of facets on each other, both normals there, their number and the largest distance."""
    up = rise / np.linalg.norm(rise)
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(up, first)])
    flat = [shapely.polygons(facets @ frame.T) for facets in (body, bed)]
    j, i = shapely.STRtree(flat[0]).query(flat[1], predicate="intersects")
    pieces = shapely.intersection(flat[0][i], flat[1][j])
    solid_ones = shapely.area(pieces) > 1e-9 * shapely.area(flat[0]).sum() / len(body)
    i, j = i[solid_ones], j[solid_ones]
    places, piece = shapely.get_coordinates(pieces[solid_ones], return_index=True)
    both = [_unit(_cross(facets))[rows[piece]] for facets, rows in ((body, i), (bed, j))]
    levels = []
    for facets, normals, rows in ((body, both[0], i), (bed, both[1], j)):
        arms = facets[rows[piece], 0] - places @ frame
        levels.append(np.einsum("pi,pi->p", normals, arms) / (normals @ up))
    middle = places @ frame + np.outer((levels[0] + levels[1]) / 2, up)
    return middle, (both[0], both[1]), len(i), float(np.abs(levels[0] - levels[1]).max())


def _warped(points: Array, tilt: Array, twist: float) -> Array:
    """Return points raised by a slope, and by one that changes across the surface."""
    middle, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0) / 2
    x, y, _ = (points - middle).T
    rise = tilt[0] * x + tilt[1] * y + twist * x * y / max(half[:2].max(), 1e-300)
    return points + rise[:, None] * np.array([0.0, 0.0, 1.0])


def _upwards(points: Array, facets: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Return facets that look upwards as a whole, and their normals times twice their areas."""
    cross = _cross(points[facets])
    return (facets[:, ::-1], -cross) if cross.sum(axis=0)[2] < 0 else (facets, cross)


def _cross(facets: Array) -> Array:
    return np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0])


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
