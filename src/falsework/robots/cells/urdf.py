"""URDF reader: the joint chain from base to tip, with the convex hulls of the collision shapes.

What a file states and is not used, or used in another way than written, is a `CellWarning` that names it.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.errors import CellError, DependencyError, InputError
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.robots.cells.urdf_review import (
    CellWarning,
    coupling_fault,
    excluded_pairs,
    read_xml,
    soft_range,
    unused_text,
)
from falsework.robots.kernels.collision import Rules, make_work
from falsework.robots.kernels.kernel_arrays import make_bodies, make_chain, make_obstacles, self_pairs
from falsework.robots.kernels.rrt_connect import check_many
from falsework.robots.model.cell import CellRobot, Gripper
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import cylinder, move
from falsework.robots.model.simplify import outer_hull
from falsework.utils.files.damage import blamed_on

Array = NDArray[np.float64]

COLLISION_SAMPLES = 1000
"""Random configurations in which pairs of links are tested where no SRDF lists the pairs to ignore."""
_MESHES = (".stl", ".obj", ".dae", ".ply", ".off", ".glb", ".gltf")
"""Formats of meshes: archives among those that the library reads unpack to any size."""
_TIPS = ("tool0", "flange")
"""Usual names of the link that a gripper is mounted on, in this order."""
ALWAYS_SHARE = 0.95
"""Pairs that touch in this share of them are ignored: their hulls overlap at their common joint."""


def load_urdf(path: str | Path, *, base: str | None = None, tip: str | None = None) -> RobotModel:
    """Read an arm. Ignored pairs of links come from an SRDF beside it, else from random configurations.

    A URDF has no accelerations: joints are taken to reach full speed in `ACCELERATION_TIME`.

    Args:
        path: URDF file; mesh paths are relative to it.
        base: name of the base link; by default the root of the file.
        tip: name of the link that a gripper is mounted on; by default `tool0` or `flange`, else the end of the
            longest chain.

    Warns:
        CellWarning: entries that are not used, shapes and pairs of links that are replaced or left out.

    Raises:
        CellError: the file cannot be read, or does not describe an arm that plans can move; the message names file and
            joint or link.
        DependencyError: yourdfpy is missing.
    """
    file = Path(path)
    if not file.is_file():
        raise CellError(f"no robot description {file}; give a URDF file or a built-in robot")
    with blamed_on(file, "mend the description"):
        return _load(file, base, tip)


def _load(file: Path, base: str | None, tip: str | None) -> RobotModel:
    """Read an arm, as `load_urdf` does."""
    document, robot = read_xml(file), _parse(file)
    links = {link.name: link for link in robot.links}
    below = {joint.child: joint for joint in robot.joints}
    for name, which in ((base, "base"), (tip, "tip")):
        if name is not None and name not in links:
            raise CellError(f"{file}: no link {name!r} for the {which}; there are {', '.join(links)}")
    roots = [name for name in links if name not in below]
    if base is None and len(roots) != 1:
        raise CellError(f"{file}: {', '.join(roots) or 'no link'} may be the base; name base_link")
    root = base or roots[0]
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
    carried: dict[int, list[str]] = {number: [] for number in range(len(moving) + 1)}
    beside: dict[str, Any] = {}
    left_out = []
    for name, link in links.items():
        at, shown = _carrier(name, below, frame_of), list(_shapes(file, link))
        if not shown:
            continue
        if at is None:
            left_out.append(name)
            continue
        carried[at[0]].append(name)
        shapes[at[0]] += [replace(shape, vertices=move(at[1], shape.vertices)) for shape in shown]
        beside |= {joint.name: joint for joint in _off_chain(name, below, frame_of) if joint.type != "fixed"}
    if fault := coupling_fault(robot.joints, chain, beside):
        raise CellError(f"{file}: {fault}")
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
    srdf, notes = file.with_suffix(".srdf"), []
    if srdf.is_file():
        pairs, notes = excluded_pairs(srdf, carried, links)
    else:
        pairs = always_touching(model) - ignored
        said = ", ".join(f"{names[a]} and {names[b]}" for a, b in sorted(pairs))
        if pairs:
            notes = [
                f"{file}: links that touch in nearly all configurations are not checked against each other: {said}"
            ]
    ignored |= pairs
    stood_in = [name for of_link in carried.values() for name in of_link if not links[name].collisions]
    for what, named in (
        ("links without collision shapes are taken to be their visual shapes", stood_in),
        (
            "nothing is checked against links that have no shapes",
            [name for number, name in enumerate(names) if not shapes[number]],
        ),
        (f"links that are not below {root} are left out", left_out),
        ("joints that are not between base and tip are taken as fixed at zero", list(beside)),
        (
            "continuous joints are planned within 360 degrees to both sides",
            [joint.name for joint in moving if joint.type == "continuous"],
        ),
        (
            "limits are beyond two full turns, although the format has radians",
            [joint.name for joint in moving if joint.type == "revolute" and _turns_far(joint)],
        ),
        ("the gripper is mounted on the end of the longest chain", [] if tip or end in _TIPS else [end]),
        ("entries that are not used", [text] if (text := unused_text(document)) else []),
    ):
        if named:
            notes.append(f"{file}: {what}: {', '.join(named)}")
    for note in notes:
        warnings.warn(note, CellWarning, stacklevel=3)
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
    for name in _TIPS:
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


def _off_chain(name: str, below: dict[str, Any], frame_of: dict[str, tuple[int, Array]]) -> Iterable[Any]:
    """Yield the joints between a link and the chain that carries it."""
    while name not in frame_of:
        yield below[name]
        name = below[name].parent


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
    if limit is None or limit.velocity is None or not 0 < limit.velocity < np.inf:
        raise CellError(f"{file}: joint {joint.name} has no velocity limit; add velocity to its <limit>")
    if joint.type == "continuous":
        return -2 * np.pi, 2 * np.pi, float(limit.velocity)
    low, high = (-np.inf if end is None else float(end) for end in (limit.lower, limit.upper))
    if not low < high or not np.isfinite((low, high)).all():
        raise CellError(f"{file}: joint {joint.name} has no range; give lower and upper in its <limit>")
    soft_low, soft_high = soft_range(joint)
    low, high = max(low, soft_low), min(high, soft_high)
    if not low < high:
        raise CellError(f"{file}: the soft limits of joint {joint.name} leave it no range; correct them or its limits")
    return low, high, float(limit.velocity)


def _turns_far(joint: Any) -> bool:
    return max(abs(joint.limit.lower), abs(joint.limit.upper)) > 4 * np.pi


def _shapes(file: Path, link: Any) -> Iterable[TriangleMesh]:
    """Yield every collision shape of a link in the frame of the link, or without any every visual shape.

    Spheres and cylinders become polytopes around them.
    """
    for collision in link.collisions or link.visuals:
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
        else:
            made = _read_mesh(file, shape.mesh)
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

    found = find_mesh(file, str(mesh.filename))
    scale = np.ones(3) if mesh.scale is None else np.broadcast_to(np.asarray(mesh.scale, float), 3)
    if not (np.isfinite(scale) & (scale != 0)).all():
        raise CellError(f"{file}: mesh {mesh.filename} has scale {scale.tolist()}; give numbers other than zero")
    if found is None:
        raise CellError(f"{file}: mesh {mesh.filename} does not exist; keep it beside the description")
    if found.suffix.lower() not in _MESHES:
        raise CellError(f"{file}: mesh {mesh.filename} is no {', '.join(_MESHES)}; convert it to one of these")
    try:
        scene: Any = trimesh.load(found, force="scene")
        shapes = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
        check_growth(found, sum(len(shape.vertices) + len(getattr(shape, "faces", ())) for shape in shapes))
        loaded: Any = trimesh.load(found, force="mesh")
        points, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces)
        if len(points) < 4:
            raise InputError("too few vertices")
    except Exception as error:
        raise CellError(f"{file}: mesh {found.name} cannot be read: {' '.join(str(error).split())}") from error
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
