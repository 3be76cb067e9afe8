"""Settling of parts into their clearance: a small quasi-static motion under gravity until contacts carry them.

Parts of CAD models lie in the middle of their fits: a wheel is concentric with its axle and touches it nowhere. Settled
parts touch where they would in fact. Each step solves one convex program over small motions of all free parts (Anitescu
and Tasora, Computational Optimization and Applications 47, 2010, with time steps so long that only gravity counts):

    minimise   1/2 |u|_M^2 + far sum_i m_i u_iz   subject to   gap_c + n_c . du_c >= mu |t_c . du_c|

with friction at points that touch and none at points that are still apart. Parts whose weight friction and contacts can
balance do not move: then contact forces exist that make no motion the best one. So a structure without clearance keeps
its poses, and the stability criteria judge those that were reached.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from falsework.errors import AssemblyError, ReadWarning
from falsework.geometry.contact.interfaces import default_gap
from falsework.geometry.contact.near import NearPoints, near_points
from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh
from falsework.utils.quantity import format_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FAR = 10.0
"""Distance that a part would fall in one step if nothing stopped it, in strides."""
_STEPS = 60
"""Steps after which parts that still move are reported."""
_AT_REST = 1 / 20
"""Largest motion of a step that ends the settling, as a share of the contact tolerance."""
_ROUNDS = 60
"""Rounds in which a step adds the points that its motion violates."""
_FIT = 1 / 20
"""Largest clearance of a fit, as a share of the thickness of the thinnest part."""
_LISTED = 3
"""Parts that a message names; the rest is counted."""

_clarabel: Any = clarabel  # its classes come from a compiled module without type information


@dataclass(frozen=True, eq=False)
class Settlement:
    """Motion of parts from the poses of a model to those in which contacts carry them."""

    bound: float
    """Largest motion that was allowed to any point of a part, metres."""
    translation: Array
    """Of the centres of mass, shape (parts, 3), metres."""
    rotation: Array
    """Rotation vectors about the centres of mass, shape (parts, 3), radians."""
    motion: Array
    """Largest motion of a corner of the box around each part, shape (parts,), metres."""
    steps: int
    """Steps until all parts were at rest."""

    @property
    def stopped(self) -> NDArray[np.bool_]:
        """Whether contacts stopped each part before the bound did, shape (parts,)."""
        return self.motion < 0.99 * self.bound

    def line(self, names: Sequence[str]) -> str:
        """Return one line on the parts that moved, and the one that moved farthest."""
        moved, most = int((self.motion > 0).sum()), int(self.motion.argmax())
        if not moved:
            return "every part was at rest: none settled"
        count = "1 part" if moved == 1 else f"{moved} parts"
        within = format_quantity(self.bound, "length")
        far = format_quantity(float(self.motion[most]), "length")
        return f"{count} settled into the clearance, within {within}; {names[most]} moved farthest, by {far}"

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return plain JSON values in SI units, an entry for each part that moved."""
        moved = np.flatnonzero(self.motion > 0).tolist()
        return {
            "bound_m": self.bound,
            "steps": self.steps,
            "parts": [
                {
                    "part": part,
                    "name": names[part],
                    "translation_m": self.translation[part].tolist(),
                    "rotation_rad": self.rotation[part].tolist(),
                    "motion_m": float(self.motion[part]),
                    "stopped": bool(self.stopped[part]),
                }
                for part in moved
            ],
        }


def settle_parts(
    meshes: Sequence[TriangleMesh],
    fixed: NDArray[np.bool_],
    mass: MassProperties,
    friction: float,
    bound: float,
) -> tuple[tuple[TriangleMesh, ...], Settlement]:
    """Move free parts by small amounts until their weight rests on contacts.

    Args:
        meshes: the parts.
        fixed: parts that stay, shape (parts,).
        mass: of the parts.
        friction: coefficient of friction of parts that touch.
        bound: largest motion of any point, metres.

    Returns:
        The parts in their settled poses, and their motion. A part that reaches the bound is warned of.

    Raises:
        AssemblyError: a bound that is not positive, or too large for the width of a part; or parts that do not come
            to rest.
    """
    check_bound(meshes, fixed, bound)
    tolerance = default_gap(meshes)
    # Within one step no part may pass through the thinnest, whose far side looks away.
    stride = min(bound, min(mesh.thickness for mesh in meshes) / 4)
    pose = _Poses.of(meshes, fixed, mass)
    moved = tuple(meshes)
    steps, at_rest = 0, not len(pose.free)
    while not at_rest:
        near = near_points(moved, 2 * stride, tolerance)
        near = near.take(~fixed[near.parts].all(axis=1))
        strayed, still = 0.0, False
        at_rest = True
        # Surfaces are compared anew where parts have moved far, and at the end.
        while strayed <= stride / 2 and not still:
            if steps == _STEPS:
                raise AssemblyError(
                    f"parts do not come to rest in {_STEPS} steps of settling: {_named(pose.last, meshes)} still "
                    f"moved by {format_quantity(largest, 'length')}; fix a part that should not move (--boundary), or "
                    "settle by less"
                )
            center = pose.center
            motion = _step(near, pose, mass.mass, friction, (bound, stride), tolerance)
            largest = pose.move(motion)
            near = _carried(near, center, motion)
            steps, strayed, still = steps + 1, strayed + largest, largest <= _AT_REST * tolerance
            at_rest &= still
        moved = pose.meshes(meshes)
    settled = pose.settlement(bound, steps, 0.1 * tolerance)
    if not settled.stopped.all():
        warnings.warn(
            f"nothing stopped {_named(np.where(settled.stopped, 0.0, settled.motion), meshes)} within "
            f"{format_quantity(bound, 'length')} of settling; such parts fall, or have more clearance",
            ReadWarning,
            stacklevel=3,
        )
    return tuple(
        new if settled.motion[part] > 0 else old for part, (new, old) in enumerate(zip(moved, meshes, strict=True))
    ), settled


def check_bound(meshes: Sequence[TriangleMesh], fixed: NDArray[np.bool_], bound: float) -> None:
    """Raise for a bound on the motion of parts that is no small length.

    Raises:
        AssemblyError: it is not positive, or more than half of the width of a part that may move.
    """
    if not (np.isfinite(bound) and bound > 0):
        raise AssemblyError(f"parts cannot settle by {1000 * bound:g} mm; give a length above zero")
    for part in np.flatnonzero(~fixed).tolist():
        least = float(np.ptp(meshes[part].bounds, axis=0).min())
        if bound > least / 2:
            raise AssemblyError(
                f"parts cannot settle by {format_quantity(bound, 'length')}: part {meshes[part].name} is only "
                f"{format_quantity(least, 'length')} wide; give the clearance of the fits, at most half of that"
            )


def clearance_hint(assembly: Assembly) -> str:
    """Return what to do about parts of an assembly that face others across a clearance; empty if none does.

    Such parts touch on one side only, or not where they would in fact, so that the poses of the model are none in which
    they rest.
    """
    if assembly.settlement is not None or assembly.contacts_given:
        return ""
    thickness = min(mesh.thickness for mesh in assembly.meshes)
    tolerance = max(*assembly.contact_settings.lengths(assembly.meshes), default_gap(assembly.meshes))
    near = near_points(assembly.meshes, _FIT * thickness, tolerance)
    near = near.take((near.gaps > tolerance) & ~assembly.boundary[near.parts].all(axis=1))
    if not len(near.gaps):
        return ""
    widest = int(near.gaps.argmax())
    a, b = (assembly.names[part] for part in near.parts[widest].tolist())
    gap = 1000 * float(near.gaps[widest])
    most = 1000 * min(mesh.thickness for mesh, fixed in zip(assembly.meshes, assembly.boundary, strict=True) if not fixed)
    return (
        f"parts {a} and {b} face each other {gap:.2g} mm apart, and parts can settle into such clearance before they "
        f"are judged: --settle {min(2 * gap, most / 2):.2g}"
    )


def _named(motion: Array, meshes: Sequence[TriangleMesh]) -> str:
    """Return the names of the parts that moved farthest."""
    order = np.argsort(-motion, kind="stable")
    order = order[motion[order] > 0]
    names = [meshes[part].name for part in order[:_LISTED].tolist()]
    more = len(order) - len(names)
    return ("part " if len(order) == 1 else "parts ") + ", ".join(names) + (f" and {more} more" if more else "")


class _Poses:
    """Poses of the parts that move, and the corners of their boxes, which bound the motion of all points."""

    def __init__(self, free: Index, center: Array, corners: Array) -> None:
        self.free, self.start, self._corners = free, center, corners
        self.center = center.copy()
        self.turn = Rotation.identity(len(center))
        self.last = np.zeros(len(center))

    @staticmethod
    def of(meshes: Sequence[TriangleMesh], fixed: NDArray[np.bool_], mass: MassProperties) -> _Poses:
        """Take the poses of a model."""
        ends = np.array([[[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]], dtype=bool)
        bounds = np.array([mesh.bounds for mesh in meshes])
        return _Poses(np.flatnonzero(~fixed), mass.center, np.where(ends, bounds[:, 1:], bounds[:, :1]))

    @property
    def arms(self) -> Array:
        """Corners of the boxes from the centres of mass, shape (parts, 8, 3), metres."""
        arms = self._corners - self.start[:, None]
        return np.einsum("pij,pkj->pki", self.turn.as_matrix(), arms)

    @property
    def strayed(self) -> Array:
        """Motion of the corners so far, shape (parts, 8, 3), metres."""
        return self.center[:, None] + self.arms - self._corners

    def move(self, motion: Array) -> float:
        """Apply translations and rotation vectors, shape (parts, 6), and return the largest motion of a corner."""
        before = self.center[:, None] + self.arms
        self.center = self.center + motion[:, :3]
        self.turn = Rotation.from_rotvec(motion[:, 3:]) * self.turn
        self.last = np.linalg.norm(self.center[:, None] + self.arms - before, axis=2).max(axis=1)
        return float(self.last.max(initial=0.0))

    def meshes(self, meshes: Sequence[TriangleMesh]) -> tuple[TriangleMesh, ...]:
        """Return the parts in their present poses."""
        moved, turn = list(meshes), self.turn.as_matrix()
        for part in self.free.tolist():
            points = (meshes[part].vertices - self.start[part]) @ turn[part].T + self.center[part]
            moved[part] = TriangleMesh.from_arrays(meshes[part].name, points, meshes[part].faces)
        return tuple(moved)

    def settlement(self, bound: float, steps: int, least: float) -> Settlement:
        """Return the motion from the start; of parts that moved by less than `least`, none."""
        motion = np.linalg.norm(self.strayed, axis=2).max(axis=1)
        motion[motion < least] = 0.0
        still = motion[:, None] > 0
        translation, rotation = self.center - self.start, self.turn.as_rotvec()
        return Settlement(bound, np.where(still, translation, 0.0), np.where(still, rotation, 0.0), motion, steps)


def _step(
    near: NearPoints, pose: _Poses, mass: Array, friction: float, bounds: tuple[float, float], tolerance: float
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
        wrong = np.flatnonzero(violation > _AT_REST / 10 * tolerance)
        if not len(wrong):
            break
        order = wrong[np.lexsort((-violation[wrong], place[wrong]))]
        chosen[order[np.append(True, np.diff(place[order]) > 0)]] = True
    return motion


def _carried(near: NearPoints, center: Array, motion: Array) -> NearPoints:
    """Return points between parts that have moved: their gaps change by what the parts move along the normals."""
    turn = Rotation.from_rotvec(motion[:, 3:]).as_matrix()
    a, b = (
        np.einsum("kij,kj->ki", turn[part], near.points - center[part]) + center[part] + motion[part, :3]
        for part in near.parts.T
    )
    gaps = near.gaps + np.einsum("ki,ki->k", b - a, near.normals)
    return NearPoints(near.parts, near.normals, (a + b) / 2, gaps)


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
    pose: _Poses,
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
