"""Check that a mesh bounds a solid, with repair where that is safe."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import MeshError, ReadWarning
from falsework.geometry.mesh.bodies import merge_equal, weld
from falsework.geometry.mesh.edges import edge_mates, equal_faces, is_closed, open_edges
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.polygon import triangulate
from falsework.geometry.mesh.sheets import is_sheet, plane_normal, thickened
from falsework.geometry.mesh.shells import Shells
from falsework.utils.quantity import format_quantity, listed

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

SMALLEST, LARGEST = 1e-4, 1e3
"""Smallest and largest extent of a part, metres: beyond them the unit is wrong."""

_FLAT = 0.02
"""Distance of the rim of a hole from its plane, relative to its size, up to which closing it adds next to no shape."""


class RepairWarning(UserWarning):
    """Repair of a mesh before use."""


def thicken_supports(
    solids: Sequence[tuple[str, Array, Faces]], supports: Collection[int]
) -> list[tuple[str, Array, Faces]]:
    """Give supports that are open, nearly flat surfaces a thickness, on the side away from their neighbours.

    Reports the repair by a `RepairWarning`. No result depends on the mass of a support.

    Args:
        solids: name, vertices in metres, shape (vertices, 3), and faces, shape (faces, 3), of each part.
        supports: fixed parts.

    Returns:
        As `solids`.
    """
    sheets = [
        part
        for part, (_, vertices, faces) in enumerate(solids)
        if part in supports and len(faces) and is_sheet(vertices, faces)
    ]
    if not sheets:
        return list(solids)
    others = [vertices for part, (_, vertices, _) in enumerate(solids) if part not in sheets and len(vertices)]
    whole, most = list(solids), 0.0
    for part in sheets:
        name, vertices, faces = solids[part]
        vertices, faces, thickness = thickened(vertices, faces, others)
        whole[part] = name, vertices, faces
        most = max(most, thickness)
    warnings.warn(
        f"supports modelled as open surfaces ({len(sheets)}, the first is part {solids[sheets[0]][0]}) "
        f"were given a thickness of up to {format_quantity(most, 'length')} behind them",
        RepairWarning,
        stacklevel=3,
    )
    return whole


def check_mesh(name: str, vertices: ArrayLike, faces: ArrayLike) -> TriangleMesh:
    """Turn raw arrays into the closed mesh of a part.

    Vertices at the same place are merged silently, since formats such as STL repeat them. Repairs that
    cannot change the shape are made with a `RepairWarning`: vertices within 1e-6 of the part's diagonal are
    merged, faces without area or given twice are dropped, faces are turned to look outwards, flat holes are
    closed, and closed surfaces that overlap are united, which takes manifold3d. A mesh that is closed and
    looks outwards, and whose surfaces do not overlap, comes back with its faces as they were. A part of several
    separate solids is a `ReadWarning`.

    Args:
        name: name of the part in messages.
        vertices: shape (vertices, 3), metres.
        faces: shape (faces, 3).

    Raises:
        MeshError: NaN, no faces, larger than 1 km or smaller than 0.1 mm, not closed, without volume, or with
            surfaces that overlap where manifold3d is not installed.
    """
    mesh, done = _check(name, vertices, faces)
    if done:
        warnings.warn(f"part {name} was repaired: {done}", RepairWarning, stacklevel=2)
    return mesh


def check_meshes(parts: Iterable[tuple[str, ArrayLike, ArrayLike]]) -> tuple[TriangleMesh, ...]:
    """Turn raw arrays into the closed meshes of parts, as `check_mesh` does; parts repaired alike are one warning.

    Args:
        parts: name, vertices and faces of each.

    Raises:
        MeshError: as `check_mesh`.
    """
    meshes: list[TriangleMesh] = []
    repaired: dict[str, list[str]] = {}
    for name, vertices, faces in parts:
        mesh, done = _check(name, vertices, faces)
        meshes.append(mesh)
        if done:
            repaired.setdefault(done, []).append(name)
    for done, names in repaired.items():
        which = f"part {names[0]} was" if len(names) == 1 else f"parts {listed(names)} were"
        warnings.warn(f"{which} repaired: {done}", RepairWarning, stacklevel=2)
    return tuple(meshes)


def _check(name: str, vertices: ArrayLike, faces: ArrayLike) -> tuple[TriangleMesh, str]:
    """Return the closed mesh of a part and what was repaired; see `check_mesh`."""
    points, corners = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if not len(corners) or not len(points):
        raise MeshError(f"part {name} has no faces; export it as a mesh of triangles")
    TriangleMesh.from_arrays(name, points, corners)
    finite = np.asarray(np.isfinite(points).all(axis=1))
    if not finite[corners].all():
        vertex = int(corners.ravel()[np.argmin(finite[corners].ravel())])
        raise MeshError(f"part {name}: vertex {vertex} is NaN or infinite; export the mesh again")
    points, corners = merge_equal(points, corners)
    extent = float(np.ptp(points, axis=0).max())
    if not SMALLEST <= extent <= LARGEST:
        raise MeshError(
            f"part {name} is {format_quantity(extent, 'length')} long; parts must be 0.1 mm to 1 km, so give the "
            f"unit of the file (unit mm?)"
        )
    done: list[str] = []
    if not is_closed(corners):
        points, corners = _repaired(name, points, corners, done)
    else:
        corners = _drop_copies(corners, done)
    shells = Shells.from_mesh(points, corners)
    turned = shells.outward_faces(corners)
    if (turned != corners).any():
        done.append("turned surfaces inside out")
    if shells.overlap():
        points, turned, twice = shells.unite(name)
        done.append(
            f"united surfaces that overlapped, whose {format_quantity(twice, 'volume')} in common counted twice"
        )
    elif shells.count > 1:
        warnings.warn(
            f"part {name} consists of {shells.count} separate solids, which count as one rigid body; "
            "make them parts of their own if they are not",
            ReadWarning,
            stacklevel=2,
        )
    mesh = TriangleMesh.from_arrays(name, points, turned)
    if mesh.volume <= 1e-12 * extent**3:
        raise MeshError(f"part {name} has no volume; export it as a solid that encloses space")
    return mesh, ", ".join(done)


def closes(vertices: Array, faces: Faces) -> bool:
    """Return whether a surface bounds a solid by itself as soon as its flat holes are closed.

    Args:
        vertices: shape (vertices, 3), of any unit.
        faces: shape (faces, 3), of vertices that exist.
    """
    if not len(faces) or not np.isfinite(vertices[np.unique(faces)]).all():
        return False
    try:
        _repaired("", *merge_equal(vertices, faces), [])
    except MeshError:
        return False
    return True


def _drop_copies(corners: Faces, done: list[str]) -> Faces:
    """Drop second copies of faces of a closed surface, which would count its volume twice."""
    kept = np.sort(equal_faces(corners)[0])
    if len(kept) == len(corners) or not is_closed(corners[kept]):
        return corners
    done.append("dropped faces that are doubled")
    return corners[kept]


def _repaired(name: str, points: Array, corners: Faces, done: list[str]) -> tuple[Array, Faces]:
    """Repair with increasingly strong methods, and stop as soon as the surface is closed."""
    welded = weld(points)
    if len(np.unique(welded)) < len(points):
        done.append("merged vertices that almost coincide")
        points, corners = merge_equal(points[welded], corners)
    # Slivers whose corners differ stay: dropping them would tear the surface.
    thin = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    twice = np.ones(len(corners), dtype=bool)
    twice[first] = False
    if (thin | twice).any() and not is_closed(corners[~thin] if (~thin).any() else corners):
        done.append("dropped faces that are degenerate or doubled")
        corners = corners[~(thin | twice)]
    elif thin.any():
        done.append("dropped faces that are degenerate")
        corners = corners[~thin]
    if not len(corners):
        raise MeshError(f"part {name} has no face with an area; export it as a solid that encloses space")
    points, corners = merge_equal(points, corners)
    if not is_closed(corners):
        turned = _wind(corners)
        if turned is not None and (turned != corners).any():
            done.append("turned faces to look the same way")
            corners = turned
    if not is_closed(corners):
        corners = _close_flat_holes(name, points, corners)
        done.append("closed flat holes")
    return points, corners


def _wind(corners: Faces) -> Faces | None:
    """Turn faces so that neighbours agree.

    Returns None where an edge has more than two faces, or a surface has only one side.
    """
    one, two, crowded = edge_mates(corners)
    if crowded:
        return None
    tail = corners.ravel()
    disagree = tail[one] == tail[two]
    count = len(corners)
    # Weight 2 for neighbours that disagree, 1 for those that agree: zero would be no edge.
    weight = np.where(disagree, 2, 1)
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

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


def _close_flat_holes(name: str, points: Array, corners: Faces) -> Faces:
    """Cap holes whose rims are flat simple loops; raise for any other opening."""
    tail, head = open_edges(corners)
    following = dict(zip(head.tolist(), tail.tolist(), strict=True))  # rims run against their faces
    error = MeshError(
        f"part {name} is not closed: {len(tail)} edges have a face on one side only; "
        "close it in the modeller (join, cap, weld) and export it again"
    )
    if not len(tail) or len(following) != len(tail) or is_sheet(points, corners):
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
        size = float(np.linalg.norm(np.ptp(loop, axis=0)))
        if np.abs((loop - loop.mean(axis=0)) @ plane_normal(loop)).max() > _FLAT * size:
            raise error
        caps.append(np.asarray(rim)[np.asarray(triangulate(loop))])
    closed = np.concatenate([corners, *caps])
    if not is_closed(closed):
        raise error
    return closed
