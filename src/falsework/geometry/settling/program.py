"""Convex program of one step of settling: the small motion that gravity brings about between points that may touch."""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from falsework.errors import AssemblyError
from falsework.geometry.contact.near import NearPoints
from falsework.geometry.settling.poses import Poses

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AT_REST = 1 / 20
"""Largest motion of a part at rest in one step, as a share of the contact tolerance."""
_FAR = 10.0
"""Distance that a part would fall in one step if nothing stopped it, in strides."""
_ROUNDS = 60
"""Rounds in which a step adds the points that its motion violates."""

_clarabel: Any = clarabel  # its classes come from a compiled module without type information


def gravity_motion(
    near: NearPoints, pose: Poses, mass: Array, friction: float, bounds: tuple[float, float], tolerance: float
) -> Array:
    """Return the motion of all parts in one step: translations and rotation vectors, shape (parts, 6).

    The program begins with the bound alone and takes up the points that its motion violates, a few of each pair of
    parts in each round, so that its size follows from the parts and not from their faces.
    """
    chosen = np.zeros(len(near.gaps), dtype=bool)
    touching = near.gaps <= tolerance
    motion = np.zeros((len(mass), 6))
    # Equal octants of each pair of parts: points far from each other say more than neighbours.
    pair = np.unique(near.parts, axis=0, return_inverse=True)[1].ravel()
    middle = np.zeros((int(pair.max(initial=-1)) + 1, 3))
    for axis in range(3):
        middle[:, axis] = np.bincount(pair, near.points[:, axis]) / np.bincount(pair) if len(pair) else 0.0
    place = 8 * pair + ((near.points > middle[pair]) @ np.array([1, 2, 4]) if len(pair) else pair)
    for _ in range(_ROUNDS):
        motion = _solve(near.take(chosen), touching[chosen], pose, mass, friction, bounds)
        violation = _violations(near, touching, pose.center, motion, friction)
        violation[chosen] = -np.inf
        wrong = np.flatnonzero(violation > AT_REST / 10 * tolerance)
        if not len(wrong):
            break
        order = wrong[np.lexsort((-violation[wrong], place[wrong]))]
        chosen[order[np.append(True, np.diff(place[order]) > 0)]] = True
    return motion


def _violations(near: NearPoints, touching: NDArray[np.bool_], center: Array, motion: Array, friction: float) -> Array:
    """Return by how much a motion violates the condition of each point, shape (points,), metres."""
    a, b = near.parts.T
    apart = _velocity(motion[b], near.points - center[b]) - _velocity(motion[a], near.points - center[a])
    along = np.einsum("ki,ki->k", apart, near.normals)
    slip = np.linalg.norm(apart - along[:, None] * near.normals, axis=1)
    return np.where(touching, friction * slip, 0.0) - along - np.maximum(near.gaps, 0.0)


def _velocity(motion: Array, arm: Array) -> Array:
    """Return the motion of points of parts, shape (points, 3)."""
    return motion[:, :3] + np.cross(motion[:, 3:], arm)


def _solve(
    near: NearPoints,
    touching: NDArray[np.bool_],
    pose: Poses,
    mass: Array,
    friction: float,
    bounds: tuple[float, float],
) -> Array:
    """Solve the program for some points; the motion, shape (parts, 6).

    Lengths are in strides, rotations such that the farthest corner moves by about one.

    Args:
        near: points whose conditions count.
        touching: whether the parts touch at each point, so that friction acts, shape (points,).
        pose: of the parts.
        mass: shape (parts,), kg.
        friction: coefficient.
        bounds: largest motion of a corner from its place in the model, and in this step, metres.
    """
    bound, stride = bounds
    free, count = pose.free, len(pose.free)
    column = np.full(len(mass), -1)
    column[free] = np.arange(count)
    arms = pose.arms
    lever = np.linalg.norm(arms, axis=2).max(axis=1)
    share = mass[free] / mass[free].mean()
    metric = sp.diags(np.repeat(share, 6), format="csc")
    weight = np.zeros((count, 6))
    weight[:, 2] = _FAR * share

    # |strayed + motion of the corner| <= bound for each corner, and likewise from where the step begins.
    rows = _rows(free.repeat(8), arms[free].reshape(-1, 3), lever, column, 1.0)
    order = np.insert(1 + np.arange(24 * count).reshape(-1, 3), 0, 0, axis=1).ravel()
    corner = -sp.vstack([sp.csr_matrix((1, 6 * count)), rows], format="csr")[order]
    matrices, sides = [], []
    cones: list[Any] = []
    for limit, strayed in ((bound, pose.strayed[free]), (stride, np.zeros((count, 8, 3)))):
        if limit == bound or stride < bound:
            reach = np.full(8 * count, limit / stride)
            matrices.append(corner)
            sides.append(np.column_stack([reach, strayed.reshape(-1, 3) / stride]).ravel())
            cones += [_clarabel.SecondOrderConeT(4)] * (8 * count)
    if len(near.gaps):
        a, b = near.parts.T
        jacobian = _rows(b, near.points - pose.center[b], lever, column, 1.0) + _rows(
            a, near.points - pose.center[a], lever, column, -1.0
        )
        gaps = np.maximum(near.gaps, 0.0) / stride
        normal = sp.block_diag([row[None] for row in near.normals], format="csr") @ jacobian
        apart = ~touching if friction > 0 else np.ones(len(gaps), dtype=bool)
        matrices.append(-normal[apart])
        sides.append(gaps[apart])
        cones.append(_clarabel.NonnegativeConeT(int(apart.sum())))
        if not apart.all():
            stuck = np.flatnonzero(~apart)
            tangent = sp.block_diag([_tangents(row) for row in near.normals[stuck]], format="csr")
            slip = tangent @ jacobian[(3 * stuck[:, None] + np.arange(3)).ravel()]
            order = np.column_stack([np.arange(len(stuck)), len(stuck) + np.arange(2 * len(stuck)).reshape(-1, 2)])
            both = sp.vstack([normal[stuck] / friction, slip], format="csr")[order.ravel()]
            matrices.append(-both)
            sides.append(np.column_stack([gaps[stuck] / friction, np.zeros((len(stuck), 2))]).ravel())
            cones += [_clarabel.SecondOrderConeT(3)] * len(stuck)
    settings = _clarabel.DefaultSettings()
    settings.verbose = False
    solver = _clarabel.DefaultSolver(
        metric, weight.ravel(), sp.vstack(matrices, format="csc"), np.concatenate(sides), cones, settings
    )
    found = solver.solve()
    motion = np.zeros((len(mass), 6))
    values = np.array(found.x).reshape(count, 6)
    if not np.isfinite(values).all():
        raise AssemblyError(f"the settling of parts has no solution ({found.status}); settle by another length")
    motion[free] = values * stride
    motion[free, 3:] /= lever[free, None]
    return motion


def _rows(part: Index, arm: Array, lever: Array, column: Index, sign: float) -> sp.csr_matrix:
    """Return the matrix from the variables to the motion of points of parts, three rows a point; fixed ones stay."""
    count = int(column.max(initial=-1)) + 1
    turn = np.zeros((len(part), 3, 6))
    turn[:, :, :3] = np.eye(3)
    x, y, z = (arm / lever[part, None]).T
    zero = np.zeros(len(part))
    turn[:, :, 3:] = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    moves = column[part] >= 0
    row = np.repeat(np.arange(3 * len(part)).reshape(-1, 3, 1)[moves], 6, axis=2)
    at = np.broadcast_to((6 * column[part][moves])[:, None, None] + np.arange(6), row.shape)
    values = sign * turn[moves]
    return sp.csr_matrix((values.ravel(), (row.ravel(), at.ravel())), shape=(3 * len(part), 6 * count))


def _tangents(normal: Array) -> Array:
    """Return two tangents of a normal, shape (2, 3)."""
    least = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
