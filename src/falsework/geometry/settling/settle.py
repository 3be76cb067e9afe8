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

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from falsework.errors import AssemblyError, ReadWarning
from falsework.geometry.contact.interfaces import default_gap
from falsework.geometry.contact.near import NearPoints, near_points
from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh
from falsework.geometry.settling.poses import Poses
from falsework.geometry.settling.program import AT_REST, gravity_motion
from falsework.geometry.settling.settlement import Settlement
from falsework.utils.quantity import format_quantity, listed

Array = NDArray[np.float64]

_STEPS = 60
"""Steps after which parts that still move are reported."""


def settle_parts(
    meshes: Sequence[TriangleMesh],
    fixed: NDArray[np.bool_],
    mass: MassProperties,
    friction: float,
    bound: float,
    most_steps: int = _STEPS,
) -> tuple[tuple[TriangleMesh, ...], Settlement]:
    """Move free parts by small amounts until their weight rests on contacts.

    Args:
        fixed: parts that stay, shape (parts,).
        friction: coefficient of friction of parts that touch.
        bound: largest motion of any point, metres.
        most_steps: steps after which parts that still move are an error.

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
    pose = Poses.from_meshes(meshes, fixed, mass)
    moved = tuple(meshes)
    steps, at_rest = 0, not len(pose.free)
    while not at_rest:
        near = near_points(moved, 2 * stride, tolerance)
        near = near.take(np.flatnonzero(~fixed[near.parts].all(axis=1)))
        strayed, still = 0.0, False
        at_rest = True
        # Surfaces are compared anew where parts have moved far, and at the end.
        while strayed <= stride / 2 and not still:
            if steps == most_steps:
                raise AssemblyError(
                    f"parts do not come to rest in {most_steps} steps of settling: {_named(pose.last, meshes)} still "
                    f"moved by {format_quantity(float(pose.last.max()), 'length')}; fix a part that should not move "
                    "(--boundary), or settle by less"
                )
            center = pose.center
            motion = gravity_motion(near, pose, mass.mass, friction, (bound, stride), tolerance)
            largest = pose.move(motion)
            near = _carried(near, center, motion)
            steps, strayed, still = steps + 1, strayed + largest, largest <= AT_REST * tolerance
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


def _carried(near: NearPoints, center: Array, motion: Array) -> NearPoints:
    """Return points between parts that have moved: their gaps change by what the parts move along the normals."""
    turn = Rotation.from_rotvec(motion[:, 3:]).as_matrix()
    a, b = (
        np.einsum("kij,kj->ki", turn[part], near.points - center[part]) + center[part] + motion[part, :3]
        for part in near.parts.T
    )
    gaps = near.gaps + np.einsum("ki,ki->k", b - a, near.normals)
    return NearPoints(near.parts, near.normals, (a + b) / 2, gaps)


def _named(motion: Array, meshes: Sequence[TriangleMesh]) -> str:
    """Return the names of the parts that moved farthest."""
    order = np.argsort(-motion, kind="stable")
    order = order[motion[order] > 0]
    names = [meshes[part].name for part in order.tolist()]
    return ("part " if len(order) == 1 else "parts ") + listed(names)
