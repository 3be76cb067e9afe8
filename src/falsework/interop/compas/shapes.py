"""Meshes and shapes of COMPAS, which have sizes and a frame, as vertices and faces."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from falsework.interop.compas import compas_model as model
from falsework.interop.compas.compas_item import CompasItem
from falsework.utils.models import shown

SHAPES: dict[str, type[Any]] = {
    "Box": model.CompasBox,
    "Cylinder": model.CompasLong,
    "Cone": model.CompasLong,
    "Sphere": model.CompasRound,
    "Capsule": model.CompasLong,
    "Torus": model.CompasTorus,
}
"""Models by the names of classes; all but the box are of revolution about the z axis of their frame."""
_STEPS = 72
"""Flat faces around a shape of revolution: 5 degrees each."""


def mesh_of(content: CompasItem) -> tuple[list[list[float]], list[list[int]]]:
    """Return the vertices and faces of the data of a `Mesh`."""
    mesh = content.read(model.CompasHalfEdgeMesh)
    default = mesh.default_vertex_attributes or model.CompasCorner()
    base = [0.0 if value is UNSET else value for value in (default.x, default.y, default.z)]
    points = [
        [base[axis] if value is UNSET else value for axis, value in enumerate((corner.x, corner.y, corner.z))]
        for corner in mesh.vertex.values()
    ]
    order = {key: row for row, key in enumerate(mesh.vertex)}
    for key, face in mesh.face.items():
        lost = next((corner for corner in face if str(corner) not in order), None)
        if lost is not None:
            where = content.at("face", key).where
            content.fail(f"{where} uses the vertex {shown(lost)}, which does not exist")
    return points, [[order[str(corner)] for corner in face] for face in mesh.face.values()]


def shape_mesh(shape: str, content: CompasItem) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return vertices, shape (vertices, 3), and triangles of a box or a shape of revolution.

    All vertices are on its surface.

    Args:
        shape: name of its class, of `SHAPES`.
    """
    from trimesh import creation

    size = content.read(SHAPES[shape])
    if shape == "Box":
        mesh = creation.box((size.xsize, size.ysize, size.zsize))
    elif shape == "Cylinder":
        mesh = creation.cylinder(size.radius, size.height, sections=_STEPS)
    elif shape == "Cone":
        mesh = creation.cone(size.radius, size.height, sections=_STEPS)
    elif shape == "Capsule":
        mesh = creation.capsule(size.height, size.radius, count=(_STEPS // 2, _STEPS))
    elif shape == "Torus":
        mesh = creation.torus(size.radius_axis, size.radius_pipe, _STEPS, _STEPS)
    else:
        up = np.pi / 2 * np.linspace(-1, 1, _STEPS // 2 + 1)
        profile = size.radius * np.stack([np.cos(up), np.sin(up)], axis=1)
        profile[[0, -1], 0] = 0.0
        mesh = creation.revolve(profile, sections=_STEPS)
    return _in_frame(mesh.vertices, content.at("frame").opened()), mesh.faces.tolist()


def _in_frame(points: NDArray[np.float64], content: CompasItem) -> NDArray[np.float64]:
    """Return points of the frame of a shape in space, shape (points, 3)."""
    frame = content.read(model.CompasFrame)
    x, y, origin = map(np.array, (frame.xaxis, frame.yaxis, frame.point))
    z = np.cross(x, y)
    lengths = np.linalg.norm(x), np.linalg.norm(z)
    if not all(0 < length < np.inf for length in lengths):
        content.fail(f"the axes of {content.where} span no plane", "give two that do")
    x, z = x / lengths[0], z / lengths[1]  # as COMPAS does, whatever the axes in the file
    return points @ np.stack([x, np.cross(z, x), z]) + origin
