"""Reader of Rhino files (.3dm): meshes, extrusions and Breps with render meshes, by layers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.draft import Block, Draft
from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.polygon import triangles_of
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.sheets import is_flat, is_sheet
from falsework.geometry.mesh.surface import PartSurface, separated, warn_of, warn_of_curves
from falsework.utils.child_process import read_apart
from falsework.utils.files.formats import Reader
from falsework.utils.lazy import importing

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
_SUPPORTS = frozenset({"supports", "boundary"})
"""Layers whose parts are boundary, in small letters."""
_MESHED = ("Mesh", "Brep", "Extrusion", "SubD")
"""Objects that are read as their meshes."""
_DEEPEST = 32
"""Levels of blocks in blocks."""


def read_rhino(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the parts of a Rhino file, unchecked.

    Parts are meshes, and Breps and extrusions with the meshes that Rhino stored for display; instances of blocks are
    resolved. Separate solids of one object are parts of their own. Those on a layer `Supports` or `Boundary` are
    boundary. If a layer `Blocks` holds any, the parts are those on `Blocks` and the layers of supports; otherwise
    those on all layers. Sublayers count as their layers. Surfaces among supports are given a thickness. What is hidden,
    on a layer that is hidden, in a layout or on a layer `Interfaces`, other surfaces, curves and points are left out.
    A warning names each.

    Args:
        unit: unit of the coordinates; that of the file if not given.
    """
    with importing("Rhino files need rhino3dm; pip install 'falsework[rhino]'"):
        import rhino3dm  # noqa: F401 - imported by the other process
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
    layers = _Layers(model)
    objects = [entry for entry in cast("Any", model.Objects) if not entry.Attributes.IsInstanceDefinitionObject]
    found: list[tuple[set[str], Block]] = []
    left_out: dict[str, Counter[str]] = {}
    curved: list[str] = []
    if objects and all(_is_hidden(entry.Attributes, layers) for entry in objects):
        warn_of(path, "all objects are hidden; they were read as if they were visible")
        layers.hide_nothing = True
    for entry in objects:
        for solid in _solids(path, model, layers, entry, np.eye(4), frozenset()):
            if solid.why:
                left_out.setdefault(solid.why, Counter())[solid.layer] += 1
                continue
            faces = triangles_of(f"object {solid.name or '?'} of {path}", solid.vertices, solid.faces)
            support = bool(solid.words & _SUPPORTS)
            sheet = support and len(faces) > 0 and is_sheet(solid.vertices, faces)
            if (len(faces) < 4 or is_flat(solid.vertices, _FLAT)) and not sheet:
                left_out.setdefault("surfaces that are not solids", Counter())[solid.layer] += 1
                continue
            if solid.curved:
                curved.append(solid.name or f"on layer {solid.layer}")
            for part in separated(path, [PartSurface(solid.name, solid.vertices, faces)]):
                found.append((set(solid.words), Block(part.name, part.vertices, part.faces, support=support)))
    if any("blocks" in words for words, _ in found):
        others = [words for words, _ in found if not words & {"blocks", *_SUPPORTS}]
        if others:
            left_out["parts beside the layer Blocks"] = Counter("other layers" for _ in others)
        found = [(words, block) for words, block in found if words & {"blocks", *_SUPPORTS}]
    if not found:
        raise InputError(f"{path} has no mesh or solid; make meshes of the parts in Rhino (Mesh) and save it again")
    for why, where in left_out.items():
        warn_of(path, f"{why} were left out: {', '.join(f'{count} on {layer}' for layer, count in where.items())}")
    warn_of_curves(path, curved)
    return Draft.from_blocks(path, scale, [block for _, block in found])


class _Layers:
    """Names and visibility of the layers of a model."""

    def __init__(self, model: Any) -> None:
        self._by_index = {layer.Index: layer for layer in model.Layers}
        self._by_id = {str(layer.Id): layer for layer in model.Layers}
        self.hide_nothing = False

    def path(self, index: int) -> str:
        """Return the name of a layer with those that it is in."""
        layer = self._by_index.get(index)
        return "?" if layer is None else layer.FullPath

    def visible(self, index: int) -> bool:
        """Return whether a layer and all that it is in are visible."""
        layer = self._by_index.get(index)
        for _ in range(len(self._by_id)):
            if layer is None:
                return True
            if not layer.Visible:
                return False
            layer = self._by_id.get(str(layer.ParentLayerId))
        return True


def _check_instances(path: Path, model: Any) -> None:
    """Count what the instances of blocks grow to before any is read, since blocks in blocks double and double again."""
    sizes: dict[str, int] = {}

    def size(entry: Any, within: tuple[str, ...]) -> int:
        kind = type(entry.Geometry).__name__
        if kind != "InstanceReference":
            meshes = _meshes(entry.Geometry, kind) if kind in _MESHED else ()
            return 1 + sum(len(mesh.Vertices) + len(mesh.Faces) for mesh in meshes if mesh is not None)
        block = str(entry.Geometry.ParentIdefId)
        if block in within or len(within) == _DEEPEST:
            raise InputError(f"{path} has blocks that contain themselves or nest too deeply; explode them in Rhino")
        if block not in sizes:
            members = _members(model, entry.Geometry)
            sizes[block] = 1 + sum(size(member, (*within, block)) for member in members)
        return sizes[block]

    objects: Any = model.Objects
    check_growth(path, sum(size(entry, ()) for entry in objects if not entry.Attributes.IsInstanceDefinitionObject))


def _members(model: Any, instance: Any) -> list[Any]:
    """Return the objects of the block of an instance; none where the block is in another file."""
    definition = model.InstanceDefinitions.FindId(instance.ParentIdefId)
    ids = [] if definition is None else definition.GetObjectIds()
    return [member for id in ids if (member := model.Objects.FindId(str(id))) is not None]


@dataclass(frozen=True, eq=False)
class _Solid:
    """Object of a model, in place."""

    name: str
    layer: str
    words: frozenset[str]
    """Names of its layers and of those of the instances that it is in, in small letters."""
    vertices: NDArray[np.float64]
    faces: list[list[int]]
    curved: bool = False
    why: str = ""
    """What is left out, if it is; the arrays are then empty."""


def _solids(
    path: Path, model: Any, layers: _Layers, entry: Any, place: NDArray[np.float64], within: frozenset[str]
) -> Iterator[_Solid]:
    """Yield an object, or all objects of an instance."""
    geometry, attributes = entry.Geometry, entry.Attributes
    name, layer, kind = attributes.Name or "", layers.path(attributes.LayerIndex), type(geometry).__name__
    words = within | {word.lower() for word in layer.split("::")}
    where = f"layer {layer}"

    def omitted(why: str) -> _Solid:
        return _Solid(name, where, words, np.zeros((0, 3)), [], why=why)

    if _is_hidden(attributes, layers):
        yield omitted("hidden objects")
    elif attributes.ActiveSpace.name == "PageSpace":
        yield omitted("objects in layouts")
    elif "interfaces" in words:
        yield omitted("surfaces that are not solids")
    elif kind == "InstanceReference":
        inner = place @ np.array(geometry.Xform.ToFloatArray(True), dtype=float).reshape(4, 4)
        members = _members(model, geometry)
        if not members:
            raise InputError(f"{path}: instance {name or attributes.Id} is of a block without objects; embed the block")
        solids = [solid for member in members for solid in _solids(path, model, layers, member, inner, words)]
        count = sum(not solid.why for solid in solids)
        for number, solid in enumerate(solids):
            label = name if count == 1 else f"{name}-{solid.name or number}" if name else ""
            yield replace(solid, name=label)
    elif kind in _MESHED:
        meshes = _meshes(geometry, kind)
        if any(mesh is None for mesh in meshes) or not meshes:
            raise InputError(
                f"{path}: {kind} {name or attributes.Id} has no render mesh; "
                "show it shaded in Rhino (or make a mesh of it) and save the file again"
            )
        yield _Solid(name, where, words, *_polygons(meshes, place), curved=_curved(geometry, kind))
    elif "Surface" in kind:
        if geometry.IsClosed(0) or geometry.IsClosed(1):
            raise InputError(f"{path}: {kind} {name or attributes.Id} has no render mesh; make a mesh of it in Rhino")
        yield omitted("surfaces that are not solids")
    else:
        yield omitted("curves, points, texts and the like")


def _is_hidden(attributes: Any, layers: _Layers) -> bool:
    """Return whether an object, or a layer that it is on, is hidden."""
    if layers.hide_nothing:
        return False
    shown = attributes.Visible and layers.visible(attributes.LayerIndex)
    return attributes.Mode.name == "Hidden" or not shown


def _polygons(meshes: list[Any], place: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return vertices and faces of meshes as one, in place."""
    vertices, faces = [], []
    for mesh in meshes:
        first = len(vertices)
        points = (mesh.Vertices.Point3dAt(row) for row in range(len(mesh.Vertices)))
        vertices += [(point.X, point.Y, point.Z) for point in points]
        for row in range(len(mesh.Faces)):
            corners = [first + corner for corner in mesh.Faces[row]]
            faces.append(corners[:3] if corners[2] == corners[3] else corners)
    points = apply(place, np.array(vertices, dtype=float).reshape(-1, 3))
    if np.linalg.det(place[:3, :3]) < 0:
        faces = [face[::-1] for face in faces]
    return points, faces


def _curved(geometry: Any, kind: str) -> bool:
    """Return whether an object has faces of which its mesh makes flat ones."""
    if kind == "Brep":
        return any(not geometry.Faces[row].IsPlanar(_FLAT) for row in range(len(geometry.Faces)))
    return kind == "Extrusion" and any(
        not geometry.Profile3d(row, 0.0).IsPolyline() for row in range(geometry.ProfileCount)
    )


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


READER = Reader((".3dm",), parts=read_rhino)
