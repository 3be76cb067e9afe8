"""Convex pieces of links, grippers, obstacles and parts for collision queries.

A piece is the convex hull of its vertices, an array of shape (vertices, 3) in metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from falsework.errors import InputError
from falsework.geometry.arrays import apply

Array = NDArray[np.float64]
Pieces = tuple[Array, ...]
"""Convex pieces that together cover one body."""

CYLINDER_SIDES = 12
"""Number of sides of the prism that replaces a cylinder."""
MAX_PLANES = 48
"""Largest number of planes of a simplified hull."""


def block(low: ArrayLike, high: ArrayLike, **bevels: tuple[float, float, float, float]) -> Array:
    """Return a box whose edges may be bevelled by 45 degrees.

    Args:
        low, high: opposite corners, metres.
        bevels: `x`, `y` or `z`: sizes of the bevels of the four edges along that axis, metres. With `u`, `v` the
            other two axes in the order of the alphabet: at low u and low v, high u and low v, high u and high v, low u
            and high v.

    Returns:
        Its vertices, shape (8 or more, 3).
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    planes = [np.append(-np.eye(3)[k], low[k]) for k in range(3)] + [
        np.append(np.eye(3)[k], -high[k]) for k in range(3)
    ]
    for along, sizes in bevels.items():
        u, v = (k for k in range(3) if k != "xyz".index(along))
        for (right, up), size in zip(((-1, -1), (1, -1), (1, 1), (-1, 1)), sizes, strict=True):
            if size > 0:
                plane = np.zeros(4)
                plane[u], plane[v] = right, up
                corner = right * (high if right > 0 else low)[u] + up * (high if up > 0 else low)[v]
                plane[3] = size - corner
                planes.append(plane)
    try:
        inner = HalfspaceIntersection(np.array(planes), (low + high) / 2).intersections
    except QhullError:
        raise InputError(
            f"a box from {low.tolist()} to {high.tolist()} is too thin for a collision shape; make it thicker"
        ) from None
    return hull(np.unique(np.round(inner, 9), axis=0))


def cylinder(radius: float, low: float, high: float) -> Array:
    """Return a prism around a cylinder about the z axis from `low` to `high`, metres. Shape (2 * CYLINDER_SIDES, 3).

    The cylinder lies inside: the prism exceeds it by at most 3.5 % of the radius with twelve sides.
    """
    angle = 2 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES
    outer = radius / np.cos(np.pi / CYLINDER_SIDES)
    ring = np.stack([outer * np.cos(angle), outer * np.sin(angle)], axis=1)
    points = np.concatenate([np.c_[ring, np.full(CYLINDER_SIDES, low)], np.c_[ring, np.full(CYLINDER_SIDES, high)]])
    return _frozen(points)


def hull(points: ArrayLike) -> Array:
    """Return the vertices of the convex hull, shape (vertices, 3); InputError if the points span no volume."""
    given = np.asarray(points, dtype=np.float64)
    try:
        return _frozen(given[np.sort(ConvexHull(given).vertices)])
    except (QhullError, ValueError):
        raise InputError(
            f"{len(given)} points span no volume, so they make no collision shape; give a closed mesh"
        ) from None


def move_pieces(pose: Array, pieces: Pieces) -> Pieces:
    """Return pieces transformed by a pose, shape (4, 4)."""
    return tuple(_frozen(apply(pose, piece)) for piece in pieces)


def pose(position: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0) -> Array:
    """Return an upright pose, rotated about z by `yaw` radians. Shape (4, 4)."""
    made = np.eye(4)
    made[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    made[:3, 3] = position
    return _frozen(made)


def looking_down(base: Array, position: ArrayLike, turn: float = 0.0) -> Array:
    """Return a frame in the world whose z points down, as tools do where parts are put down. Shape (4, 4).

    Args:
        base: pose of the frame that the position is in; it may be tilted, as that of an arm on a wall or a ceiling.
        position: shape (3,).
        turn: rotation about the vertical, rad, from x of the base where that is upright.
    """
    made = np.array(pose(position, turn))
    made[:3, 1:3] *= -1
    made = base @ made
    made[:3, :3] = least_turn(base[:3, 2], np.array([0.0, 0.0, 1.0]), base[:3, 0]) @ made[:3, :3]
    return made


def least_turn(before: Array, after: Array, across: Array) -> Array:
    """Return the least rotation of a unit vector into another one, for opposite ones about an axis, shape (3, 3)."""
    cosine = float(before @ after)
    if cosine < -1 + 1e-9:
        return 2 * np.outer(across, across) - np.eye(3)
    x, y, z = np.cross(before, after)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def inverse_pose(given: Array) -> Array:
    """Return the inverse of a rigid pose, shape (..., 4, 4)."""
    made = np.zeros_like(given)
    turn = np.swapaxes(given[..., :3, :3], -1, -2)
    made[..., :3, :3] = turn
    made[..., :3, 3] = -np.einsum("...ij,...j->...i", turn, given[..., :3, 3])
    made[..., 3, 3] = 1.0
    return made


def square_to(axis: Array) -> Array:
    """Return two unit vectors that make a right-handed frame with a unit vector after them, shape (2, 3)."""
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(axis)))], axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def wxyz_of(rotation: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion, w first, of a rotation matrix of shape (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(w), float(x), float(y), float(z)


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return principal moments, shape (3,), and the rotation whose columns are their axes, shape (3, 3)."""
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, axes


def _frozen(array: Array) -> Array:
    array = np.ascontiguousarray(array)
    array.setflags(write=False)
    return array


def outer_hull(points: ArrayLike, tolerance: float = 0.004, planes: int = MAX_PLANES) -> Array:
    """Return vertices of a polytope with few planes around the convex hull of points, shape (vertices, 3), metres.

    Starts from the bounding box and repeatedly adds the plane of the hull that the farthest corner violates most, until
    corners are within a tolerance; with all planes used, corners may be farther out.
    """
    corners = hull(points)
    if len(corners) <= 16:
        return corners
    facets = ConvexHull(corners)
    inner = corners.mean(axis=0)
    low, high = corners.min(axis=0), corners.max(axis=0)
    normals = [*np.eye(3), *-np.eye(3)]
    offsets = [*-high, *low]
    outer = corners
    while len(normals) < planes:
        outer = HalfspaceIntersection(np.c_[np.array(normals), offsets], inner).intersections
        beyond = outer @ facets.equations[:, :3].T + facets.equations[:, 3]
        corner, facet = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[corner, facet] <= tolerance:
            break
        normals.append(facets.equations[facet, :3])
        offsets.append(-float((corners @ facets.equations[facet, :3]).max()))
    outer = HalfspaceIntersection(np.c_[np.array(normals), offsets], inner).intersections
    outer = hull(np.unique(np.round(outer, 7), axis=0))
    return outer if len(outer) < len(corners) else corners
