"""Reader of part meshes: a folder with one file per part, or one file with all parts."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError, MeshError
from falsework.geometry.mesh.bounds import check_glb
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.obj import read_obj
from falsework.geometry.mesh.repair import check_mesh, thicken_supports

SUFFIXES = (".obj", ".stl", ".ply", ".glb")
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length of a unit in metres."""


@dataclass(frozen=True, eq=False)
class _Solid:
    """Named object of a mesh file."""

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def unit_length(unit: str) -> float:
    """Return the length of a unit in metres.

    Raises:
        InputError: a unit that is not known.
    """
    if unit not in UNITS:
        raise InputError(f"unknown unit {unit!r}; use one of {', '.join(UNITS)}")
    return UNITS[unit]


def load_meshes(path: str | Path, unit: str = "m", *, supports: Collection[int | str] = ()) -> tuple[TriangleMesh, ...]:
    """Read and check the meshes of all parts, and repair them where that is safe.

    A folder holds one file a part (OBJ, STL, PLY, GLB). Names that are all numbers are the ids of the
    parts and must be `0` to `m - 1`; other names are put in natural order. A single file holds one object a
    part; a file without objects is split into connected surfaces. GLB is read as its
    standard has it, y up, and turned to z up.

    Args:
        path: folder or file.
        unit: unit of the coordinates.
        supports: ids or names of fixed parts; open surfaces among them are given a thickness, see `thicken_supports`.

    Raises:
        InputError: no such path, nothing to read in it, ids missing or doubled, or an unknown unit.
        MeshError: a mesh that does not bound a solid.
    """
    source, scale = Path(path), unit_length(unit)
    if not source.exists():
        raise InputError(f"there is no {source}; give a folder of meshes or a file with one object per part")
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
        if not files:
            raise InputError(f"no mesh in {source}; put one file per part there ({', '.join(SUFFIXES)})")
        if len(files) == 1:
            solids = _read_parts(files[0])
        else:
            solids = [_one_solid(file) for file in _in_order(files)]
    elif source.suffix.lower() in SUFFIXES:
        solids = _read_parts(source)
    else:
        raise InputError(f"cannot read {source}; meshes are {', '.join(SUFFIXES)}")
    solids = [replace(solid, vertices=solid.vertices * scale) for solid in solids]
    named = [part for part, solid in enumerate(solids) if part in supports or solid.name in supports]
    parts = [(solid.name, solid.vertices, solid.faces) for solid in solids]
    return tuple(check_mesh(*part) for part in thicken_supports(parts, named))


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which `part-10` follows `part-9`."""
    return tuple(
        (0, int(piece), "") if piece.isdecimal() else (1, 0, piece) for piece in re.split(r"(\d+)", name) if piece
    )


def _in_order(files: list[Path]) -> list[Path]:
    """Return files by part id, or by name where names are not ids."""
    names = [file.stem for file in files]
    order = _order(names, files[0].parent)
    return [files[index] for index in order]


def _order(names: list[str], where: Path) -> list[int]:
    """Return the order of parts by id where all names are numbers, else in natural order; each name once."""
    ids = [int(name) if name.isdecimal() else None for name in names]
    if all(number is not None for number in ids):
        for number in range(len(ids)):
            if ids.count(number) > 1:
                raise InputError(f"part {number} occurs {ids.count(number)} times in {where}; give every id once")
        missing = sorted(set(range(len(ids))) - set(ids))
        if missing:
            raise InputError(
                f"part {missing[0]} is missing in {where}: {len(ids)} parts need the ids 0 to {len(ids) - 1}"
            )
        return sorted(range(len(ids)), key=lambda index: ids[index] or 0)
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"part {name!r} occurs {names.count(name)} times in {where}; give every name once")
    return sorted(range(len(names)), key=lambda index: natural_key(names[index]))


def _one_solid(file: Path) -> _Solid:
    """Return all objects of a file as one part."""
    solids = _read_solids(file)
    counts = np.cumsum([0] + [len(solid.vertices) for solid in solids[:-1]])
    return _Solid(
        file.stem,
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + first for solid, first in zip(solids, counts, strict=True)]),
    )


def _read_parts(file: Path) -> list[_Solid]:
    """Return one part an object of a file."""
    solids = _read_solids(file)
    if len(solids) == 1:
        return _split(solids[0])
    names = [solid.name for solid in solids]
    if file.suffix.lower() == ".obj" and not all(name.isdecimal() for name in names):
        return solids
    return [solids[index] for index in _order(names, file)]


def _read_solids(file: Path) -> list[_Solid]:
    """Return objects of a file, at least one, in its own unit, z up."""
    if file.suffix.lower() == ".obj":
        solids = [_Solid(*item) for item in read_obj(file)]
    else:
        import trimesh

        options: dict[str, Any] = {}
        if file.suffix.lower() == ".glb":
            check_glb(file)
            options = {"skip_materials": True}  # images may unpack to any size
        logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else it prints tracebacks
        try:
            scene = trimesh.load_scene(file, process=False, **options)
        except Exception as error:  # readers of foreign formats fail in their own ways
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise MeshError(f"cannot read {file}: {reason}; export it again") from error
        solids = []
        for node in sorted(scene.graph.nodes_geometry, key=natural_key):
            transform, geometry = scene.graph[node]
            mesh = scene.geometry[geometry]
            if not isinstance(mesh, trimesh.Trimesh):
                continue
            vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
            faces = np.asarray(mesh.faces, dtype=np.int64)
            if len(faces) and not (faces.min() >= 0 and faces.max() < len(vertices)):
                raise MeshError(f"a face in {file} uses a vertex that does not exist; export it again")
            if np.linalg.det(transform[:3, :3]) < 0:
                faces = faces[:, ::-1]
            if file.suffix.lower() == ".glb":
                vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
            solids.append(_Solid(node, np.asarray(vertices, dtype=np.float64), faces))
    if not solids:
        raise MeshError(f"no mesh in {file}; export the parts as triangles")
    return solids


def _split(solid: _Solid) -> list[_Solid]:
    """Return parts of a file without objects: surfaces connected by edges."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    _, same = np.unique(solid.vertices, axis=0, return_inverse=True)
    edges = np.sort(same.ravel()[np.stack([solid.faces, solid.faces[:, [1, 2, 0]]], axis=2)].reshape(-1, 2), axis=1)
    _, edge, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    if (uses > 2).any():
        # Solids that share an edge cannot be told apart by their surface; a single part may look like that.
        return [_Solid("0", solid.vertices, solid.faces)]
    face = np.repeat(np.arange(len(solid.faces)), 3)
    graph = csr_matrix((np.ones(len(face)), (face, edge.ravel())), shape=(len(solid.faces), len(uses)))
    count, label = connected_components(graph @ graph.T, directed=False)
    return [_Solid(str(part), solid.vertices, solid.faces[label == part]) for part in range(count)]
