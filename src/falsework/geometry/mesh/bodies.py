"""Separate solids in one triangle surface, also of blocks that touch each other along edges and faces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.edges import components, directed_edges, equal_faces
from falsework.geometry.mesh.sheets import is_flat

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

_WELD = 1e-6
"""Distance, relative to the diagonal of a surface, below which vertices are the same."""
_SHEET = 1e-3
"""Thickness, as a share of its size, below which an open surface bounds no solid by itself."""
_SAME_ANGLE = 1e-4
"""Angle between two faces at an edge below which they coincide, radians."""


def merge_equal(points: Array, corners: Faces) -> tuple[Array, Faces]:
    """Merge vertices with equal coordinates and drop those that no face uses, in order of first use."""
    used, index = np.unique(corners, return_inverse=True)
    _, first, inverse = np.unique(points[used] + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return points[used][first[order]], rank[inverse.ravel()][index].reshape(-1, 3)


def weld(points: Array) -> NDArray[np.int64]:
    """Return for every vertex the representative of all vertices within the welding distance."""
    reach = _WELD * float(np.linalg.norm(np.ptp(points, axis=0)))
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(reach, output_type="ndarray")
    label = components(pairs[:, 0], pairs[:, 1], len(points))
    _, first = np.unique(label, return_index=True)
    return first[label]


def separate_solids(vertices: Array, faces: Faces) -> list[Faces]:
    """Split a surface into its solids, each with the surfaces of the hollows in it.

    Faces without an extent, two of whose corners are at the same place, are left out.

    Args:
        vertices: shape (vertices, 3), of any unit.
        faces: shape (faces, 3).

    Returns:
        Faces of each solid, in the order of their first faces; all of them where there is nothing to split, or a vertex
        that does not exist. An empty list if solids share edges and cannot be told apart.
    """
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        return [faces]
    used = np.unique(faces)
    if not np.isfinite(vertices[used]).all():
        return [faces]
    label = _labels(vertices, faces)
    if label is None or len(_open(vertices, faces, label)):
        # As for one part, rounding of vertices is no gap.
        near = vertices.copy()
        near[used] = vertices[used][weld(vertices[used])]
        again = _labels(near, faces)
        if again is not None and (label is None or len(_open(near, faces, again)) < len(_open(vertices, faces, label))):
            vertices, label = near, again
    if label is None:
        return []
    if not (label >= 0).any():
        return [faces]
    unclosed = {surface: vertices[faces[label == surface]].reshape(-1, 3) for surface in _open(vertices, faces, label)}
    sheets = [surface for surface, points in unclosed.items() if is_flat(points, _SHEET)]
    label = np.where(np.isin(label, sheets), -2, label)
    solid = np.unique(label, return_index=True)
    start = np.sort([first for name, first in zip(*solid, strict=True) if name != -1])
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], label[start], side="right")
    begins = np.searchsorted(label[order], label[start], side="left")
    return [faces[order[begin:end]] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)]


def _labels(vertices: Array, faces: Faces) -> NDArray[np.int64] | None:
    """Return the solid of each face, -1 for faces without an extent; None if solids cannot be told apart."""
    points, corners = merge_equal(vertices, faces)
    label = np.full(len(faces), -1)
    solid = np.flatnonzero((corners != np.roll(corners, 1, axis=1)).all(axis=1))
    if not len(solid):
        return label
    corners = corners[solid]
    first, copy = equal_faces(corners)
    found = _solids_by_index(faces[solid][first])
    if found is None:
        found = surfaces_of(points, corners[first])
    if found is None:
        return None
    label[solid] = _with_hollows(points, corners[first], found)[copy]
    return label


def _open(vertices: Array, faces: Faces, label: NDArray[np.int64]) -> list[int]:
    """Return the labels of surfaces that are not closed."""
    _, corners = merge_equal(vertices, faces)
    corners, of = corners[label >= 0], np.repeat(label[label >= 0], 3)
    if not len(corners):
        return []
    (tail, head), count = directed_edges(corners), int(corners.max()) + 1
    forward, backward = ((of * count + a) * count + b for a, b in ((tail, head), (head, tail)))
    return np.unique(of[~np.isin(forward, backward)]).tolist()


def surfaces_of(points: Array, corners: Faces) -> NDArray[np.int64] | None:
    """Return the surface of each face; surfaces that meet along an edge are told apart by the material between faces.

    Around an edge, a solid lies between two neighbouring faces that have their backs to each other.

    Args:
        points: shape (vertices, 3).
        corners: shape (faces, 3), vertices at the same place merged.

    Returns:
        Shape (faces,); None if surfaces that share edges are not closed by themselves in this way.
    """
    local = points[corners] - points.mean(axis=0)
    if np.einsum("ij,ij->", local[:, 0], np.cross(local[:, 1], local[:, 2])) < 0:
        corners = corners[:, ::-1]  # inside out as a whole
    tail, head = directed_edges(corners)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _, edge, uses = np.unique(low * len(points) + high, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    simple = order[uses[edge[order]] == 2]
    one, two = simple[::2], simple[1::2]
    shared = np.flatnonzero(uses[edge] > 2)
    if not len(shared):
        return components(one // 3, two // 3, len(corners))
    more = _pairs_around(points, corners, shared, edge[shared])
    # Solids that share edges and overlap do not alternate; each may be closed by its other edges.
    for a, b in ([more] if more else []) + [(one[:0], two[:0])]:
        label = components(np.concatenate([one, a]) // 3, np.concatenate([two, b]) // 3, len(corners))
        half = np.repeat(np.isin(label, np.unique(label[shared // 3])), 3)
        of, count = np.repeat(label, 3), len(points)
        if np.array_equal(
            np.sort(((of * count + tail) * count + head)[half]), np.sort(((of * count + head) * count + tail)[half])
        ):
            return label
    return None


def _solids_by_index(faces: Faces) -> NDArray[np.int64] | None:
    """Return the solid of each face where solids have no vertex in common and all are closed; None otherwise."""
    tail, head = directed_edges(faces)
    count = int(faces.max()) + 1
    forward, backward = np.sort(tail * count + head), np.sort(head * count + tail)
    if not np.array_equal(forward, backward) or (forward[1:] == forward[:-1]).any():
        return None
    order = np.argsort(np.minimum(tail, head) * count + np.maximum(tail, head), kind="stable")
    return components(order[::2] // 3, order[1::2] // 3, len(faces))


def _pairs_around(points: Array, corners: Faces, half: NDArray, edge: NDArray) -> tuple[NDArray, NDArray] | None:
    """Pair the faces around edges that more than two faces share.

    Args:
        points: shape (vertices, 3).
        corners: shape (faces, 3).
        half: directed edges, three to a face, shape (n,).
        edge: edge that each belongs to, shape (n,).

    Returns:
        Directed edges of two faces that bound the same solid, shapes (n / 2,); None where faces do not alternate.
    """
    face, place = half // 3, half % 3
    tail, head, apex = (corners[face, (place + step) % 3] for step in range(3))
    forward = tail < head
    start, end = points[np.minimum(tail, head)], points[np.maximum(tail, head)]
    axis = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    arm = points[apex] - start
    arm -= np.einsum("ij,ij->i", arm, axis)[:, None] * axis
    _, first, which = np.unique(edge, return_index=True, return_inverse=True)
    zero = arm[first][which.ravel()]
    across = np.cross(axis, zero)
    angle = np.arctan2(
        np.einsum("ij,ij->i", arm, across) / np.maximum(np.linalg.norm(zero, axis=1), 1e-300),
        np.einsum("ij,ij->i", arm, zero) / np.maximum(np.linalg.norm(zero, axis=1), 1e-300),
    )
    # From the first face of the edge on, so that no group of faces that coincide is torn.
    angle = (angle + 5 * _SAME_ANGLE) % (2 * np.pi)
    one: list[int] = []
    two: list[int] = []
    order = np.lexsort((angle, edge))
    splits = np.flatnonzero(np.diff(edge[order])) + 1
    for rows in np.split(order, splits):
        around = angle[rows]
        group = np.concatenate([[0], np.cumsum(np.diff(around) > _SAME_ANGLE)])
        # Along rising angles the material begins behind a face that runs against the edge and ends before one that
        # runs along it; where two solids touch, one ends before the other begins.
        rows = rows[np.lexsort((~forward[rows], group))]
        ends = forward[rows]
        if ends[0]:
            rows = np.roll(rows, -1)
            ends = forward[rows]
        if len(rows) % 2 or ends[::2].any() or not ends[1::2].all():
            return None
        one += half[rows[::2]].tolist()
        two += half[rows[1::2]].tolist()
    return np.array(one, dtype=np.int64), np.array(two, dtype=np.int64)


def _with_hollows(points: Array, corners: Faces, label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Give surfaces that lie in another one and face the other way the label of that one."""
    count = int(label.max()) + 1
    if count == 1:
        return label
    triangles = points[corners]
    local = triangles - points.mean(axis=0)
    volume = np.bincount(label, np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])), count)
    if not ((volume < 0).any() and (volume > 0).any()):
        return label
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, triangles.min(axis=1))
    np.maximum.at(high, label, triangles.max(axis=1))
    outer = np.arange(count)
    fewer = np.flatnonzero(volume < 0) if (volume < 0).sum() <= (volume > 0).sum() else np.flatnonzero(volume > 0)
    for inner in fewer.tolist():
        around = np.flatnonzero((low < low[inner]).all(axis=1) & (high > high[inner]).all(axis=1))
        around = around[volume[around] * volume[inner] < 0]
        probe = triangles[label == inner][:1, 0]
        for candidate in around[np.argsort(np.abs(volume[around]))].tolist():
            shell = triangles[label == candidate]
            if inside(probe, shell if volume[candidate] > 0 else shell[:, ::-1])[0]:
                outer[inner] = candidate
                break
    return outer[label]
