"""Conversion of Rhino geometry to blocks.

Geometry is recognised by the name of its class, so that this module needs Rhino only to mesh a Brep.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from falsework_client.blocks import Block
from falsework_client.errors import ClientError

UNIT_SYSTEMS = {
    "Meters": "m",
    "Decimeters": "dm",
    "Centimeters": "cm",
    "Millimeters": "mm",
    "Inches": "in",
    "Feet": "ft",
}
"""Unit of falsework for a `Rhino.UnitSystem`."""

Vertices = list[tuple[float, float, float]]
Faces = list[tuple[int, ...]]


def unit_of(document: Any) -> str:
    """Return the unit of a Rhino document.

    Raises:
        ClientError: a unit that falsework does not know.
    """
    system = str(document.ModelUnitSystem)
    if system not in UNIT_SYSTEMS:
        raise ClientError(
            f"the document is in {system}, an unknown unit; choose {', '.join(UNIT_SYSTEMS)} with the command Units"
        )
    return UNIT_SYSTEMS[system]


def blocks_of(blocks: Sequence[Any] | None, supports: Sequence[Any] | None = None) -> list[Block]:
    """Return Rhino geometry as blocks, the supports after the others.

    Args:
        blocks: meshes, Breps, extrusions, boxes or SubDs, each one closed.
        supports: the same for what is fixed for ever.

    Raises:
        ClientError: something that is not a solid, or that has no faces.
    """
    converted = []
    for support, items in ((False, blocks or ()), (True, supports or ())):
        for number, item in enumerate(items):
            try:
                vertices, faces = mesh_of(item)
            except ClientError as error:
                raise ClientError(f"{'support' if support else 'block'} {number} {error}") from None
            converted.append(Block(vertices, faces, support=support))
    return converted


def mesh_of(item: Any) -> tuple[Vertices, Faces]:
    """Return vertices and faces of one solid; a Brep is meshed as Rhino renders it.

    Raises:
        ClientError: not a solid, or without faces; the message lacks the subject.
    """
    kind = type(item).__name__
    if kind == "Mesh":
        vertices, faces = _join([item])
    elif kind in ("Brep", "Extrusion", "Box", "SubD"):
        vertices, faces = _join(_mesh_brep(item if kind == "Brep" else item.ToBrep()))
    elif item is None:
        raise ClientError("is empty; take it off the list, or reference its geometry again")
    else:
        raise ClientError(f"is a {kind}; give a closed mesh, Brep, extrusion, box or SubD")
    if not faces:
        raise ClientError("has no faces; give a closed mesh or solid")
    return vertices, faces


def _mesh_brep(brep: Any) -> list[Any]:
    from Rhino.Geometry import Mesh, MeshingParameters

    return list((brep and Mesh.CreateFromBrep(brep, MeshingParameters.QualityRenderMesh)) or ())


def _join(meshes: Iterable[Any]) -> tuple[Vertices, Faces]:
    """Return meshes as one; vertices at the same place, such as along the edges of a Brep, become one."""
    places: dict[tuple[float, float, float], int] = {}
    faces: Faces = []
    for mesh in meshes:
        # Iteration over the vertices of a mesh gives single precision.
        points = [(float(point.X), float(point.Y), float(point.Z)) for point in mesh.Vertices.ToPoint3dArray()]
        numbers = [places.setdefault(point, len(places)) for point in points]
        for face in mesh.Faces:
            corners = [face.A, face.B, face.C, face.D] if face.IsQuad else [face.A, face.B, face.C]
            # Vertices that became one leave a corner out of a face, at a pole for instance.
            ring = tuple(dict.fromkeys(numbers[corner] for corner in corners))
            if len(ring) > 2:
                faces.append(ring)
    return list(places), faces
