"""Shapes of links in URDF files: boxes, cylinders, spheres and meshes as triangles."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.errors import CellError, FalseworkError, InputError
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.mesh import TriangleMesh, joined_faces, triangle_normals
from falsework.robots.model.shapes import Array, cylinder

Color = tuple[float, float, float]
"""Red, green, blue from 0 to 1."""
_MESHES = (".stl", ".obj", ".dae", ".ply", ".off", ".glb", ".gltf")
"""Formats of meshes: archives among those that the library reads unpack to any size."""


def collision_shapes(file: Path, link: Any) -> Iterable[TriangleMesh]:
    """Yield every collision shape of a link in the frame of the link, or without any every visual shape."""
    for collision in link.collisions or link.visuals:
        yield shape_mesh(file, link.name, collision)


def shape_mesh(file: Path, link: str, entry: Any) -> TriangleMesh:
    """Return one collision or visual shape, as yourdfpy reads it, in the frame of its link.

    Spheres and cylinders become polytopes around them. CellError if a mesh is not there or cannot be read.
    """
    pose = np.eye(4) if entry.origin is None else np.asarray(entry.origin, float)
    shape = entry.geometry
    if shape.box is not None:
        half = np.asarray(shape.box.size, float) / 2
        made = hull_mesh(half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]))
    elif shape.cylinder is not None:
        half_length = shape.cylinder.length / 2
        made = hull_mesh(cylinder(shape.cylinder.radius, -half_length, half_length))
    elif shape.sphere is not None:
        made = hull_mesh(_ball(shape.sphere.radius))
    else:
        pieces = [piece for piece, _ in _read_mesh(file, shape.mesh)]
        made = TriangleMesh.from_arrays("", *joined_faces([p.vertices for p in pieces], [p.faces for p in pieces]))
    return replace(made, name=link, vertices=apply(pose, made.vertices))


def _ball(radius: float) -> Array:
    """Return vertices of a polytope around a sphere: an icosahedron, scaled up to contain the sphere."""
    golden = (1 + 5**0.5) / 2
    corners = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([np.roll(corner, k) for corner in corners for k in range(3)], float)
    return points / np.linalg.norm(points[0]) * radius * 1.2585  # ratio of circumscribed to inscribed radius


def hull_mesh(points: Array) -> TriangleMesh:
    """Return the convex hull of points as triangles with outward normals."""
    found = ConvexHull(points)
    corners = points[found.simplices]
    normals = triangle_normals(corners)
    inwards = np.einsum("ij,ij->i", normals, found.equations[:, :3]) < 0
    faces = np.where(inwards[:, None], found.simplices[:, ::-1], found.simplices)
    return TriangleMesh.from_arrays("", points, faces)


def colored_meshes(file: Path, link: str, entry: Any) -> list[tuple[TriangleMesh, Color | None]]:
    """Return the pieces of a visual shape in the frame of its link, and the colour that its mesh file has for each."""
    if entry.geometry.mesh is None:
        return [(shape_mesh(file, link, entry), None)]
    pose = np.eye(4) if entry.origin is None else np.asarray(entry.origin, float)
    pieces = _read_mesh(file, entry.geometry.mesh, _own_color)
    return [(replace(mesh, name=link, vertices=apply(pose, mesh.vertices)), color) for mesh, color in pieces]


def _read_mesh(
    file: Path, mesh: Any, color_of: Callable[[Any], Color | None] = lambda _: None
) -> list[tuple[TriangleMesh, Color | None]]:
    """Return the pieces of a mesh file, each with a colour after its looks; CellError if it cannot be read."""
    import trimesh

    found, scale = _mesh_file(file, mesh)
    made: list[tuple[TriangleMesh, Color | None]] = []
    try:
        scene: Any = trimesh.load(found, force="scene")
        nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
        shapes = [(at, scene.geometry[name]) for at, name in nodes]
        check_growth(found, sum(len(shape.vertices) + len(getattr(shape, "faces", ())) for _, shape in shapes))
        for at, shape in shapes:
            if len(getattr(shape, "faces", ())):
                points = apply(np.asarray(at, float), np.asarray(shape.vertices, float))
                made.append((_scaled(found, points, np.asarray(shape.faces), scale), color_of(shape.visual)))
        if sum(len(piece.vertices) for piece, _ in made) < 4:
            raise InputError("it has fewer than four vertices; export it again")
    except FalseworkError as error:
        raise CellError(f"{file}: mesh {found.name} cannot be read: {error}") from error
    except Exception as error:  # readers of trimesh fail in many ways
        kind = found.suffix.lower()
        raise CellError(f"{file}: mesh {found.name} is damaged, or no {kind} file; export it again") from error
    return made


def _own_color(visual: Any) -> Color | None:
    """Return the colour of a shape of a mesh file; None where the file has none."""
    if visual is None or visual.kind is None:
        return None
    color = np.asarray(visual.material.main_color if visual.kind == "texture" else visual.main_color, float) / 255
    return float(color[0]), float(color[1]), float(color[2])


def _mesh_file(file: Path, mesh: Any) -> tuple[Path, Array]:
    """Return the file of a mesh and its scale, shape (3,)."""
    found = find_mesh(file, str(mesh.filename))
    scale = np.ones(3) if mesh.scale is None else np.array(np.broadcast_to(np.asarray(mesh.scale, float), 3))
    if not (np.isfinite(scale) & (scale != 0)).all():
        raise CellError(f"{file}: mesh {mesh.filename} has scale {scale.tolist()}; give numbers other than zero")
    if found is None:
        raise CellError(f"{file}: mesh {mesh.filename} does not exist; keep it beside the description")
    if found.suffix.lower() not in _MESHES:
        raise CellError(f"{file}: mesh {mesh.filename} is no {', '.join(_MESHES)}; convert it to one of these")
    return found, scale


def _scaled(found: Path, points: Array, faces: NDArray[Any], scale: Array) -> TriangleMesh:
    # A mirror image has its triangles the other way round.
    faces = faces[:, ::-1] if np.prod(scale) < 0 else faces
    return TriangleMesh.from_arrays(found.name, points * scale * _unit(found), np.ascontiguousarray(faces))


def find_mesh(file: Path, name: str) -> Path | None:
    """Return the mesh that a URDF names; None if it does not exist.

    `package://name/path` is looked for below folders around the description, with and without the name of the package,
    the nearest first; other paths from the folder of the description on.
    """
    name = name.removeprefix("file://")
    tried = [name]
    if name.startswith("package://"):
        whole = name.removeprefix("package://")
        tried = [whole, whole.split("/", 1)[-1]]
    places = (file.parent, *file.absolute().parents)
    return next((place / one for place in places for one in tried if (place / one).is_file()), None)


def _unit(mesh: Path) -> float:
    """Return the metres of a unit of a mesh file; of the formats that URDF files name only COLLADA states it."""
    if mesh.suffix.lower() != ".dae":
        return 1.0
    unit = next((entry for entry in ElementTree.parse(mesh).iter() if entry.tag.endswith("unit")), None)
    return 1.0 if unit is None else float(unit.get("meter", "1"))
