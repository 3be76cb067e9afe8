"""Reader of STEP files: one part a solid, with curved faces cut into triangles."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falsework.assembly.draft import Block, Draft
from falsework.errors import InputError
from falsework.geometry.mesh.surface import warn_of, warn_of_curves
from falsework.utils.child_process import read_apart
from falsework.utils.files.formats import Reader
from falsework.utils.files.input_file import read_content
from falsework.utils.lazy import importing

_MILLIMETRE = 1e-3
"""Unit to which Open CASCADE converts coordinates, in metres."""
_DEFLECTION = 1e-3
"""Largest distance of triangles from a curved face, as a share of the face's edges."""
_ANGLE = np.radians(5)
"""Largest angle between neighbouring triangles of a curved face."""
_NAMELESS = "Open CASCADE STEP translator"
"""Beginning of the names that Open CASCADE gives products without one."""


def read_step(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the solids of a STEP file, unchecked: a part for every solid, in the order of the file.

    A part has the name of its solid, or where several solids have that name, or none, the name of its occurrence in an
    assembly or of its product.
    """
    path = Path(path)
    if unit is not None:
        raise InputError(f"{path} is a STEP file and says its unit; leave out --unit")
    return read_apart(_read, path, library="Open CASCADE")


def _read(path: Path) -> Draft:
    """Read the solids of a STEP file in this process, which Open CASCADE may end when the file is damaged."""
    with importing("STEP files need cadquery-ocp; pip install 'falsework[step]'"):
        from OCP.BRepMesh import BRepMesh_IncrementalMesh
        from OCP.IFSelect import IFSelect_RetDone
        from OCP.STEPControl import STEPControl_Reader
        from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_SOLID
    reader = STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_RetDone:
        raise InputError(f"{path} is not a STEP file, or is damaged; export it again")
    reader.TransferRoots()
    shape = reader.OneShape()
    blocks: list[Block] = []
    curved: list[int] = []
    places: list[str] = []
    if not shape.IsNull():
        products = _Products(reader)
        BRepMesh_IncrementalMesh(shape, _DEFLECTION, True, float(_ANGLE), False)
        for solid in _shapes_in(shape, TopAbs_SOLID):
            block, bent = _block(solid)
            own, place = products.names(solid)
            curved += [len(blocks)] if bent else []
            blocks.append(replace(block, name=own))
            places.append(place)
    if not blocks:
        raise InputError(f"{path} has no solid; export the parts as solids, not as surfaces")
    # Programs call the bodies of many parts alike; their places in the assembly tell them apart.
    uses = Counter(block.name for block in blocks)
    blocks = [
        replace(block, name=place) if place and (not block.name or uses[block.name] > 1) else block
        for block, place in zip(blocks, places, strict=True)
    ]
    for kind, within, what in ((TopAbs_FACE, TopAbs_SOLID, "surfaces"), (TopAbs_EDGE, TopAbs_FACE, "curves")):
        if count := sum(1 for _ in _shapes_in(shape, kind, within)):
            warn_of(path, f"{what} that bound no solid were left out: {count}")
    hidden = len(re.findall(rb"=\s*INVISIBILITY\s*\(", read_content(path)))
    if hidden:
        warn_of(path, f"it hides objects ({hidden} lists), which were read as well; leave them out of the export")
    warn_of_curves(path, [blocks[number].name or str(number) for number in curved])
    return Draft.from_blocks(path, _MILLIMETRE, blocks)


class _Products:
    """Names of the solids of a file: their own, and those of their parts in an assembly."""

    def __init__(self, reader: Any) -> None:
        self._transfer = reader.WS().TransferReader()
        self._items: list[Any] = []  # kept, since entities are told apart by their `id`
        self._name_of: dict[int, str] = {}
        model = reader.WS().Model()
        entities = [model.Value(number + 1) for number in range(model.NbEntities())]
        shown: dict[int, str] = {}
        for entity in entities:
            if type(entity).__name__ == "StepShape_ShapeDefinitionRepresentation":
                product = entity.Definition().PropertyDefinition().Definition().ProductDefinition()
                if product is not None:
                    self._keep(entity.UsedRepresentation(), _name_of_product(product), shown)
        for entity in entities:  # programs also give the solids in a shape of their own, equal to that of the product
            if type(entity).__name__ == "StepRepr_ShapeRepresentationRelationship":
                ends = entity.Rep1(), entity.Rep2()
                for one, other in (ends, ends[::-1]):
                    if id(one) in shown and id(other) not in shown:
                        self._keep(other, shown[id(one)], shown)

    def _keep(self, shape: Any, name: str, shown: dict[int, str]) -> None:
        self._items.append(shape)
        shown[id(shape)] = name
        for number in range(shape.NbItems()):
            item = shape.ItemsValue(number + 1)
            self._items.append(item)
            self._name_of[id(item)] = name

    def names(self, solid: Any) -> tuple[str, str]:
        """Return the name of a solid, and that of its occurrence in an assembly or of its product; empty for none."""
        from OCP.StepRepr import StepRepr_NextAssemblyUsageOccurrence, StepRepr_RepresentationItem
        from OCP.TopLoc import TopLoc_Location

        here, alone = (
            self._transfer.EntityFromShapeResult(shape, 1) for shape in (solid, solid.Located(TopLoc_Location()))
        )
        items = [entity for entity in (alone, here) if isinstance(entity, StepRepr_RepresentationItem)]
        own = next((name for item in items if (name := item.Name().ToCString())), "")
        if isinstance(here, StepRepr_NextAssemblyUsageOccurrence):
            return own, here.Name().ToCString() or _name_of_product(here.RelatedProductDefinition())
        return own, next((self._name_of[id(item)] for item in items if id(item) in self._name_of), "")


def _name_of_product(definition: Any) -> str:
    """Return the name of the product of a definition; empty if the writer made it up."""
    name = definition.Formation().OfProduct().Name().ToCString()
    return "" if name.startswith(_NAMELESS) else name


def _shapes_in(shape: Any, *kinds: Any) -> Iterator[Any]:
    """Yield the shapes of a kind in a shape, without those within shapes of a second kind."""
    from OCP.TopExp import TopExp_Explorer

    explorer = TopExp_Explorer(shape, *kinds)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _block(solid: Any) -> tuple[Block, bool]:
    """Return the triangles of a solid, without a name, and whether it has curved faces."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.GeomAbs import GeomAbs_Plane
    from OCP.TopAbs import TopAbs_FACE, TopAbs_REVERSED
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS

    vertices, faces, bent = [], [], False
    for shape in _shapes_in(solid, TopAbs_FACE):
        face = TopoDS.Face(shape)
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
    return Block("", np.array(vertices, dtype=float).reshape(-1, 3), faces), bent


READER = Reader((".step", ".stp"), parts=read_step)
