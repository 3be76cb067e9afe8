"""Reader of Rhino files (.3dm): meshes, extrusions and Breps with render meshes, by layers."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.draft import Block, Draft
from falsework.assembly.model import Assembly
from falsework.errors import DependencyError, InputError
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.repair import RepairWarning
from falsework.geometry.mesh.sheets import is_sheet
from falsework.interop.apart import read_apart

_UNITS = {
    "Microns": 1e-6,
    "Millimeters": 1e-3,
    "Centimeters": 1e-2,
    "Decimeters": 0.1,
    "Meters": 1.0,
    "Kilometers": 1000.0,
    "Mils": 2.54e-5,
    "Inches": 0.0254,
    "Feet": 0.3048,
    "Yards": 0.9144,
}
"""Lengths of Rhino's units in metres."""
_FLAT = 1e-6
"""Thickness, as a share of its size, below which an object is a sheet and no part."""
_DEEPEST = 32
"""Levels of blocks in blocks."""


def is_rhino(path: Path | str) -> bool:
    """Return whether a path is a file that looks like a Rhino model, by its name."""
    path = Path(path)
    return path.suffix.lower() == ".3dm" and path.is_file()


def load_rhino(path: Path | str, *, unit: str | None = None, **options: Any) -> Assembly:
    """Read an assembly from a Rhino file.

    Parts are meshes, and Breps, extrusions and SubDs with the meshes that Rhino stored for display; instances of blocks
    are resolved. Those on a layer `Supports` are boundary. If a layer `Blocks` holds any, the parts are those on
    `Blocks` and `Supports`; otherwise those on all layers. Sublayers count as their layers. Surfaces on
    `Supports` are given a thickness; other surfaces, and what is on a layer `Interfaces`, are left out; both with a
    warning.

    Args:
        path: the file.
        unit: unit of the coordinates; that of the file if not given.
        options: density, friction, boundary, ground and contact_settings, as for `load_assembly`.

    Raises:
        DependencyError: rhino3dm is not installed.
        InputError: no Rhino file, no part in it, an object without a mesh, or a unit without a length.
        MeshError: a part that does not bound a solid.
        AssemblyError: the parts make no assembly.
    """
    return read_rhino(path, unit=unit).assemble(**options)


def read_rhino(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the parts of a Rhino file, unchecked.

    Args:
        path: the file.
        unit: unit of the coordinates; that of the file if not given.

    Raises:
        DependencyError: rhino3dm is not installed.
        InputError: no Rhino file, no part in it, an object without a mesh, or a unit without a length.
    """
    try:
        import rhino3dm  # noqa: F401 - imported by the other process
    except ImportError:
        raise DependencyError("Rhino files need rhino3dm; pip install 'falsework[rhino]'") from None
    return read_apart(_read, Path(path), unit, library="rhino3dm")


def _read(path: Path, unit: str | None) -> Draft:
    """Read a Rhino file in this process, which rhino3dm may hold up for minutes when the file is damaged."""
    import rhino3dm

    model = rhino3dm.File3dm.Read(str(path))
    if model is None:
        raise InputError(f"{path} is not a Rhino file, or is damaged; save it again in Rhino")
    _check_instances(path, model)
    system = model.Settings.ModelUnitSystem.name
    if unit is None and system not in _UNITS:
        raise InputError(f"{path} has the unit {system}, whose length is not known; name it, such as --unit mm")
    scale = _UNITS[system] if unit is None else unit_length(unit)
    table: Any = model.Layers  # the stubs of rhino3dm lag behind it
    layers = {layer.Index: layer.FullPath.split("::") for layer in table}
    found: list[tuple[set[str], Block]] = []
    left_out: Counter[str] = Counter()
    objects: Any = model.Objects
    for entry in objects:
        if entry.Attributes.IsInstanceDefinitionObject:
            continue
        folders = layers.get(entry.Attributes.LayerIndex, ["?"])
        for name, vertices, faces in _solids(path, model, entry, np.eye(4)):
            words = {folder.lower() for folder in folders}
            block = Block(name, vertices, faces, support="supports" in words)
            sheet = block.support and bool(faces) and is_sheet(*block.triangles(1.0)[1:])
            surface = (len(faces) < 4 or _is_flat(vertices)) and not sheet
            if surface or "interfaces" in words:
                left_out["::".join(folders)] += 1
            else:
                found.append((words, block))
    if any("blocks" in words for words, _ in found):
        found = [(words, block) for words, block in found if words & {"blocks", "supports"}]
    if not found:
        raise InputError(f"{path} has no mesh or solid; make meshes of the parts in Rhino (Mesh) and save it again")
    if left_out:
        where = ", ".join(f"{count} on layer {layer}" for layer, count in left_out.items())
        warnings.warn(f"{path}: surfaces that are not solids were left out: {where}", RepairWarning, stacklevel=2)
    return Draft.of(path, scale, [block for _, block in found])


def _check_instances(path: Path, model: Any) -> None:
    """Count what the instances of blocks grow to before any is read, since blocks in blocks double and double again.

    Raises:
        MeshError: more than a file of its size may grow to.
        InputError: a block that contains itself.
    """
    sizes: dict[str, int] = {}

    def size(entry: Any, within: tuple[str, ...]) -> int:
        geometry = entry.Geometry
        if type(geometry).__name__ != "InstanceReference":
            return 1 + (len(geometry.Vertices) + len(geometry.Faces) if type(geometry).__name__ == "Mesh" else 0)
        block = str(geometry.ParentIdefId)
        if block in within or len(within) == _DEEPEST:
            raise InputError(f"{path} has blocks that contain themselves or nest too deeply; explode them in Rhino")
        if block not in sizes:
            members = model.InstanceDefinitions.FindId(geometry.ParentIdefId).GetObjectIds()
            sizes[block] = 1 + sum(size(model.Objects.FindId(str(member)), (*within, block)) for member in members)
        return sizes[block]

    objects: Any = model.Objects
    check_growth(path, sum(size(entry, ()) for entry in objects if not entry.Attributes.IsInstanceDefinitionObject))


_Geometry = tuple[str, NDArray[np.float64], list[list[int]]]


def _solids(path: Path, model: Any, entry: Any, place: NDArray[np.float64]) -> Iterator[_Geometry]:
    """Yield name, vertices and faces of an object, or of all objects of an instance; none for curves and points."""
    geometry, name = entry.Geometry, entry.Attributes.Name or ""
    kind = type(geometry).__name__
    if kind == "InstanceReference":
        inner = place @ np.array(geometry.Xform.ToFloatArray(True), dtype=float).reshape(4, 4)
        definition = model.InstanceDefinitions.FindId(geometry.ParentIdefId)
        members = [model.Objects.FindId(str(member)) for member in definition.GetObjectIds()]
        solids = [solid for member in members for solid in _solids(path, model, member, inner)]
        for number, (own, vertices, faces) in enumerate(solids):
            label = name if len(solids) == 1 else f"{name}-{own or number}" if name else ""
            yield label, vertices, faces
        return
    if kind not in ("Mesh", "Brep", "Extrusion", "SubD"):
        return
    meshes = _meshes(geometry, kind)
    if any(mesh is None for mesh in meshes) or not meshes:
        raise InputError(
            f"{path}: {kind} {name or entry.Attributes.Id} has no render mesh; "
            "show it shaded in Rhino (or make a mesh of it) and save the file again"
        )
    vertices, faces = [], []
    for mesh in meshes:
        first = len(vertices)
        points = (mesh.Vertices.Point3dAt(row) for row in range(len(mesh.Vertices)))
        vertices += [(point.X, point.Y, point.Z) for point in points]
        for row in range(len(mesh.Faces)):
            corners = [first + corner for corner in mesh.Faces[row]]
            faces.append(corners[:3] if corners[2] == corners[3] else corners)
    points = np.array(vertices, dtype=float).reshape(-1, 3) @ place[:3, :3].T + place[:3, 3]
    if np.linalg.det(place[:3, :3]) < 0:
        faces = [face[::-1] for face in faces]
    yield name, points, faces


def _meshes(geometry: Any, kind: str) -> list[Any]:
    """Return the meshes of an object: itself, or those stored for display, None for one that is not there."""
    import rhino3dm

    if kind == "Mesh":
        return [geometry]
    if kind == "Brep":
        faces = [geometry.Faces[row] for row in range(len(geometry.Faces))]
        return [face.GetMesh(rhino3dm.MeshType.Any) for face in faces]
    if kind == "Extrusion":
        return [geometry.GetMesh(rhino3dm.MeshType.Any)]
    return [None]  # rhino3dm gives no mesh of a SubD


def _is_flat(points: NDArray[np.float64]) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= _FLAT * spread[0])
