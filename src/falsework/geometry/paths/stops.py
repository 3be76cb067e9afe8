"""Directions in which a part may move past others, and stops on the way at which another direction may open.

A part that slides leaves one contact and meets another where faces, edges or corners of it are level with those of
others. So it is enough, for parts whose faces are parallel to three planes, to move along their normals and to stop
where faces are level: what it can reach past such parts is bounded by planes through such positions, and has a way
along their edges between any two of them (Lozano-Perez, Spatial Planning: A Configuration Space Approach, 1983).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.locked import unsigned
from falsework.geometry.mesh.mesh import triangle_normals

Array = NDArray[np.float64]

_SAME = 1e-4
"""Directions that differ by no more are one, as a sine."""
_NORMALS = 8
"""Normals, largest faces first, whose pairs give directions to slide along both."""
_LEVELS = 32
"""Levels of a part, and of the others, that are compared."""


def face_normals(triangles: Sequence[Array]) -> tuple[Array, bool]:
    """Return normals of faces up to their sign, those of most area first, and whether these are all.

    Args:
        triangles: corners of the faces of several parts, shape (faces, 3, 3) each, metres.

    Returns:
        Unit vectors, shape (normals, 3), at most `_NORMALS`.
    """
    normals = np.concatenate([triangle_normals(some) for some in triangles])
    size = np.linalg.norm(normals, axis=1)
    normals, size = normals[size > 0] / size[size > 0, None], size[size > 0]
    normals = unsigned(normals)
    lines, owner = np.unique(np.round(normals / _SAME).astype(np.int64), axis=0, return_inverse=True)
    area = np.bincount(owner.ravel(), size, len(lines))
    found: list[Array] = []
    for line in np.argsort(-area, kind="stable"):
        mean = (normals * size[:, None])[owner.ravel() == line].sum(axis=0)
        mean /= np.linalg.norm(mean)
        if all(np.linalg.norm(np.cross(mean, known)) > 2 * _SAME for known in found):
            if len(found) == _NORMALS:
                return np.array(found), False
            found.append(mean)
    return np.array(found), True


def slides(normals: Array) -> Array:
    """Return unit vectors along normals, and along the lines in which the planes of two of them meet, both ways.

    Args:
        normals: unit vectors, shape (normals, 3).
    """
    one, two = np.triu_indices(len(normals), 1)
    lines = np.cross(normals[one], normals[two])
    size = np.linalg.norm(lines, axis=1)
    found: list[Array] = []
    for line in [*normals, *(lines[size > _SAME] / size[size > _SAME, None])]:
        if all(np.linalg.norm(np.cross(line, known)) > 2 * _SAME for known in found):
            found.append(np.where(np.abs(line) < _SAME, 0.0, line) / np.linalg.norm(line))
    return np.concatenate([[line, -line] for line in found])


def levels(triangles: Sequence[Array], direction: Array, tolerance: float) -> tuple[Array, bool]:
    """Return where corners are along a direction, and whether these are all.

    Of more than `_LEVELS` the ends are kept, and those in which most area lies flat across the direction.

    Args:
        triangles: corners of the faces of several parts, shape (faces, 3, 3) each, metres.
        direction: unit vector, shape (3,).
        tolerance: metres; levels nearer to each other are one.
    """
    corners = np.concatenate(list(triangles))
    along = corners @ direction
    order = np.argsort(along, axis=None, kind="stable")
    flat = along.ravel()[order]
    group = np.concatenate([[0], np.cumsum(np.diff(flat) > tolerance)])
    values = np.bincount(group, flat) / np.bincount(group)
    if len(values) <= _LEVELS:
        return values, True
    of_corner = np.empty(len(flat), dtype=np.int64)
    of_corner[order] = group
    of_corner = of_corner.reshape(along.shape)
    level = (of_corner == of_corner[:, :1]).all(axis=1)
    area = np.linalg.norm(triangle_normals(corners[level]), axis=1)
    weight = np.bincount(of_corner[level, 0], area, len(values)).astype(float)
    weight[[0, -1]] = np.inf
    return values[np.sort(np.argsort(-weight, kind="stable")[:_LEVELS])], False
