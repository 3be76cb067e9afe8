"""Looks of arms: visual shapes of a URDF with their colours and places, for pages and pictures."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import CellError
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.mesh import TriangleMesh, joined_faces
from falsework.robots.cells.urdf import carrier_of, parse_urdf
from falsework.robots.cells.urdf_meshes import Color, colored_meshes, hull_mesh
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.kinematics.forward import link_poses
from falsework.robots.model.cell import CellRobot
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, Pieces

MOST_TRIANGLES = 12_000
"""Triangles of a visual mesh above which it is thinned out: pages send it to every browser."""
_FINEST, _COARSEST = 500, 30
"""Cubes along a mesh in which vertices become one."""
_GAPS = 0.03
"""Share of the edges of a visual mesh that may lack a neighbour for it to be drawn from outside only."""
PLAIN: Color = (0.80, 0.81, 0.83)
"""Colour of links whose description has none."""


@dataclass(frozen=True, eq=False)
class VisualShape:
    """Part of a link with one colour."""

    vertices: Array
    """In the frame of the link, metres, shape (vertices, 3)."""
    faces: NDArray[np.int64]
    """Shape (faces, 3)."""
    color: Color = PLAIN
    """Red, green, blue from 0 to 1."""


def link_visuals(model: RobotModel) -> tuple[tuple[VisualShape, ...], ...]:
    """Return what the links of an arm look like, base first.

    A link without visual shapes, and all of an arm that is built in, looks like its collision shapes.

    Warns:
        CellWarning: visual shapes that cannot be read; collision shapes stand in for them.
    """
    if model.source == "built-in":
        return tuple(shapes_of(pieces) for pieces in model.pieces)
    return _of_file(model)


def thinned(vertices: Array, faces: NDArray[np.int64], most: int = MOST_TRIANGLES) -> tuple[Array, NDArray[np.int64]]:
    """Return a mesh with fewer triangles where it has more than wanted: vertices within a cube of a grid become one."""
    if len(faces) <= most:
        return vertices, faces
    low, size = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    cubes = _FINEST
    while True:
        places = np.floor((vertices - low) / max(size, 1e-12) * cubes).astype(np.int64)
        _, cluster, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        cluster = cluster.reshape(-1)
        corners = cluster[faces]
        kept = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
        if len(kept) <= most or cubes <= _COARSEST:
            break
        cubes = max(int(0.8 * cubes), _COARSEST)
    middle = np.zeros((len(count), 3))
    np.add.at(middle, cluster, vertices)
    return middle / count[:, None], kept


def seen_from_both_sides(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles, and each also the other way round if many have no neighbour that continues their surface.

    Visual meshes are often surfaces with gaps, or with triangles that face inwards: from one side they have holes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    most = int(faces.max(initial=0)) + 1
    there, back = edges[:, 0] * most + edges[:, 1], edges[:, 1] * most + edges[:, 0]
    if np.isin(there, back).mean() >= 1 - _GAPS:
        return faces
    return np.concatenate([faces, faces[:, ::-1]])


def arm_frames(robot: CellRobot, values: ArrayLike) -> Array:
    """Return the poses of the links and of the flange of a robot of a cell in the world, shape (joints + 2, 4, 4)."""
    poses = link_poses(robot.model, values, robot.base)
    return np.concatenate([poses, (poses[-1] @ robot.model.flange)[None]])


def shapes_of(pieces: Pieces) -> tuple[VisualShape, ...]:
    """Return convex pieces as one shape; none without any."""
    if not pieces:
        return ()
    return (_joined([hull_mesh(np.asarray(piece)) for piece in pieces], PLAIN),)


def _joined(meshes: list[TriangleMesh], color: Color) -> VisualShape:
    return VisualShape(*joined_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes]), color)


@lru_cache(maxsize=16)
def _of_file(model: RobotModel) -> tuple[tuple[VisualShape, ...], ...]:
    file = Path(model.source)
    try:
        robot = parse_urdf(file)
    except (CellError, OSError) as error:
        warnings.warn(
            f"arms are drawn by their collision shapes: {' '.join(str(error).split())}", CellWarning, stacklevel=4
        )
        return tuple(shapes_of(pieces) for pieces in model.pieces)
    below = {joint.child: joint for joint in robot.joints}
    frames = {name: (number, np.eye(4)) for number, name in enumerate(model.link_names)}
    named = {material.name: material.color for material in robot.materials if material.color is not None}
    found: list[dict[Color, list[TriangleMesh]]] = [{} for _ in model.link_names]
    for link in robot.links:
        at = carrier_of(link.name, below, frames)
        for entry in () if at is None else link.visuals:
            assert at is not None
            try:
                shapes = colored_meshes(file, link.name, entry)
            except CellError as error:
                warnings.warn(f"link {link.name} is drawn by its collision shapes: {error}", CellWarning, stacklevel=4)
                continue
            stated = _color(entry.material, named)
            for mesh, own in shapes:
                vertices, faces = thinned(mesh.vertices, mesh.faces.astype(np.int64))
                faces = seen_from_both_sides(faces)
                moved = TriangleMesh.from_arrays(mesh.name, apply(at[1], vertices), faces)
                found[at[0]].setdefault(stated or own or PLAIN, []).append(moved)
    return tuple(
        tuple(_joined(meshes, color) for color, meshes in shapes.items()) or shapes_of(pieces)
        for shapes, pieces in zip(found, model.pieces, strict=True)
    )


def _color(material: Any, named: dict[str, Any]) -> Color | None:
    """Return the colour that a URDF gives a visual shape: its own, or that of the material that it names."""
    if material is None:
        return None
    color = material.color or named.get(material.name)
    rgba = None if color is None else np.asarray(color.rgba, dtype=float)
    if rgba is None or rgba.shape != (4,) or not ((rgba >= 0) & (rgba <= 1)).all():
        return None
    return float(rgba[0]), float(rgba[1]), float(rgba[2])
