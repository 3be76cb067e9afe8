"""Check that a mesh bounds a solid, with repair where that is safe."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import KDTree

from falsework.errors import MeshError
from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.polygon import newell_normal, triangulate

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

SMALLEST, LARGEST = 1e-4, 1e3
"""Smallest and largest extent of a part, metres: beyond them the unit is wrong."""

_WELD = 1e-6
"""Distance, relative to the diagonal of a part, below which vertices are the same."""
_FLAT = 1e-3
"""Height, relative to the size of a hole, up to which the hole is flat and closing it adds no shape."""


class RepairWarning(UserWarning):
    """Repair of a mesh before use."""


def check_mesh(name: str, vertices: ArrayLike, faces: ArrayLike) -> TriangleMesh:
    """Turn raw arrays into the closed mesh of a part.

    Vertices at the same place are merged silently, since formats such as STL repeat them. Repairs that
    cannot change the shape are made with a `RepairWarning`: vertices within 1e-6 of the part's diagonal are
    merged, faces without area or given twice are dropped, faces are turned to look outwards, and flat holes
    are closed. A mesh that is closed and looks outwards comes back with its faces as they were.

    Args:
        name: how messages call the part.
        vertices: shape (vertices, 3), metres.
        faces: shape (faces, 3).

    Raises:
        MeshError: NaN, no faces, larger than 1 km or smaller than 0.1 mm, not closed, or without volume.
    """
    points, corners = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if not len(corners) or not len(points):
        raise MeshError(f"part {name} has no faces; export it as a mesh of triangles")
    TriangleMesh.from_arrays(name, points, corners)
    finite = np.asarray(np.isfinite(points).all(axis=1))
    if not finite[corners].all():
        vertex = int(corners.ravel()[np.argmin(finite[corners].ravel())])
        raise MeshError(f"part {name}: vertex {vertex} is NaN or infinite; export the mesh again")
    points, corners = _merge_equal(points, corners)
    extent = float(np.ptp(points, axis=0).max())
    if not SMALLEST <= extent <= LARGEST:
        raise MeshError(
            f"part {name} is {extent:.3g} m long; parts must be 0.1 mm to 1 km, so give the unit of the file (unit mm?)"
        )
    done: list[str] = []
    if not _is_closed(corners):
        points, corners = _mend(name, points, corners, done)
    turned = _orient(points, corners)
    if (turned != corners).any():
        done.append("turned surfaces inside out")
    mesh = TriangleMesh.from_arrays(name, points, turned)
    if mesh.volume <= 1e-12 * extent**3:
        raise MeshError(f"part {name} has no volume; export it as a solid that encloses space")
    if done:
        warnings.warn(f"part {name} was repaired: {', '.join(done)}", RepairWarning, stacklevel=2)
    return mesh


def _merge_equal(points: Array, corners: Faces) -> tuple[Array, Faces]:
    """Merge vertices with equal coordinates and drop those that no face uses, in order of first use."""
    used, index = np.unique(corners, return_inverse=True)
    _, first, inverse = np.unique(points[used] + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return points[used][first[order]], rank[inverse.ravel()][index].reshape(-1, 3)


def _directed_edges(corners: Faces) -> tuple[Faces, Faces]:
    """Start and end of the three edges of every face, shapes (3 faces,); edges of one face are consecutive."""
    return corners.ravel(), corners[:, [1, 2, 0]].ravel()


def _is_closed(corners: Faces) -> bool:
    """Return whether every edge is passed as often one way as the other, which makes the surface a closed one."""
    tail, head = _directed_edges(corners)
    count = int(corners.max()) + 1
    return bool((tail != head).all() and (np.sort(tail * count + head) == np.sort(head * count + tail)).all())


def _mend(name: str, points: Array, corners: Faces, done: list[str]) -> tuple[Array, Faces]:
    """Repair in order of growing reach, and stop as soon as the surface is closed."""
    welded = _weld(points, corners)
    if len(np.unique(welded)) < len(points):
        done.append("merged vertices that almost coincide")
        points, corners = _merge_equal(points[welded], corners)
    # Slivers whose corners differ stay: dropping them would tear the surface.
    thin = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    twice = np.ones(len(corners), dtype=bool)
    twice[first] = False
    if (thin | twice).any() and not _is_closed(corners[~thin] if (~thin).any() else corners):
        done.append("dropped faces that are degenerate or doubled")
        corners = corners[~(thin | twice)]
    elif thin.any():
        done.append("dropped faces that are degenerate")
        corners = corners[~thin]
    if not len(corners):
        raise MeshError(f"part {name} has no face with an area; export it as a solid that encloses space")
    points, corners = _merge_equal(points, corners)
    if not _is_closed(corners):
        turned = _wind(corners)
        if turned is not None and (turned != corners).any():
            done.append("turned faces to look the same way")
            corners = turned
    if not _is_closed(corners):
        corners = _close_flat_holes(name, points, corners)
        done.append("closed flat holes")
    return points, corners


def _weld(points: Array, corners: Faces) -> NDArray[np.int64]:
    """Return for every vertex the representative of all vertices within the welding distance."""
    reach = _WELD * float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = KDTree(points).query_pairs(reach, output_type="ndarray")
    graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    return first[label]


def _wind(corners: Faces) -> Faces | None:
    """Turn faces so that neighbours agree.

    Returns None where an edge has more than two faces, or a surface has only one side.
    """
    one, two, crowded = _edge_mates(corners)
    if crowded:
        return None
    tail = corners.ravel()
    disagree = tail[one] == tail[two]
    count = len(corners)
    # Weight 2 for neighbours that disagree, 1 for those that agree: zero would be no edge.
    weight = np.where(disagree, 2, 1)
    graph = csr_matrix((weight, (one // 3, two // 3)), shape=(count, count))
    graph = graph.maximum(graph.T).tocsr()
    shells, label = connected_components(graph, directed=False)
    flip = np.zeros(count, dtype=bool)
    for shell in range(shells):
        visit, before = breadth_first_order(graph, int(np.argmax(label == shell)), directed=False)
        for face in visit[1:].tolist():
            flip[face] = flip[before[face]] ^ (graph[before[face], face] == 2)
        # Prefer to keep the majority as it is, so that an outward mesh with few wrong faces stays outward.
        if flip[visit].sum() * 2 > len(visit):
            flip[visit] = ~flip[visit]
    if ((flip[one // 3] ^ flip[two // 3]) != disagree).any():
        return None
    turned = corners.copy()
    turned[flip] = turned[flip][:, ::-1]
    return turned


def _edge_mates(corners: Faces) -> tuple[Faces, Faces, bool]:
    """Return pairs of directed edges between the same vertices, and whether any edge has more than two faces."""
    tail, head = _directed_edges(corners)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    return order[:-1][same], order[1:][same], bool((same[1:] & same[:-1]).any())


def _orient(points: Array, corners: Faces) -> Faces:
    """Turn each closed surface of a part outwards, or inwards where it bounds a hollow in another."""
    one, two, _ = _edge_mates(corners)
    graph = csr_matrix((np.ones(len(one)), (one // 3, two // 3)), shape=(len(corners), len(corners)))
    count, surface = connected_components(graph, directed=False)
    triangles = points[corners]
    local = triangles - points.mean(axis=0)
    six_volumes = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2]))
    outward = np.bincount(surface, six_volumes) > 0
    hollow = np.zeros(count, dtype=bool)
    if count > 1:
        shells = [triangles[surface == index] for index in range(count)]
        for outer, shell in enumerate(shells):
            shell = shell if outward[outer] else shell[:, ::-1]
            for inner in range(count):
                if inner != outer and inside(shells[inner].reshape(-1, 3), shell).all():
                    hollow[inner] ^= True
    turned = corners.copy()
    wrong = (outward == hollow)[surface]
    turned[wrong] = turned[wrong][:, ::-1]
    return turned


def _close_flat_holes(name: str, points: Array, corners: Faces) -> Faces:
    """Cap holes whose rims are flat simple loops; raise for any other opening."""
    tail, head = _directed_edges(corners)
    count = len(points)
    forward = np.sort(tail * count + head)
    lonely = ~np.isin(head * count + tail, forward)
    following = dict(zip(head[lonely].tolist(), tail[lonely].tolist(), strict=True))  # rims run against their faces
    error = MeshError(
        f"part {name} is not closed: {int(lonely.sum())} edges have a face on one side only; "
        "close it in the modeller (join, cap, weld) and export it again"
    )
    if not lonely.any() or len(following) != lonely.sum():
        raise error
    caps: list[NDArray[np.int64]] = []
    while following:
        start, at = next(iter(following.items()))
        rim = [start]
        del following[start]
        while at != start:
            if at not in following:
                raise error
            rim.append(at)
            at = following.pop(at)
        loop = points[rim]
        normal = newell_normal(loop)
        area, size = float(np.linalg.norm(normal)), float(np.linalg.norm(np.ptp(loop, axis=0)))
        if area <= 0 or np.abs((loop - loop.mean(axis=0)) @ (normal / area)).max() > _FLAT * size:
            raise error
        caps.append(np.asarray(rim)[np.asarray(triangulate(loop))])
    closed = np.concatenate([corners, *caps])
    if not _is_closed(closed):
        raise error
    return closed
