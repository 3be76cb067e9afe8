"""Reader of part meshes: a folder with one file per part, or one file with all parts."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from falsework.errors import InputError, MeshError
from falsework.geometry.mesh.gltf import read_gltf
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.obj import read_obj
from falsework.geometry.mesh.ply import read_ply
from falsework.geometry.mesh.repair import check_meshes, thicken_supports
from falsework.geometry.mesh.stl import read_stl
from falsework.geometry.mesh.surface import PartSurface, distinct_names, joined, separated, warn_of
from falsework.utils.quantity import listed

_READERS = {".obj": read_obj, ".stl": read_stl, ".ply": read_ply, ".glb": read_gltf, ".gltf": read_gltf}
SUFFIXES = tuple(_READERS)
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length of a unit in metres."""
_MODELS = {
    ".3dm", ".step", ".stp", ".iges", ".igs", ".off", ".3ds", ".fbx", ".dae", ".dxf", ".dwg", ".usd", ".usda", ".usdc",
    ".usdz", ".3mf", ".amf", ".wrl", ".x3d", ".ifc", ".skp", ".blend", ".sat", ".ldr", ".mpd", ".vtk", ".vtp", ".brep",
}  # fmt: skip
"""Files that may hold parts and of which a folder may have none."""
_PACKED = {".zip", ".gz", ".bz2", ".xz", ".7z", ".rar", ".tar", ".tgz"}
"""Files that may have such files in them."""
_LOOKED_AT = 10_000
"""Entries below a folder that are looked at in search of meshes."""


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

    Args:
        path: folder or file, as for `read_surfaces`.
        unit: unit of the coordinates.
        supports: ids or names of fixed parts; open surfaces among them are given a thickness, see `thicken_supports`.

    Raises:
        InputError: no such path, nothing to read in it, ids doubled, or an unknown unit.
        MeshError: a mesh that does not bound a solid.
    """
    scale = unit_length(unit)
    surfaces = read_surfaces(path)
    for surface in surfaces:
        if surface.error:
            raise MeshError(surface.error)
    named = [part for part, surface in enumerate(surfaces) if part in supports or surface.name in supports]
    parts = [(surface.name, surface.vertices * scale, surface.faces) for surface in surfaces]
    return check_meshes(thicken_supports(parts, named))


def read_surfaces(path: str | Path) -> list[PartSurface]:
    """Read the surfaces of all parts, unchecked, each with a name of its own.

    A folder holds one file a part (OBJ, STL, PLY, glTF). Names that are all numbers are the ids of the parts, which are
    put in that order, with a warning if there are gaps; other names are put in natural order. A single file holds one
    object a part, in the order of the file or of ids; separate solids are parts of their own. Files whose names begin
    with a dot are not looked at. glTF is read as its standard has it, y up, and turned to z up.

    Returns:
        At least one; those of a file in a folder that cannot be read have an `error`.

    Raises:
        InputError: no such path, nothing to read in it, or ids doubled.
        MeshError: a single file that cannot be read.
    """
    source = Path(path)
    if not source.exists():
        raise InputError(f"there is no {source}; give a folder of meshes or a file with one object per part")
    if source.is_dir():
        files = _files(source)
        if len(files) > 1:
            order = _order([file.stem for file in files], source)
            return [_one_part(files[index]) for index in order]
        source = files[0]
    elif source.suffix.lower() not in _READERS:
        raise InputError(f"cannot read {source}; meshes are {', '.join(SUFFIXES)}")
    surfaces = _read(source)
    numbered = all(surface.number is not None for surface in surfaces)  # and in that order already
    if len(surfaces) > 1 and not numbered and all(surface.name.isdecimal() for surface in surfaces):
        surfaces = [surfaces[index] for index in _order([surface.name for surface in surfaces], source)]
    surfaces = separated(source, surfaces)
    names = distinct_names(source, [surface.name for surface in surfaces])
    return [replace(surface, name=name) for surface, name in zip(surfaces, names, strict=True)]


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which `part-10` follows `part-9`."""
    return tuple(
        (0, int(piece), "") if piece.isdecimal() else (1, 0, piece) for piece in re.split(r"(\d+)", name) if piece
    )


def _files(folder: Path) -> list[Path]:
    """Return the mesh files in a folder, at least one, and warn of other files and folders that may hold parts.

    Raises:
        InputError: there is none, or an entry with the name of one that is none, such as a link that leads nowhere.
    """
    entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    named = [entry for entry in entries if entry.suffix.lower() in _READERS]
    for entry in named:
        if not entry.is_file():
            what = "a folder" if entry.is_dir() else "a link that leads nowhere" if entry.is_symlink() else "no file"
            raise InputError(f"{entry} is {what}, not the mesh of a part; replace it or take it out of {folder}")
    if not named:
        if (folder / "run.json").is_file():
            raise InputError(f"{folder} is a run of falsework train, and no structure; name the one that it is of")
        raise InputError(f"no mesh in {folder}; put one file per part there ({', '.join(SUFFIXES)})")
    others = [entry.name for entry in entries if entry not in named and entry.is_file() and _may_hold_parts(entry)]
    others += [f"{entry.name}/" for entry in entries if entry.is_dir() and _has_meshes(entry)]
    if others:
        warn_of(folder, f"files of other formats and folders in it were left out: {listed(others)}")
    return named


def _may_hold_parts(file: Path) -> bool:
    """Return whether the name of a file is that of a model, of a packed file, or of a copy such as `1.obj.bak`."""
    return any(suffix.lower().rstrip("~") in {*_READERS, *_MODELS, *_PACKED} for suffix in file.suffixes)


def _has_meshes(folder: Path) -> bool:
    """Return whether there are meshes in a folder or in those below it, as far as it is looked at."""
    for below in islice(folder.rglob("*"), _LOOKED_AT):
        within = below.relative_to(folder).parts
        if below.suffix.lower() in _READERS and not any(part.startswith(".") for part in within):
            return True
    return False


def _order(names: Sequence[str], where: Path) -> list[int]:
    """Return the order of parts by id where all names are numbers, else in natural order; each name once."""
    if all(name.isdecimal() for name in names):
        ids = [int(name) for name in names]
        order = sorted(range(len(ids)), key=ids.__getitem__)
        for one, two in pairwise(order):
            if ids[one] == ids[two]:
                count = ids.count(ids[one])
                raise InputError(f"part {ids[one]} occurs {count} times in {where}; give every id once")
        missing = next((number for number, index in enumerate(order) if ids[index] != number), None)
        if missing is not None:
            warn_of(
                where,
                f"there is no part {missing}: the {len(ids)} parts are numbered from 0 to {len(ids) - 1} in the order "
                "of their ids, which are their names",
            )
        return order
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"part {name!r} occurs {names.count(name)} times in {where}; give every name once")
    return sorted(range(len(names)), key=lambda index: natural_key(names[index]))


def _one_part(file: Path) -> PartSurface:
    """Return all objects of a file as one part; one without faces and with the reason if it cannot be read."""
    try:
        return replace(joined(file.stem, _read(file)), whole=True)
    except MeshError as error:
        return PartSurface(file.stem, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), error=str(error))


def _read(file: Path) -> list[PartSurface]:
    """Return the objects of a file, at least one."""
    surfaces = _READERS[file.suffix.lower()](file)
    if not surfaces:
        raise MeshError(f"no mesh in {file}; export the parts as triangles")
    return surfaces
