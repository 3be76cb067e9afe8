"""Reader of STEP files: one part a solid, with curved faces cut into triangles."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from falsework.assembly.draft import Block, Draft
from falsework.assembly.model import Assembly
from falsework.errors import DependencyError, InputError
from falsework.geometry.mesh.surface import warn_of, warn_of_curves
from falsework.interop.apart import read_apart

_MILLIMETRE = 1e-3
"""Unit to which Open CASCADE converts coordinates, in metres."""
_DEFLECTION = 1e-3
"""Largest distance of triangles from a curved face, as a share of the face's edges."""
_ANGLE = np.radians(5)
"""Largest angle between neighbouring triangles of a curved face."""


def is_step(path: Path | str) -> bool:
    """Return whether a path is a file that looks like a STEP model, by its name."""
    path = Path(path)
    return path.suffix.lower() in (".step", ".stp") and path.is_file()


def load_step(path: Path | str, *, unit: str | None = None, **options: Any) -> Assembly:
    """Read an assembly from a STEP file: a part for every solid, in the order of the file.

    Args:
        path: the file.
        unit: may not be given, since the file says it.
        options: density, friction, boundary, ground and contact_settings, as for `load_assembly`.

    Raises:
        DependencyError: cadquery-ocp is not installed.
        InputError: no STEP file, no solid in it, or a unit.
        MeshError: a part that does not bound a solid.
        AssemblyError: the parts make no assembly.
    """
    return read_step(path, unit=unit).assemble(**options)


def read_step(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the solids of a STEP file, unchecked.

    Args:
        path: the file.
        unit: may not be given, since the file says it.

    Raises:
        DependencyError: cadquery-ocp is not installed.
        InputError: no STEP file, no solid in it, or a unit.
    """
    path = Path(path)
    if unit is not None:
        raise InputError(f"{path} is a STEP file and says its unit; leave out --unit")
    return read_apart(_read, path, library="Open CASCADE")


def _read(path: Path) -> Draft:
    """Read the solids of a STEP file in this process, which Open CASCADE may end when the file is damaged."""
    try:
        from OCP.BRepMesh import BRepMesh_IncrementalMesh
        from OCP.IFSelect import IFSelect_RetDone
        from OCP.STEPControl import STEPControl_Reader
        from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_SOLID
        from OCP.TopExp import TopExp_Explorer
    except ImportError:
        raise DependencyError("STEP files need cadquery-ocp; pip install 'falsework[step]'") from None
    reader = STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_RetDone:
        raise InputError(f"{path} is not a STEP file, or is damaged; export it again")
    reader.TransferRoots()
    shape = reader.OneShape()
    blocks: list[Block] = []
    curved: list[str] = []
    if not shape.IsNull():
        BRepMesh_IncrementalMesh(shape, _DEFLECTION, True, float(_ANGLE), False)
        explorer = TopExp_Explorer(shape, TopAbs_SOLID)
        while explorer.More():
            block, bent = _block(reader, explorer.Current())
            curved += [block.name or str(len(blocks))] if bent else []
            blocks.append(block)
            explorer.Next()
    if not blocks:
        raise InputError(f"{path} has no solid; export the parts as solids, not as surfaces")
    for kind, within, what in ((TopAbs_FACE, TopAbs_SOLID, "surfaces"), (TopAbs_EDGE, TopAbs_FACE, "curves")):
        explorer, count = TopExp_Explorer(shape, kind, within), 0
        while explorer.More():
            count += 1
            explorer.Next()
        if count:
            warn_of(path, f"{what} that bound no solid were left out: {count}")
    hidden = len(re.findall(rb"=\s*INVISIBILITY\s*\(", path.read_bytes()))
    if hidden:
        warn_of(path, f"it hides objects ({hidden} lists), which were read as well; leave them out of the export")
    warn_of_curves(path, curved)
    return Draft.of(path, _MILLIMETRE, blocks)


def _block(reader: Any, solid: Any) -> tuple[Block, bool]:
    """Return the triangles of a solid, and whether it has curved faces."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.GeomAbs import GeomAbs_Plane
    from OCP.StepRepr import StepRepr_RepresentationItem
    from OCP.TopAbs import TopAbs_FACE, TopAbs_REVERSED
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    vertices, faces, bent = [], [], False
    explorer = TopExp_Explorer(solid, TopAbs_FACE)
    while explorer.More():
        face = TopoDS.Face(explorer.Current())
        bent = bent or BRepAdaptor_Surface(face).GetType() != GeomAbs_Plane
        location = TopLoc_Location()
        triangles = BRep_Tool.Triangulation_s(face, location)
        if triangles is not None:
            first, place = len(vertices) - 1, location.Transformation()
            points = (triangles.Node(row + 1).Transformed(place) for row in range(triangles.NbNodes()))
            vertices += [(point.X(), point.Y(), point.Z()) for point in points]
            for row in range(triangles.NbTriangles()):
                corners = [first + corner for corner in triangles.Triangle(row + 1).Get()]
                faces.append(corners[::-1] if face.Orientation() == TopAbs_REVERSED else corners)
        explorer.Next()
    item = reader.WS().TransferReader().EntityFromShapeResult(solid, 1)
    name = item.Name().ToCString() if isinstance(item, StepRepr_RepresentationItem) else ""
    return Block(name, np.array(vertices, dtype=float).reshape(-1, 3), faces), bent
