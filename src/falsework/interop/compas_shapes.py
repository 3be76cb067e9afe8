"""Shapes of COMPAS, which have sizes and a frame, as vertices and faces."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

CURVED = ("Cylinder", "Cone", "Sphere", "Capsule", "Torus")
"""Shapes of revolution about the z axis of their frame."""
_STEPS = 72
"""Flat faces around a shape of revolution: 5 degrees each."""
_BOX_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def inner(data: dict[str, Any]) -> dict[str, Any]:
    """Return the content of an object that may or may not be wrapped with the name of its class."""
    return data.get("data", data)


def box(content: dict[str, Any]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return vertices, shape (8, 3), and faces of a box."""
    size = np.array([content["xsize"], content["ysize"], content["zsize"]], dtype=float) / 2
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * size
    return _in_frame(corners, content), [list(face) for face in _BOX_FACES]


def _in_frame(points: NDArray[np.float64], content: dict[str, Any]) -> NDArray[np.float64]:
    """Return points of the frame of a shape in space, shape (points, 3)."""
    frame = inner(content["frame"])
    x, y = (np.array(frame[axis], dtype=float) for axis in ("xaxis", "yaxis"))
    z = np.cross(x, y)
    x, z = (axis / np.linalg.norm(axis) for axis in (x, z))  # as COMPAS does, whatever the axes in the file
    if not np.isfinite([x, z]).all():
        raise ValueError("a frame has no axes")
    return points @ np.stack([x, np.cross(z, x), z]) + np.array(frame["point"], dtype=float)


def revolved(shape: str, content: dict[str, Any]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return vertices and faces of a shape of revolution; all vertices are on its surface."""
    around = 2 * np.pi / _STEPS * np.arange(_STEPS)
    if shape == "Torus":
        axis, pipe = float(content["radius_axis"]), float(content["radius_pipe"])
        profile = np.stack([axis + pipe * np.cos(around), pipe * np.sin(around)], axis=1)
    else:
        radius = float(content["radius"])
        half = 0.0 if shape == "Sphere" else float(content["height"]) / 2
        if shape == "Cylinder":
            profile = np.array([(0, -half), (radius, -half), (radius, half), (0, half)])
        elif shape == "Cone":
            profile = np.array([(0, 0), (radius, 0), (0, 2 * half)])
        else:
            up = np.pi / 2 * np.linspace(-1, 1, _STEPS // 2 + 1)
            up = up if shape == "Sphere" else np.sort(np.append(up, 0.0))
            rise = np.where(np.arange(len(up)) < len(up) // 2, -half, half)
            profile = np.stack([radius * np.cos(up), radius * np.sin(up) + (0 if shape == "Sphere" else rise)], axis=1)
            profile[[0, -1], 0] = 0.0
    turns = np.stack([np.cos(around), np.sin(around)], axis=1)
    points = np.concatenate(
        [profile[:, None, :1] * turns[None], np.broadcast_to(profile[:, None, 1:], (len(profile), _STEPS, 1))], axis=2
    ).reshape(-1, 3)
    rings = range(len(profile)) if shape == "Torus" else range(len(profile) - 1)
    faces = []
    for ring in rings:
        for step in range(_STEPS):
            low, high = ring * _STEPS, (ring + 1) % len(profile) * _STEPS
            one, two = step, (step + 1) % _STEPS
            corners = [low + one, low + two, high + two, high + one]
            if profile[ring, 0] == 0:
                corners = corners[1:]
            elif profile[(ring + 1) % len(profile), 0] == 0:
                corners = corners[:3]
            faces.append(corners)
    return _in_frame(points, content), faces
