"""URDF reader: the joint chain from base to tip, with the convex hulls of the collision shapes."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.errors import CellError, DependencyError, InputError
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.robots.kernels.collision import Rules, make_work
from falsework.robots.kernels.kernel_arrays import make_bodies, make_chain, make_obstacles, self_pairs
from falsework.robots.kernels.rrt_connect import check_many
from falsework.robots.model.cell import CellRobot, Gripper
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import cylinder, move
from falsework.robots.model.simplify import outer_hull

Array = NDArray[np.float64]

COLLISION_SAMPLES = 1000
"""Random configurations in which pairs of links are tested where no SRDF lists the pairs to ignore."""
ALWAYS_SHARE = 0.95
"""Pairs that touch in this share of them are ignored: their hulls overlap at their common joint."""


def load_urdf(path: str | Path, *, base: str | None = None, tip: str | None = None) -> RobotModel:
    """Read an arm. Ignored pairs of links come from an SRDF beside it, else from random configurations.

    Args:
        path: URDF file; mesh paths are relative to it.
        base: name of the base link; by default the root of the file.
        tip: name of the link that a gripper is mounted on; by default `tool0` or `flange`, else the end of the
            longest chain.

    Raises:
        CellError: the file cannot be read, or does not describe an arm; the message names file and joint.
        DependencyError: yourdfpy is missing.
    """
    file = Path(path)
    if not file.is_file():
        raise CellError(f"no robot description {file}; give a URDF file or a built-in robot")
    robot = _parse(file)
    links = {link.name: link for link in robot.links}
    below = {joint.child: joint for joint in robot.joints}
    for name, which in ((base, "base"), (tip, "tip")):
        if name is not None and name not in links:
            raise CellError(f"{file}: no link {name!r} for the {which}; there are {', '.join(links)}")
    root = base or next(name for name in links if name not in below)
    end = tip or _tip(links, below, root)
    chain = _chain(file, below, root, end)
    moving = [joint for joint in chain if joint.type != "fixed"]
    if not 1 <= len(moving) <= 12:
        raise CellError(f"{file}: {len(moving)} joints between {root} and {end}; name base and tip of one arm")
    origins, pose = [], np.eye(4)
    frame_of = {root: (0, np.eye(4))}
    for joint in chain:
        pose = pose @ _origin(joint)
        if joint.type != "fixed":
            origins.append(pose)
            pose = np.eye(4)
        frame_of[joint.child] = (len(origins), pose)
    shapes: list[list[TriangleMesh]] = [[] for _ in range(len(moving) + 1)]
    owner: dict[str, int] = {}
    for name, link in links.items():
        at = _carrier(name, below, frame_of)
        if at is not None:
            owner[name] = at[0]
            shapes[at[0]] += [replace(shape, vertices=move(at[1], shape.vertices)) for shape in _shapes(file, link)]
    limits = np.array([_limits(file, joint) for joint in moving])
    names = (root, *(joint.child for joint in moving))
    middle = np.clip(np.zeros(len(moving)), limits[:, 0], limits[:, 1])
    model = RobotModel(
        name=str(robot.name),
        joint_names=tuple(joint.name for joint in moving),
        link_names=names,
        origins=np.array(origins),
        axes=np.array([_axis(file, joint) for joint in moving]),
        prismatic=np.array([joint.type == "prismatic" for joint in moving]),
        lower=limits[:, 0],
        upper=limits[:, 1],
        velocity=limits[:, 2],
        acceleration=limits[:, 2] / ACCELERATION_TIME,
        pieces=tuple(tuple(outer_hull(shape.vertices) for shape in of_link) for of_link in shapes),
        ignored=frozenset((link, link + 1) for link in range(len(moving))),
        flange=pose,
        home=middle,
        meshes=tuple(map(tuple, shapes)),
        source=str(file),
    )
    ignored = set(model.ignored)
    srdf = file.with_suffix(".srdf")
    ignored |= _named_pairs(srdf, owner) if srdf.is_file() else always_touching(model)
    return replace(model, ignored=frozenset(ignored))


def always_touching(model: RobotModel) -> set[tuple[int, int]]:
    """Return pairs of links that touch in nearly all random configurations, so that checking them is meaningless."""
    configurations = np.random.default_rng(0).uniform(model.lower, model.upper, (COLLISION_SAMPLES, model.joints))
    bare = Gripper("none", "suction", (), np.eye(4), 0.0)
    robot = CellRobot("arm", model, np.eye(4), bare, model.home, np.zeros((0, 4, 4)))
    bodies, _, kinds = make_bodies(robot, None, ())
    links = np.array(kinds)
    obstacles, _ = make_obstacles([])
    chain = make_chain(model, np.eye(4))
    pairs = self_pairs(model, kinds)
    found = set()
    hits = np.empty(COLLISION_SAMPLES, np.int64)
    for a, b in sorted({(int(links[i]), int(links[j])) for i, j in pairs}):
        tried = np.array([(i, j) for i, j in pairs if (links[i], links[j]) == (a, b)], np.int64)
        rules = Rules(np.zeros((len(links), 0), bool), tried, -1e9, np.zeros(len(links), bool), 0.0)
        check_many(configurations, chain, bodies, obstacles, rules, make_work(chain, bodies, obstacles, rules), hits)
        if (hits >= 0).mean() >= ALWAYS_SHARE:
            found.add((a, b))
    return found


def _parse(file: Path) -> Any:
    try:
        import yourdfpy
    except ImportError as error:
        raise DependencyError("reading URDF files needs yourdfpy: pip install 'falsework[robots]'") from error
    try:
        return yourdfpy.URDF.load(
            str(file), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
        ).robot
    except Exception as error:  # the reader passes on any error of its XML parser
        text = " ".join(str(error).split()) or type(error).__name__
        raise CellError(f"{file} is not a readable URDF: {text}") from error


def _tip(links: dict[str, Any], below: dict[str, Any], root: str) -> str:
    """Return the link for the gripper: a usual name, else the end of the chain with most joints."""
    for name in ("tool0", "flange"):
        if name in links:
            return name

    def depth(name: str) -> tuple[int, int]:
        moving = fixed = 0
        while name != root and name in below:
            moving += below[name].type != "fixed"
            fixed += 1
            name = below[name].parent
        return (moving, fixed) if name == root else (-1, 0)

    return max(links, key=depth)


def _chain(file: Path, below: dict[str, Any], root: str, end: str) -> list[Any]:
    """Return joints from the root to the end."""
    found, name = [], end
    while name != root:
        if name not in below:
            raise CellError(f"{file}: {end} is not connected to {root}; name base and tip of one arm")
        found.append(below[name])
        name = below[name].parent
    return found[::-1]


def _carrier(name: str, below: dict[str, Any], frame_of: dict[str, tuple[int, Array]]) -> tuple[int, Array] | None:
    """Return the frame that carries a link and the pose of the link in it; joints off the chain stay at zero."""
    pose = np.eye(4)
    while name not in frame_of:
        if name not in below:
            return None
        pose = _origin(below[name]) @ pose
        name = below[name].parent
    frame, at = frame_of[name]
    return frame, at @ pose


def _origin(joint: Any) -> Array:
    return np.eye(4) if joint.origin is None else np.asarray(joint.origin, float)


def _axis(file: Path, joint: Any) -> Array:
    axis = np.array([1.0, 0, 0] if joint.axis is None else joint.axis, float)
    length = np.linalg.norm(axis)
    if not length > 0:
        raise CellError(f"{file}: joint {joint.name} has axis {axis.tolist()}; it must not be zero")
    return axis / length


def _limits(file: Path, joint: Any) -> tuple[float, float, float]:
    limit = joint.limit
    if joint.type not in ("revolute", "continuous", "prismatic"):
        raise CellError(f"{file}: joint {joint.name} is {joint.type}; only revolute and prismatic joints are supported")
    if limit is None or limit.velocity is None or not limit.velocity > 0:
        raise CellError(f"{file}: joint {joint.name} has no velocity limit; add velocity to its <limit>")
    if joint.type == "continuous":
        return -2 * np.pi, 2 * np.pi, float(limit.velocity)
    if limit.lower is None or limit.upper is None or not limit.lower < limit.upper:
        raise CellError(f"{file}: joint {joint.name} has no range; give lower and upper in its <limit>")
    return float(limit.lower), float(limit.upper), float(limit.velocity)


def _shapes(file: Path, link: Any) -> Iterable[TriangleMesh]:
    """Yield every collision shape of a link, in the frame of the link; spheres and cylinders as enclosing polytopes."""
    for collision in link.collisions:
        pose = np.eye(4) if collision.origin is None else np.asarray(collision.origin, float)
        shape = collision.geometry
        if shape.box is not None:
            half = np.asarray(shape.box.size, float) / 2
            made = hull_mesh(half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]))
        elif shape.cylinder is not None:
            half_length = shape.cylinder.length / 2
            made = hull_mesh(cylinder(shape.cylinder.radius, -half_length, half_length))
        elif shape.sphere is not None:
            made = hull_mesh(_ball(shape.sphere.radius))
        elif shape.mesh is not None:
            made = _read_mesh(file, shape.mesh)
        else:
            continue
        yield replace(made, name=link.name, vertices=move(pose, made.vertices))


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


def _read_mesh(file: Path, mesh: Any) -> TriangleMesh:
    import trimesh

    name = str(mesh.filename).removeprefix("file://")
    if name.startswith("package://"):
        name = name.removeprefix("package://").split("/", 1)[-1]
    found = next((p for p in (file.parent / name, *(up / name for up in file.parents)) if p.is_file()), None)
    if found is None:
        raise CellError(f"{file}: mesh {mesh.filename} does not exist; keep it beside the description")
    try:
        loaded: Any = trimesh.load(found, force="mesh")
        points, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces)
        if len(points) < 4:
            raise InputError("too few vertices")
    except Exception as error:
        raise CellError(f"{file}: mesh {found.name} cannot be read: {' '.join(str(error).split())}") from error
    return TriangleMesh.from_arrays(
        name, points * (1.0 if mesh.scale is None else np.asarray(mesh.scale, float)), faces
    )


def _named_pairs(srdf: Path, owner: dict[str, int]) -> set[tuple[int, int]]:
    """Return pairs of links that an SRDF excludes from collision checking."""
    try:
        tree = ElementTree.parse(srdf)
    except ElementTree.ParseError as error:
        raise CellError(f"{srdf} cannot be read: {error}") from error
    found = set()
    for entry in tree.getroot().iter("disable_collisions"):
        a, b = owner.get(entry.get("link1", "")), owner.get(entry.get("link2", ""))
        if a is not None and b is not None and a != b:
            found.add((min(a, b), max(a, b)))
    return found
