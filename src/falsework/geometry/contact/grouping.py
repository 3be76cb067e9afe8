"""Grouping of contact patches by plane, and of curved interfaces by direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import segment_mean, segment_sum
from falsework.geometry.contact.creases import expand
from falsework.geometry.contact.patches import Patches

Array = NDArray[np.float64]

COPLANAR = 0.1
"""Largest angle between the normals of patches that form one plane, degrees."""
CURVED_FROM = 16
"""Pairs of parts with more planes than this have their interface grouped by its curvature."""
_MANY = 256
"""Patches of a pair from which a tree takes less time than comparing all."""


def planes(patches: Patches, coplanar: float, tolerance: float | Array, many: int = _MANY) -> NDArray[np.int64]:
    """Assign patches to planes of their pair of parts.

    The largest patch that is left of a pair collects the patches of that pair within `coplanar` degrees and
    `tolerance` metres, one number or one a patch, of its plane. Pairs of up to `many` patches go forward together.

    Returns:
        Plane of every patch, counted from 0, shape (patches,).
    """
    count = len(patches.areas)
    tolerances = np.broadcast_to(tolerance, count)
    pair = _pairs(patches.parts)
    centre = segment_mean(patches.points, patches.owner, count)
    plane = np.full(count, -1, dtype=np.int64)
    rest = np.lexsort((-patches.areas, pair))
    found = 0
    large = np.bincount(pair, minlength=1) > many
    for one in np.flatnonzero(large).tolist():
        order = rest[np.searchsorted(pair[rest], one) : np.searchsorted(pair[rest], one, side="right")]
        found = _planes_of_pair(patches, order, centre, coplanar, tolerances, plane, found)
    rest = rest[~large[pair[rest]]]
    limit = np.cos(np.radians(coplanar))
    corners = np.arange(len(patches.points))
    while len(rest):
        leads = np.append(True, pair[rest[1:]] != pair[rest[:-1]])
        seed = rest[np.flatnonzero(leads)[np.cumsum(leads) - 1]]
        parallel = np.einsum("ij,ij->i", patches.normals[rest], patches.normals[seed]) >= limit
        seed_of = np.full(count, -1, dtype=np.int64)
        seed_of[rest[parallel]] = seed[parallel]
        corners = corners[plane[patches.owner[corners]] < 0]
        near = corners[seed_of[patches.owner[corners]] >= 0]
        owner = patches.owner[near]
        lead = seed_of[owner]
        height = np.abs(np.einsum("pi,pi->p", patches.points[near] - centre[lead], patches.normals[lead]))
        seed_of[owner[height > tolerances[owner]]] = -1
        seed_of[rest[leads]] = rest[leads]  # a seed always belongs to itself, or the loop would not end
        taken = seed_of[rest] >= 0
        plane[rest[taken]] = found + np.cumsum(leads)[taken] - 1
        found += int(leads.sum())
        rest = rest[~taken]
    return plane


def _planes_of_pair(
    patches: Patches,
    order: NDArray[np.int64],
    centre: Array,
    coplanar: float,
    tolerances: Array,
    plane: NDArray[np.int64],
    found: int,
) -> int:
    """Assign the patches of one pair of parts, in the given order of seeds, to planes counted from `found`.

    A tree over normals and distances from the origin finds the patches that may lie in the plane of a seed, so that an
    interface of as many planes as facets takes no longer than a flat one.

    Returns:
        The next number of a plane.
    """
    from scipy.spatial import KDTree

    normals, places = patches.normals[order], centre[order] - centre[order].mean(axis=0)
    chord = 2 * np.sin(np.radians(coplanar) / 2)
    # Of a patch in the plane of a seed, the distance from the origin differs from that of the seed by at most this.
    slip = chord * float(np.linalg.norm(places, axis=1).max()) + float(tolerances[order].max())
    level = np.einsum("ij,ij->i", normals, places) * (chord / slip)
    tree = KDTree(np.column_stack([normals, level]))
    start = np.searchsorted(patches.owner, order)
    stop = np.searchsorted(patches.owner, order, side="right")
    limit = np.cos(np.radians(coplanar))
    left = np.ones(len(order), dtype=bool)
    for seed in range(len(order)):
        if not left[seed]:
            continue
        near = np.array(tree.query_ball_point(tree.data[seed], 1.01 * chord, p=np.inf), dtype=np.int64)
        near = near[left[near]]
        near = near[normals[near] @ normals[seed] >= limit]
        row, corner = expand(start[near], stop[near])
        height = np.abs((patches.points[corner] - centre[order[seed]]) @ normals[seed])
        off = np.zeros(len(near), dtype=bool)
        off[row[height > tolerances[order[near]][row]]] = True
        taken = np.append(near[~off], seed)
        left[taken] = False
        plane[order[taken]] = found
        found += 1
    return found


def curved_groups(patches: Patches, plane: NDArray[np.int64], curvature: float, tolerance: float) -> NDArray[np.int64]:
    """Join planes of pairs of parts that have many, and leave those of all other pairs alone.

    The largest plane that is left collects those that hang together with it, corner to corner, and whose
    normals differ from its own by at most `curvature` degrees.

    Returns:
        Group of every patch, counted from 0, shape (patches,).
    """
    count = int(plane.max()) + 1 if len(plane) else 0
    normals = segment_sum(patches.normals * patches.areas[:, None], plane, count)
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(areas, 1e-300)[:, None]
    first = np.zeros(count, dtype=np.int64)
    first[plane[::-1]] = np.arange(len(plane))[::-1]
    pair = _pairs(patches.parts[first])
    many = np.bincount(pair, minlength=1) > CURVED_FROM
    if not many.any():
        return plane
    owner = plane[patches.owner]
    centre = np.round(segment_mean(patches.points, owner, count) / tolerance)
    group = np.arange(count)
    limit = np.cos(np.radians(curvature))
    for one in np.flatnonzero(many).tolist():
        members = np.flatnonzero(pair == one)
        # Equal areas come in all triangulations in the same order: by place, not by rounding.
        size = np.round(areas[members] / areas[members].max(), 6)
        order = members[np.lexsort((*centre[members].T[::-1], -size))].tolist()
        beside = _neighbours(patches.points, owner, pair, one, 2 * tolerance)
        left = set(order)
        for seed in order:
            if seed not in left:
                continue
            left.discard(seed)
            stack = [seed]
            while stack:
                for other in beside.get(stack.pop(), ()):
                    if other in left and normals[other] @ normals[seed] >= limit:
                        left.discard(other)
                        group[other] = seed
                        stack.append(other)
    _, group = np.unique(group, return_inverse=True)
    return group[plane]


def _pairs(parts: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the number of the pair of parts in every row, counted from 0 in order of the pairs."""
    return np.unique(parts[:, 0] * np.int64(2**32) + parts[:, 1], return_inverse=True)[1].astype(np.int64)


def _neighbours(
    points: Array, owner: NDArray[np.int64], pair: NDArray[np.int64], one: int, reach: float
) -> dict[int, list[int]]:
    """Return planes of one pair of parts that have a corner within `reach` of each other."""
    of_pair = np.flatnonzero(pair[owner] == one)
    from scipy.spatial import KDTree

    near = KDTree(points[of_pair]).query_pairs(reach, output_type="ndarray")
    edges = np.unique(np.sort(owner[of_pair][near], axis=1), axis=0)
    beside: dict[int, list[int]] = {}
    for a, b in edges[edges[:, 0] != edges[:, 1]].tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    return beside
