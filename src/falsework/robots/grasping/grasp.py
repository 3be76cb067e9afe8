"""Grasp candidates of a part, ranked by quality, and the directions in which a part can be withdrawn."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from falsework.assembly.model import Assembly
from falsework.errors import StateError
from falsework.geometry.mesh.collision import shrink
from falsework.geometry.mesh.mesh import triangle_normals
from falsework.robots.grasping.planar_faces import Face, faces_of
from falsework.robots.kernels.collision import CLEAR, Bodies, Chain, Rules, check_many, make_query
from falsework.robots.kernels.kernel_arrays import bounds_of, make_obstacles
from falsework.robots.model.cell import GRIP_TILT, CellRobot, Gripper
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import Array, Pieces
from falsework.utils.quantity import format_quantity

SUCTION_TURNS = 8
"""Rotations about the normal of a face at which a suction grasp is tried."""
JAW_TURNS = 8
"""Directions around the axis of the jaws from which a jaw grasp is tried."""
CUP_OFFSET_SHARE = 0.8
"""Distance of off-centre cup positions on a face, as a share of the distance at which the cup just fits."""
PINCHED_SHARE = 0.5
"""Share of the contact length of jaws, from the tool frame back, on which they close flat on two opposite faces."""
STANDOFF = 0.0005
"""Distance of the tool frame from the gripped face, metres; a soft cup compensates for it."""
GRIPPER_MARGIN = 0.001
"""Distance that a gripper keeps from other parts at the grasp and on the approach, metres."""
APPROACH_LENGTH = 0.1
"""Length of the straight approach on which the gripper alone is checked, metres."""
APPROACH_SAMPLES = 6
"""Positions on the approach at which the gripper is checked."""
_OPPOSITE = -float(np.cos(np.radians(5.0)))
"""Largest cosine of the angle between the normals of two faces that count as opposite."""
_BATCH = 256
"""Grasps that are checked in one call."""

_SUCTION_TURNS = 2 * np.pi * np.arange(SUCTION_TURNS) / SUCTION_TURNS
_JAW_TURNS = np.array([0.0, np.pi])
_TO_X, _TO_Y = np.eye(3)[[2, 0, 1]], np.eye(3)[[1, 2, 0]]
"""Rotations that turn z to x, and z to y."""
_FREE_FLIGHT = np.zeros((6, 3, 4))
_FREE_FLIGHT[:, :, :3] = [_TO_X, _TO_X.T @ _TO_Y, _TO_Y.T, np.eye(3), _TO_Y, _TO_Y.T @ _TO_X]
"""Frames of joints along and about z whose axes are x, y, z, z, y and x in turn, shape (joints, 3, 4)."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """Grasp candidate: pose of the tool frame, approach direction and quality."""

    tool: Array
    """Pose of the tool frame in the world, shape (4, 4)."""
    approach: Array
    """Unit vector of the gripper's approach, shape (3,)."""
    quality: float
    """From 0 to 1: near the centre of mass, on a large face, pulled along an exit direction."""
    width: float = 0.0
    """Opening of the jaws, metres; 0 for suction."""


Test = Callable[[Sequence[Grasp]], NDArray[np.bool_]]
"""Test of grasps, shape (grasps,)."""


def grasps(
    assembly: Assembly, parts: PartShapes, part: int, present: ArrayLike, robot: CellRobot, *, limit: int = 64
) -> list[Grasp]:
    """Return grasps of a part among the present parts, a mask or a state, best first; the arm is not considered.

    The gripper keeps clear of all other parts on the last segment of its approach and at the part. The list is
    deterministic: the best faces first, each at one rotation about its normal, then at the next.
    """
    there = np.asarray(present) > 0
    if there.shape != (parts.part_count,):
        raise StateError(f"present has shape {there.shape}; expected ({parts.part_count},), one value per part")
    if not 0 <= part < parts.part_count:
        raise StateError(f"no part {part}; parts are 0 to {parts.part_count - 1}")
    gripper = robot.gripper
    if parts.mass[part] > robot.payload:
        return []
    return clear_grasps(candidates(assembly, parts, part, gripper), parts, part, there, gripper, limit=limit)


def candidates(assembly: Assembly, parts: PartShapes, part: int, gripper: Gripper) -> list[Grasp]:
    """Return grasps of a part that is alone, in the order of `grasps`."""
    faces = faces_of(parts.surface(part), smallest=np.pi * gripper.cup**2 if gripper.kind == "suction" else 0.0)
    table = assembly.clearance
    ways = table.directions[table.start[part] : table.start[part + 1]] @ parts.turn.T
    size = float(np.linalg.norm(np.ptp(parts.meshes[part].vertices, axis=0)))
    if gripper.kind == "suction":
        groups = [group for face in faces for group in _on_face(gripper, face, parts.center[part], ways, size)]
    else:
        groups = _between_faces(gripper, faces, part, parts, ways, size)
    groups = [group for group in groups if group]
    groups.sort(key=lambda group: -round(group[0].quality, 6))
    found = [grasp for turn in itertools.zip_longest(*groups) for grasp in turn if grasp is not None]
    mesh = parts.meshes[part]
    if np.isclose(ConvexHull(mesh.vertices).volume, mesh.volume, rtol=1e-6):
        return found
    # Nor may the gripper reach through another side of the part, into which it presses as deep as checks allow.
    corners = shrink(mesh, min(gripper.press_depth, mesh.thickness / 4))
    return _clear(found, _free_approaches([tuple(corners[mesh.faces])], gripper, 0.0), len(found))


def grasp_fault(parts: PartShapes, part: int, gripper: Gripper, *, blocked: bool) -> str:
    """Return in words why a gripper has no grasp of a part, which may be `blocked` by others, with both their sizes."""
    what = "no face that the gripper can grasp"
    if blocked:
        what = f"{what} among the other parts, which leave it no room"
    faces = faces_of(parts.surface(part))
    if gripper.kind == "suction":
        largest = max((_radius(face) for face in faces), default=0.0)
        if largest >= gripper.cup and not blocked:
            what = f"{what}, since the part itself is in its way"
        return (
            f"{what}: its cup has a radius of {format_quantity(gripper.cup, 'length')}, the largest face takes one of "
            f"{format_quantity(largest, 'length')}"
        )
    widths = [high - low for _, _, low, high in _opposite(faces) if high > low]
    narrow = (
        f"the part is at least {format_quantity(min(widths), 'length')} wide"
        if widths
        else "the part has no opposite faces"
    )
    jaws = (
        f"its jaws open to {format_quantity(gripper.opening, 'length')} and are "
        f"{format_quantity(gripper.depth, 'length')} deep"
    )
    return f"{what}: {jaws}, {narrow}"


def _radius(face: Face) -> float:
    """Return the radius of the largest circle on a face, metres."""
    outline = max(shapely.get_parts(face.outline), key=shapely.area)
    return float(shapely.length(shapely.maximum_inscribed_circle(outline)))


def _opposite(faces: Sequence[Face]) -> Iterator[tuple[Face, Face, float, float]]:
    """Yield pairs of opposite faces with the heights of the farthest points of both along the normal of the first."""
    for face, other in itertools.combinations(faces, 2):
        if face.normal @ other.normal <= _OPPOSITE:
            high, low = (one.triangles.reshape(-1, 3) @ face.normal for one in (face, other))
            yield face, other, float(low.min()), float(high.max())


def clear_grasps(
    tried: Sequence[Grasp], parts: PartShapes, part: int, there: NDArray[np.bool_], gripper: Gripper, *, limit: int
) -> list[Grasp]:
    """Return the first grasps of a part with which the gripper keeps clear of other parts, those of a mask (parts,)."""
    others = [parts.pieces[other] for other in np.flatnonzero(there).tolist() if other != part]
    return _clear(tried, _free_approaches(others, gripper, GRIPPER_MARGIN), limit)


def _clear(tried: Sequence[Grasp], open_ways: Test, limit: int) -> list[Grasp]:
    """Return the first grasps that pass a test of `_free_approaches`."""
    found: list[Grasp] = []
    while tried and len(found) < limit:
        some, tried = tried[:_BATCH], tried[_BATCH:]
        found += [some[row] for row in np.flatnonzero(open_ways(some)).tolist()]
    return found[:limit]


def _on_face(gripper: Gripper, face: Face, center: Array, ways: Array, size: float) -> list[list[Grasp]]:
    """Return suction grasps on one face: where the cup fits closest to the centre of mass, then off-centre.

    Off-centre grasps let two arms hold blocks that lie side by side.
    """
    room = _room(face, gripper.cup)
    if shapely.is_empty(room):
        return []
    middle = face.flat(center)
    margin = min(1.0, gripper.cup / max(np.sqrt(face.area), 1e-9))
    groups = []
    for at in _spots(room, middle, gripper.cup):
        point = face.lift(at) + STANDOFF * face.normal
        lever = float(np.linalg.norm(at - middle)) / size
        quality = _quality(lever, 1.0 - margin, face.normal, ways)
        tools = _tools(point, -face.normal, face.frame[0], _SUCTION_TURNS)
        groups.append([Grasp(tool, -face.normal, quality) for tool in tools])
    return groups


def _room(face: Face, cup: float) -> shapely.Geometry:
    """Return where the centre of a cup may be, so that all of it is on a face."""
    # At the short edges of an outline of several triangles, a buffer may leave slivers that lie on the outline itself.
    pieces = shapely.get_parts(shapely.buffer(face.outline, -cup * 1.02))
    far = shapely.distance(shapely.point_on_surface(pieces), shapely.boundary(face.outline)) >= cup
    return shapely.union_all(pieces[far])


def _spots(room: shapely.Geometry, middle: Array, cup: float) -> list[Array]:
    """Return points of a flat region: the nearest to the centre, then outer ones, at least a cup radius apart."""
    first = shapely.get_coordinates(shapely.shortest_line(shapely.Point(middle), room))[-1]
    spots = [first]
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(room))
    for corner, following in itertools.pairwise(corners):
        wanted = first + CUP_OFFSET_SHARE * ((corner + following) / 2 - first)
        at = shapely.get_coordinates(shapely.shortest_line(shapely.Point(wanted), room))[-1]
        if min(float(np.linalg.norm(at - spot)) for spot in spots) > cup:
            spots.append(at)
    return spots


def _between_faces(
    gripper: Gripper, faces: Sequence[Face], part: int, parts: PartShapes, ways: Array, size: float
) -> list[list[Grasp]]:
    """Return jaw grasps between opposite faces, from directions around the axis of the jaws."""
    center, vertices = parts.center[part], parts.meshes[part].vertices
    groups = []
    for face, other, low, high in _opposite(faces):
        width = high - low
        if width > gripper.opening:
            continue
        shared = shapely.intersection(_level(face, face), _level(other, face))
        if shapely.area(shared) < gripper.depth**2 / 4:
            continue
        middle = face.flat(center)
        at = shapely.get_coordinates(shapely.shortest_line(shapely.Point(middle), shared))[-1]
        inside = at @ face.frame + (high + low) / 2 * face.normal
        group = []
        for k in range(JAW_TURNS):
            angle = 2 * np.pi * k / JAW_TURNS
            way = np.cos(angle) * face.frame[0] + np.sin(angle) * face.frame[1]  # approach direction
            nearest = float((vertices @ way).min())
            shift = min(0.0, nearest + gripper.depth - inside @ way)  # the palm stays outside
            point = inside + shift * way
            pinched = shapely.LineString([face.flat(point), face.flat(point - gripper.depth * way)])
            if shapely.length(shapely.intersection(pinched, shared)) < PINCHED_SHARE * gripper.depth:
                continue
            lever = float(np.linalg.norm(face.flat(point) - middle)) / size
            quality = _quality(lever, 1 - width / gripper.opening, -way, ways)
            tools = _tools(point, way, face.normal, _JAW_TURNS)
            group += [Grasp(tool, way, quality, width) for tool in tools]
        groups.append(sorted(group, key=lambda grasp: -round(grasp.quality, 6)))
    return groups


def _level(face: Face, onto: Face) -> shapely.Geometry:
    """Return the part of a face on which jaws close flat, projected along the normal of a face."""
    normals = triangle_normals(face.triangles)
    level = np.abs(normals @ onto.normal) >= np.cos(np.radians(GRIP_TILT)) * np.linalg.norm(normals, axis=1)
    return shapely.union_all(shapely.buffer(shapely.polygons(face.triangles[level] @ onto.frame.T), 1e-9))


def _quality(lever: float, room: float, pull: Array, ways: Array) -> float:
    """Rate a grasp from 0 to 1: half for a short lever arm, a third for pulling along an exit, the rest for room."""
    along = max(0.0, float((ways @ pull).max(initial=0.0)))
    return 0.5 * max(0.0, 1.0 - 2 * lever) + 0.35 * along + 0.15 * room


def _tools(point: Array, z: Array, x: Array, turns: Array) -> Array:
    """Return tool frames at a point with a given z, and x turned about z from a given direction, shape (n, 4, 4)."""
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    y = np.array([z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]])
    cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
    made = np.zeros((len(turns), 4, 4))
    made[:, :3, 0], made[:, :3, 1], made[:, :3, 2] = cos * x + sin * y, cos * y - sin * x, z
    made[:, :3, 3], made[:, 3, 3] = point, 1.0
    return made


def _free_approaches(bodies: Sequence[Pieces], gripper: Gripper, margin: float) -> Test:
    """Return a test which grasps leave the gripper alone clear of some bodies, there and on the approach."""
    obstacles, _ = make_obstacles(bodies)
    # The gripper as the last link of a chain that reaches every pose: three slides along x, y, z, turns about z, y, x.
    start, vertices, center, radius = bounds_of([piece @ _TO_X for piece in gripper.pieces])
    count = len(center)
    moving = Bodies(np.full(count, 6), start, vertices, center, radius, np.zeros((count, 6)))
    pairs = np.ones((count, len(obstacles.low)), bool)
    rules = Rules(pairs, np.zeros((0, 2), np.int64), -1e9, np.zeros(count, bool), margin)
    chain = Chain(np.eye(4)[:3].copy(), _FREE_FLIGHT.copy(), np.arange(6) < 3)
    query = make_query(chain, moving, obstacles, rules)
    back = np.linalg.inv(gripper.tool)

    def test(grasps: Sequence[Grasp]) -> NDArray[np.bool_]:
        poses = np.array([grasp.tool for grasp in grasps]) @ back
        approach = np.array([grasp.approach for grasp in grasps])
        turns, left = _turns(poses[:, :3, :3]), np.arange(len(grasps))
        for distance in np.linspace(0.0, APPROACH_LENGTH, APPROACH_SAMPLES):
            hits = np.empty(len(left), np.int64)
            check_many(np.hstack([(poses[:, :3, 3] - distance * approach)[left], turns[left]]), query, hits)
            left = left[hits == CLEAR]
        return np.isin(np.arange(len(grasps)), left)

    return test


def _turns(rotations: Array) -> Array:
    """Return turns about z, y and x, in this order, that make up rotations, shape (n, 3, 3) to (n, 3)."""
    level = np.hypot(rotations[:, 0, 0], rotations[:, 1, 0])
    steep = level < 1e-9  # x points along z: turns about z and x are the same
    return np.stack(
        [
            np.where(steep, 0.0, np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])),
            np.arctan2(-rotations[:, 2, 0], level),
            np.where(
                steep,
                np.arctan2(-rotations[:, 1, 2], rotations[:, 1, 1]),
                np.arctan2(rotations[:, 2, 1], rotations[:, 2, 2]),
            ),
        ],
        axis=1,
    )
