"""Shapes of COMPAS, which have sizes and a frame, as vertices and faces."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import points_of
from falsework.utils.quantity import is_number

CURVED = ("Cylinder", "Cone", "Sphere", "Capsule", "Torus")
"""Shapes of revolution about the z axis of their frame."""
_STEPS = 72
"""Flat faces around a shape of revolution: 5 degrees each."""
_SIZES = ("xsize", "ysize", "zsize", "radius", "height", "radius_axis", "radius_pipe")


def inner(data: dict[str, Any]) -> dict[str, Any]:
    """Return the content of an object that may or may not be wrapped with the name of its class."""
    return data.get("data", data)


def shape_mesh(shape: str, content: dict[str, Any]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return vertices, shape (vertices, 3), and triangles of a box or a shape of revolution.

    All vertices are on its surface.
    """
    from trimesh import creation

    size = {name: float(content[name]) for name in _SIZES if name in content}
    if not all(is_number(content[name]) for name in size):
        raise ValueError("a size is not a number")
    if shape == "Box":
        mesh = creation.box((size["xsize"], size["ysize"], size["zsize"]))
    elif shape == "Cylinder":
        mesh = creation.cylinder(size["radius"], size["height"], sections=_STEPS)
    elif shape == "Cone":
        mesh = creation.cone(size["radius"], size["height"], sections=_STEPS)
    elif shape == "Capsule":
        mesh = creation.capsule(size["height"], size["radius"], count=(_STEPS // 2, _STEPS))
    elif shape == "Torus":
        mesh = creation.torus(size["radius_axis"], size["radius_pipe"], _STEPS, _STEPS)
    else:
        up = np.pi / 2 * np.linspace(-1, 1, _STEPS // 2 + 1)
        profile = size["radius"] * np.stack([np.cos(up), np.sin(up)], axis=1)
        profile[[0, -1], 0] = 0.0
        mesh = creation.revolve(profile, sections=_STEPS)
    return _in_frame(mesh.vertices, content), mesh.faces.tolist()


def _in_frame(points: NDArray[np.float64], content: dict[str, Any]) -> NDArray[np.float64]:
    """Return points of the frame of a shape in space, shape (points, 3)."""
    frame = inner(content["frame"])
    x, y, origin = points_of(frame[name] for name in ("xaxis", "yaxis", "point"))
    z = np.cross(x, y)
    x, z = (axis / np.linalg.norm(axis) for axis in (x, z))  # as COMPAS does, whatever the axes in the file
    if not np.isfinite([x, z]).all():
        raise ValueError("a frame has no axes")
    return points @ np.stack([x, np.cross(z, x), z]) + origin
