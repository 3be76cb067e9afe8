"""Outer approximation of a convex hull with fewer planes, for cheaper collision queries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, HalfspaceIntersection

from falsework.robots.model.shapes import hull
from falsework.utils.arrays import Array

MAX_PLANES = 48
"""Largest number of planes of a simplified hull."""


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
