"""Grasp candidates of a part, ranked by quality, and the directions in which a part can be withdrawn."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.errors import StateError
from falsework.robots.grasping.planar_faces import Face, faces_of
from falsework.robots.kernels.collision import CLEAR, Bodies, Chain, Rules, make_work
from falsework.robots.kernels.kernel_arrays import make_obstacles
from falsework.robots.kernels.rrt_connect import check_many
from falsework.robots.model.cell import CellRobot, Gripper
from falsework.robots.model.part_shapes import PartShapes

Array = NDArray[np.float64]

SUCTION_TURNS = 8
"""Rotations about the normal of a face at which a suction grasp is tried."""
JAW_TURNS = 8
"""Directions around the axis of the jaws from which a jaw grasp is tried."""
CUP_OFFSET_SHARE = 0.8
"""Distance of off-centre cup positions on a face, as a share of the distance at which the cup just fits."""
STANDOFF = 0.0005
"""Distance of the tool frame from the gripped face, metres; a soft cup compensates for it."""
GRIPPER_MARGIN = 0.001
"""Distance that a gripper keeps from other parts at the grasp and on the approach, metres."""
APPROACH_LENGTH = 0.1
"""Length of the straight approach on which the gripper alone is checked, metres."""
APPROACH_SAMPLES = 6
"""Positions on the approach at which the gripper is checked."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """Grasp candidate: pose of the tool frame, approach direction and quality."""

    part: int
    tool: Array
    """Pose of the tool frame in the world, shape (4, 4)."""
    approach: Array
    """Unit vector of the gripper's approach, shape (3,)."""
    quality: float
    """From 0 to 1: near the centre of mass, on a large face, pulled along an exit direction."""
    width: float = 0.0
    """Opening of the jaws, metres; 0 for suction."""


def grasps(
    assembly: Assembly,
    parts: PartShapes,
    part: int,
    present: ArrayLike,
    robot: CellRobot,
    *,
    limit: int = 64,
) -> list[Grasp]:
    """Return grasps of a part among the present parts, best first; the arm is not considered.

    The gripper keeps clear of all other parts on the last segment of its approach and at the part. The list is
    deterministic: the best faces first, each at one rotation about its normal, then at the next.

    Args:
        assembly: the structure; its clearance table gives the exit directions of the part.
        parts: its parts in the cell.
        part: index of the part.
        present: present parts: a mask or a state, shape (parts,).
        robot: robot with the gripper; a part heavier than its payload has no grasp.
        limit: largest number of returned grasps.

    Raises:
        StateError: another number of parts, or no such part.
    """
    there = np.asarray(present) > 0
    if there.shape != (parts.part_count,):
        raise StateError(f"present has shape {there.shape}; expected ({parts.part_count},), one value per part")
    if not 0 <= part < parts.part_count:
        raise StateError(f"no part {part}; parts are 0 to {parts.part_count - 1}")
    gripper = robot.gripper
    if parts.mass[part] > robot.payload:
        return []
    faces = faces_of(parts.meshes[part], smallest=np.pi * gripper.cup**2 if gripper.kind == "suction" else 0.0)
    table = assembly.clearance
    ways = table.directions[table.start[part] : table.start[part + 1]] @ parts.turn.T
    size = float(np.linalg.norm(np.ptp(parts.meshes[part].vertices, axis=0)))
    if gripper.kind == "suction":
        groups = [group for face in faces for group in _on_face(gripper, face, part, parts.center[part], ways, size)]
    else:
        groups = _between_faces(gripper, faces, part, parts, ways, size)
    groups = [group for group in groups if group]
    groups.sort(key=lambda group: -round(group[0].quality, 6))
    found: list[Grasp] = []
    open_way = _open_way(parts, part, there, gripper)
    for turn in range(max((len(group) for group in groups), default=0)):
        for group in groups:
            if turn < len(group) and open_way(group[turn]):
                found.append(group[turn])
                if len(found) == limit:
                    return found
    return found


def _on_face(gripper: Gripper, face: Face, part: int, center: Array, ways: Array, size: float) -> list[list[Grasp]]:
    """Return suction grasps on one face: where the cup fits closest to the centre of mass, then off-centre.

    Off-centre grasps let two arms hold blocks that lie side by side.
    """
    room = shapely.buffer(face.outline, -gripper.cup * 1.02)
    if shapely.is_empty(room):
        return []
    middle = face.flat(center)
    margin = min(1.0, gripper.cup / max(np.sqrt(face.area), 1e-9))
    groups = []
    for at in _spots(room, middle, gripper.cup):
        point = face.lift(at) + STANDOFF * face.normal
        lever = float(np.linalg.norm(at - middle)) / size
        quality = _quality(lever, 1.0 - margin, face.normal, ways)
        tools = [_tool(point, -face.normal, face.frame[0], 2 * np.pi * k / SUCTION_TURNS) for k in range(SUCTION_TURNS)]
        groups.append([Grasp(part, tool, -face.normal, quality) for tool in tools])
    return groups


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
    for first, face in enumerate(faces):
        for other in faces[first + 1 :]:
            if face.normal @ other.normal > -np.cos(np.radians(5.0)):
                continue
            width = float(
                (face.triangles.reshape(-1, 3) @ face.normal).max()
                - (other.triangles.reshape(-1, 3) @ face.normal).min()
            )
            if width > gripper.opening:
                continue
            flat = shapely.union_all(shapely.buffer(shapely.polygons(other.triangles @ face.frame.T), 1e-9))
            shared = shapely.intersection(face.outline, flat)
            if shapely.area(shared) < gripper.depth**2 / 4:
                continue
            middle = face.flat(center)
            at = shapely.get_coordinates(shapely.shortest_line(shapely.Point(middle), shared))[-1]
            level = (
                (face.triangles.reshape(-1, 3) @ face.normal).max()
                + (other.triangles.reshape(-1, 3) @ face.normal).min()
            ) / 2
            inside = at @ face.frame + level * face.normal
            group = []
            for k in range(JAW_TURNS):
                angle = 2 * np.pi * k / JAW_TURNS
                way = np.cos(angle) * face.frame[0] + np.sin(angle) * face.frame[1]  # approach direction
                nearest = float((vertices @ way).min())
                shift = min(0.0, nearest + gripper.depth - inside @ way)  # the palm stays outside
                point = inside + shift * way
                lever = float(np.linalg.norm(face.flat(point) - middle)) / size
                quality = _quality(lever, 1 - width / gripper.opening, -way, ways)
                for turn in (0.0, np.pi):
                    group.append(Grasp(part, _tool(point, way, face.normal, turn), way, quality, width))
            groups.append(sorted(group, key=lambda grasp: -round(grasp.quality, 6)))
    return groups


def _quality(lever: float, room: float, pull: Array, ways: Array) -> float:
    """Rate a grasp from 0 to 1: half for a short lever arm, a third for pulling along an exit, the rest for room."""
    along = max(0.0, float((ways @ pull).max(initial=0.0)))
    return 0.5 * max(0.0, 1.0 - 2 * lever) + 0.35 * along + 0.15 * room


def _tool(point: Array, z: Array, x: Array, turn: float) -> Array:
    """Return a tool frame at a point with a given z, and x turned about z from a given direction."""
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    y = _cross(z, x)
    made = np.eye(4)
    made[:3, 0] = np.cos(turn) * x + np.sin(turn) * y
    made[:3, 1] = np.cos(turn) * y - np.sin(turn) * x
    made[:3, 2] = z
    made[:3, 3] = point
    return made


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors; numpy's own is slow for single vectors."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _open_way(parts: PartShapes, part: int, there: NDArray[np.bool_], gripper: Gripper):
    """Return a test whether the gripper alone keeps clear of all other parts at a grasp and on the approach."""
    others = np.flatnonzero(there).tolist()
    obstacles, _ = make_obstacles([parts.pieces[other] for other in others if other != part])
    pieces = gripper.pieces
    low = np.array([piece.min(axis=0) for piece in pieces])
    high = np.array([piece.max(axis=0) for piece in pieces])
    center = (low + high) / 2
    radius = np.array([np.linalg.norm(p - c, axis=1).max() for p, c in zip(pieces, center, strict=True)])
    start = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    count = len(pieces)
    # The gripper slides along one axis: its approach to the part.
    bodies = Bodies(np.ones(count, np.int64), start, np.concatenate(pieces), center, radius, np.ones((count, 1)))
    rules = Rules(
        np.ones((count, len(obstacles.low)), bool),
        np.zeros((0, 2), np.int64),
        -1e9,
        np.zeros(count, bool),
        GRIPPER_MARGIN,
    )
    back = np.linalg.inv(gripper.tool)
    slides = np.linspace(0.0, -APPROACH_LENGTH, APPROACH_SAMPLES)[:, None]
    chain = Chain(np.eye(4)[:3].copy(), np.eye(4)[None, :3].copy(), np.ones(1, bool))
    work = make_work(chain, bodies, obstacles, rules)
    hits = np.empty(APPROACH_SAMPLES, np.int64)

    def test(grasp: Grasp) -> bool:
        pose = grasp.tool @ back
        # The slide is along z of the joint's frame; rotate z to the approach and the gripper back.
        turn = _tool(np.zeros(3), grasp.approach, pose[:3, int(np.argmin(np.abs(grasp.approach @ pose[:3, :3])))], 0.0)
        local = np.linalg.inv(turn) @ pose
        moved = Bodies(
            bodies.frame,
            bodies.start,
            np.ascontiguousarray(bodies.vertices @ local[:3, :3].T + local[:3, 3]),
            np.ascontiguousarray(center @ local[:3, :3].T + local[:3, 3]),
            radius,
            bodies.sweep,
        )
        check_many(slides, Chain(turn[:3].copy(), chain.origin, chain.prismatic), moved, obstacles, rules, work, hits)
        return bool((hits == CLEAR).all())

    return test
