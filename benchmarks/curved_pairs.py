"""Random pairs of bodies with a curved interface, and the exact answer for them by linear programs.

Body and bed share the facets of a surface, so that the unsimplified contact is known: all corners of all facets, each
with the normal of its facet. Nothing here uses the contacts, masses or solvers of falsework.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from falsework import Assembly
from falsework.geometry import TriangleMesh

Array = NDArray[np.float64]
linprog: Any = vars(scipy.optimize)["linprog"]  # without types, which take a type checker long to infer

_CELLS = {
    "circle": ((10, 1), (60, 3)),
    "sphere": ((3, 3), (12, 12)),
    "cone": ((1, 10), (3, 60)),
    "quadric": ((3, 3), (12, 12)),
}
"""Least and largest numbers of cells, of two facets each, along the two sides of a piece of each surface."""
SURFACES = tuple(_CELLS)
_CUTS = 60
"""Friction cones that are cut at once."""
_FEASIBLE = 1e-7
"""Violation of the conditions on a virtual velocity that counts as none."""


class Pair(Protocol):
    """A body on a bed."""

    def residual(self, friction: float) -> float:
        """Return the least residual acceleration of the body, a share of gravity."""
        ...


@dataclass(frozen=True)
class CurvedPair:
    """A body on a bed; the residual of its equilibrium is exact but for rounding."""

    surface: str
    vertices: tuple[Array, Array]
    """Of body and bed, metres."""
    faces: NDArray[np.int64]
    """Of either, facing outwards."""
    corners: Array
    """Corners of the facets, shape (facets, 3, 3), metres."""

    def assembly(self, friction: float) -> Assembly:
        """Return body and bed, which is fixed."""
        meshes = [
            TriangleMesh.from_arrays(name, points, self.faces)
            for name, points in zip(("body", "bed"), self.vertices, strict=True)
        ]
        return Assembly.from_meshes(meshes, boundary=[1], friction=friction)

    def residual(self, friction: float) -> float:
        """Return the least residual acceleration of the body over all forces within the cones of friction.

        It is the largest of the components of the linear acceleration, and of the angular one times the radius of
        gyration, as a share of gravity. By duality it is the largest power of gravity over virtual velocities that no
        admissible force opposes; cones, which are circular, are cut where such a velocity violates them.
        """
        cross = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        normals = np.repeat(cross / np.linalg.norm(cross, axis=1, keepdims=True), 3, axis=0)
        return least_residual(self.vertices[0][self.faces], self.corners.reshape(-1, 3), normals, friction)


def least_residual(body: Array, points: Array, normals: Array, friction: float) -> float:
    """Return the residual of `CurvedPair.residual` of a body on contact points.

    Args:
        body: its faces, shape (faces, 3, 3), metres.
        points: shape (points, 3), metres.
        normals: into the body, shape (points, 3).
        friction: coefficient.
    """
    columns = _columns(body, points, normals)
    gravity = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    cuts = columns[:0, :, 0]
    while True:
        both = np.concatenate([cuts, -cuts], axis=1)
        found = linprog(
            -np.concatenate([gravity, -gravity]),
            A_ub=np.vstack([-both, np.ones(12)]),
            b_ub=np.append(np.zeros(len(both)), 1.0),
            method="highs-ds",
            options={
                "primal_feasibility_tolerance": _FEASIBLE / 100,
                "dual_feasibility_tolerance": _FEASIBLE / 100,
            },
        )
        velocity = found.x[:6] - found.x[6:]
        normal, *tangent = np.moveaxis(columns, 2, 0) @ velocity
        along = np.stack(tangent, axis=1)
        speed = np.linalg.norm(along, axis=1)
        violation = friction * speed - normal
        worst = np.argsort(-violation)[:_CUTS]
        worst = worst[violation[worst] > _FEASIBLE]
        if not len(worst) or -found.fun < _FEASIBLE:
            return float(-found.fun)
        ways = along[worst] / np.maximum(speed[worst], 1e-300)[:, None]
        pushes = columns[worst, :, 0] - friction * np.einsum("pik,pk->pi", columns[worst][:, :, 1:], ways)
        cuts = np.vstack([cuts, pushes])


def _columns(body: Array, points: Array, normals: Array) -> Array:
    """Return the acceleration of the body by unit forces along normal and two tangents, shape (points, 6, 3)."""
    center, gyration, inverse = _inertia(body)
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([normals, first, np.cross(normals, first)], axis=1)
    turning = gyration * np.cross(points[:, None] - center, axes) @ inverse
    return np.concatenate([axes, turning], axis=2).transpose(0, 2, 1)


def _inertia(body: Array) -> tuple[Array, float, Array]:
    """Return centre of mass, largest radius of gyration, and inverse inertia of a body, of mass 1."""
    middle = body.reshape(-1, 3).mean(axis=0)
    tetrahedra = body - middle
    volume = np.linalg.det(tetrahedra) / 6
    total = tetrahedra.sum(axis=1)
    center = (volume[:, None] * total).sum(axis=0) / 4 / volume.sum()
    second = np.einsum("t,tki,tkj->ij", volume / 20, tetrahedra, tetrahedra)
    second += np.einsum("t,ti,tj->ij", volume / 20, total, total)
    second = second / volume.sum() - np.outer(center, center)
    inertia = np.trace(second) * np.eye(3) - second
    return middle + center, float(np.sqrt(np.linalg.eigvalsh(inertia)[-1])), np.linalg.inv(inertia)


def random_pair(rng: np.random.Generator, surface: str) -> CurvedPair:
    """Make a pair on a random piece of a surface, inclined at random, of 18 to 360 facets.

    Args:
        rng: randomness.
        surface: one of `SURFACES`.
    """
    while True:
        points, facets = tessellation(rng, surface, int(rng.integers(2**32)))
        cross = np.cross(points[facets[:, 1]] - points[facets[:, 0]], points[facets[:, 2]] - points[facets[:, 0]])
        if cross.sum(axis=0)[2] < 0:
            facets, cross = facets[:, ::-1], -cross
        normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        up = cross.sum(axis=0) / np.linalg.norm(cross.sum(axis=0)) + rng.normal(0.0, 0.15, 3)
        if (normals @ up).min() > 0.25:
            return pair_on(surface, points, facets, up * size * rng.uniform(0.1, 0.6))


def tessellation(rng: np.random.Generator, surface: str, piece: int) -> tuple[Array, NDArray[np.int64]]:
    """Cut a random piece of a surface into facets; return their points and corners.

    Args:
        rng: randomness of the cut.
        surface: one of `SURFACES`.
        piece: seed of the piece, its place and its size.
    """
    least, most = _CELLS[surface]
    count = rng.integers(least, np.add(most, 1))
    sides = [np.cumsum(np.append(0.0, rng.uniform(0.6, 1.4, n))) for n in count]
    u, v = (side / side[-1] for side in sides)
    place = np.random.default_rng(piece)
    points = _surface(place, surface, *np.meshgrid(u, v, indexing="ij")).reshape(-1, 3)
    points = points @ _rotation(place, 0.5).T * 10 ** place.uniform(-1.5, 1.5)
    return points, _facets(rng, *(int(n) for n in count))


def pair_on(surface: str, points: Array, facets: NDArray[np.int64], rise: Array) -> CurvedPair:
    """Make the body between a surface and its copy, moved by `rise`, and the bed below it.

    Args:
        surface: name.
        points: shape (points, 3), metres.
        facets: triangles that look upwards, shape (facets, 3).
        rise: shape (3,), metres; against no facet.
    """
    body, bed = np.vstack([points + rise, points]), np.vstack([points, points - rise])
    return CurvedPair(surface, (body, bed), solid(facets, len(points)), points[facets])


def critical_friction(pair: Pair, tolerance: float, most: float = 1.5, steps: int = 14) -> float:
    """Return the least friction at which the residual is within the tolerance; infinite if it is more than `most`."""
    low, high = 0.0, most
    if pair.residual(most) > tolerance:
        return float("inf")
    if pair.residual(0.0) <= tolerance:
        return 0.0
    for _ in range(steps):
        middle = (low + high) / 2
        low, high = (low, middle) if pair.residual(middle) <= tolerance else (middle, high)
    return high


def _surface(rng: np.random.Generator, name: str, u: Array, v: Array) -> Array:
    """Return points of a surface at parameters from 0 to 1."""
    turn = rng.choice([1.0, 1.0, -1.0])  # a bed that is hollow, or one that bulges
    if name == "cone":
        radius, angle = 0.3 + rng.uniform(0.4, 1.0) * u, rng.uniform(0.5, 2.5) * (v - 0.5)
        return np.stack(
            [radius * np.sin(angle), turn * radius * np.cos(angle), rng.uniform(0.3, 1.5) * radius], axis=-1
        )
    across, along = rng.uniform(0.2, 1.6) * (u - rng.uniform(0.2, 0.8)), rng.uniform(0.2, 1.6) * (v - 0.5)
    if name == "circle":
        return np.stack([np.sin(across), along, -turn * np.cos(across)], axis=-1)
    if name == "sphere":
        x, y = np.sin(across), np.cos(across) * np.sin(along)
        return np.stack([x, y, -turn * np.cos(across) * np.cos(along)], axis=-1)
    a, b, c = rng.normal(0.0, 0.5, 3)
    return np.stack([across, along, a * across**2 + b * along**2 + c * across * along], axis=-1)


def _facets(rng: np.random.Generator, rows: int, columns: int) -> NDArray[np.int64]:
    """Return triangles of a grid of cells, each cut along one of its diagonals at random."""
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = (index[i : i + rows, j : j + columns].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    one = np.stack([a, b, c, a, c, d], axis=1)
    other = np.stack([a, b, d, b, c, d], axis=1)
    return np.where(rng.random(len(a))[:, None] < 0.5, one, other).reshape(-1, 3)


def solid(facets: NDArray[np.int64], points: int) -> NDArray[np.int64]:
    """Return the faces of the solid between a surface, of its first points, and a copy of it below, its last ones."""
    edges = facets[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    inner = {(b, a) for a, b in edges.tolist()}
    high = np.array([edge for edge in edges.tolist() if tuple(edge) not in inner])
    low = high + points
    sides = np.stack([low[:, 0], low[:, 1], high[:, 1], low[:, 0], high[:, 1], high[:, 0]], axis=1).reshape(-1, 3)
    return np.vstack([facets, facets[:, ::-1] + points, sides])


def _rotation(rng: np.random.Generator, most: float) -> Array:
    """Return a rotation by up to `most` radians about a horizontal axis, after any about the vertical."""
    way, spin, tilt = rng.uniform(0, 2 * np.pi, 2).tolist() + [rng.uniform(0, most)]
    axis = np.array([np.cos(way), np.sin(way), 0.0])
    cross = np.cross(np.eye(3), axis)
    tilted = np.eye(3) - np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
    turned = np.array([[np.cos(spin), -np.sin(spin), 0], [np.sin(spin), np.cos(spin), 0], [0, 0, 1]])
    return tilted @ turned
