"""Collision checker with Pinocchio and Coal: independent code and geometry for verifying robot plans.

Parts are represented by their exact surfaces, and links by the meshes of their description where it has meshes; the
planner's convex pieces of either are not used. Links of built-in arms, grippers and obstacles are described as convex
pieces, so these are checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.geometry.mesh.collision import shrink
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.robots.plans.loads import Load
from falsework.utils.lazy import importing

WORLD = 0
"""Index of Pinocchio's fixed joint."""


@dataclass(frozen=True, eq=False)
class CollisionBody:
    """Body in a collision check."""

    name: str
    shape: Any
    joint: int
    placement: Array
    """Pose in the frame of the joint, shape (4, 4)."""
    against: frozenset[int] | None = None
    """If given, the body is checked only against these parts in place, shrunk like the body itself."""
    slack: float = 0.0
    """Distance by which it is shrunk, metres."""
    spared: frozenset[int] = frozenset()
    """Parts in place that it is not checked against."""


class PreparedQuery:
    """Prepared collision check: one robot moves, everything else is fixed."""

    def __init__(
        self, checker: PinocchioCollisionChecker, robot: int, geometry: Any, names: Sequence[str], values: Array
    ) -> None:
        """Take the joint values of all robots; those of the moving one are filled in for each sample."""
        self.robot, self.geometry, self.names, self.values = robot, geometry, names, values
        pinocchio, self.model, self.slots = import_pinocchio()[0], checker.model, checker.slots
        self.data, self.found = self.model.createData(), pinocchio.GeometryData(geometry)
        # It points into what was found, which must outlive it.
        self.manager = pinocchio.BroadPhaseManager_DynamicAABBTreeCollisionManager(self.model, geometry, self.found)

    def hits(self, configuration: Array, others: Mapping[int, Array] | None = None) -> tuple[str, str] | None:
        """Return the names of the first two bodies that collide at joint values of the moving robot, or None.

        `others` has those of robots that move at the same instant.
        """
        pinocchio, _ = import_pinocchio()
        for robot, values in {**(others or {}), self.robot: configuration}.items():
            self.values[self.slots[robot]] = values
        if not pinocchio.computeCollisions(self.model, self.data, self.manager, self.values, True):
            return None
        pinocchio.computeCollisions(self.model, self.data, self.geometry, self.found, self.values, False)
        for pair, result in zip(self.geometry.collisionPairs, self.found.collisionResults, strict=True):
            if result.isCollision():
                return self.names[pair.first], self.names[pair.second]
        return None


class PinocchioCollisionChecker:
    """Cell and parts of a structure as models of Pinocchio and Coal."""

    def __init__(self, cell: Cell, parts: PartShapes, tolerance: float) -> None:
        """Let parts that may touch their neighbours be shrunk by a tolerance, metres."""
        self.cell, self.parts, self.tolerance = cell, parts, tolerance
        pinocchio, coal = import_pinocchio()
        self._pin, self._coal = pinocchio, coal
        self.model = pinocchio.Model()
        self.slots: list[slice] = []
        self._joints: list[list[int]] = []
        for robot in cell.robots:
            self._add_chain(robot)
        self._links = [self._link_shapes(robot.model) for robot in cell.robots]
        self._grippers = [[convex_shape(piece) for piece in robot.gripper.pieces] for robot in cell.robots]
        self._obstacles = [(o.name, convex_shape(p)) for o in cell.obstacles for p in o.pieces]
        self._parts = [self._surface(mesh, mesh.vertices) for mesh in parts.meshes]
        self._shrunken: dict[tuple[int, float], Any] = {}
        self._looseness: dict[int, list[tuple[float, frozenset[int]]]] = {}
        self.slack = tolerance
        """Largest distance by which a part had to be shrunk so far, metres."""
        self._data, self._values = self.model.createData(), np.zeros(self.model.nq)
        self._floor = coal.Box(np.array([100.0, 100.0, 1.0]))

    def prepare(
        self,
        robot: int,
        configurations: Sequence[Array],
        present: NDArray[np.bool_],
        *,
        load: Load | None = None,
        touches: int | None = None,
        at_place: bool = False,
        loads: Mapping[int, Load] | None = None,
        waits: Mapping[int, Array] | None = None,
    ) -> PreparedQuery:
        """Prepare the check of one moving robot; others may move at the same time.

        Args:
            configurations: joint values of all robots; those of the moving one are ignored.
            present: parts in place, shape (parts,).
            load: part in the gripper, or put down; against fixed bodies `obstructs` checks the latter.
            touches: part that the gripper may touch: to it the gripper is checked against the part, shrunk by
                `Gripper.press_depth`.
            at_place: whether the carried part starts or ends at its place, or on the floor; it is then shrunk by the
                tolerance, since it touches its neighbours there.
            loads: parts that other robots carry or have put down.
            waits: displacements of parts that wait half way out, shape (4, 4).
        """
        moving = self._robot_bodies(robot)
        joints = self.cell.robots[robot].model.joints
        standing = self._standing(robot, present)
        lying = load is not None and load.lies
        if load is not None:
            found = self._loaded(robot, load, at_place)
            moving += [(joints + 3 if lying else joints + 2, body) for body in found]
            standing += [("lying part", load.part, body) for body in found if lying]
        waiting = dict(waits or {}) | ({load.part: load.pose} if load is not None and lying else {})
        for other, others in (loads or {}).items():
            standing += [("robot", other, body) for body in self._loaded(other, others, False)]
        standing += [("lying part", part, self.standing_part(part, pose)) for part, pose in (waits or {}).items()]
        for _, body in moving:
            for number in sorted(body.against or ()):
                if present[number]:
                    shrunk = self._shrunk(number, body.slack)
                    name = f"part {self.parts.names[number]}"
                    made = CollisionBody(name, shrunk, WORLD, np.eye(4), slack=body.slack)
                    standing.append(("shrunk part", number, made))
        if touches is not None and (touches in waiting or present[touches]):
            standing.append(("touched part", touches, self._touched(robot, touches, waiting.get(touches))))
        bodies = [body for _, body in moving] + [body for _, _, body in standing]
        geometry = self._pin.GeometryModel()
        for number, body in enumerate(bodies):
            placement = self._pin.SE3(body.placement[:3, :3], body.placement[:3, 3])
            entry = self._pin.GeometryObject(f"{number} {body.name}", body.joint, WORLD, placement, body.shape)
            geometry.addGeometryObject(entry)
        ignored = self.cell.robots[robot].model.ignored
        for a, (link, body) in enumerate(moving):
            for b, (other, _) in enumerate(moving[:a]):
                if body.against is None and self._against_itself(link, other, joints, ignored):
                    geometry.addCollisionPair(self._pin.CollisionPair(b, a))
            for b, (what, number, other_body) in enumerate(standing, len(moving)):
                if what == "touched part":
                    if link == joints + 1:
                        geometry.addCollisionPair(self._pin.CollisionPair(a, b))
                    continue
                if what == "base" and (0, link) in ignored:
                    continue
                if what == "part" and number in body.spared:
                    continue
                if what in ("part", "lying part") and link == joints + 1 and number == touches:
                    continue
                if link == joints + 3 and what in ("lying part", "floor"):
                    continue
                tangled = body.against is not None and number in body.against and other_body.slack == body.slack
                if (body.against is not None or what == "shrunk part") and not (what == "shrunk part" and tangled):
                    continue
                geometry.addCollisionPair(self._pin.CollisionPair(a, b))
        values = np.concatenate([np.asarray(entry, float) for entry in configurations])
        return PreparedQuery(self, robot, geometry, [body.name for body in bodies], values)

    def obstructs(self, load: Load, present: NDArray[np.bool_]) -> str | None:
        """Return the name of a fixed body that a part put down collides with, the floor aside; None if it lies free."""
        for what, _, body in self._standing(0, present):
            fixed = body.joint == WORLD and what != "floor"
            if fixed and self._collide(body.shape, body.placement, self._parts[load.part], load.pose):
                return body.name
        return None

    def grip_distance(self, robot: int, configuration: Array, part: int, pose: Array | None = None) -> float:
        """Return the distance between a gripper and a part in place, or displaced by a pose; 0 m where they touch."""
        there, here = self._at(self.flange(robot, configuration)), self._at(np.eye(4) if pose is None else pose)
        request, result = self._coal.DistanceRequest(), self._coal.DistanceResult()
        gaps = [
            self._coal.distance(piece, there, self._parts[part], here, request, result)
            for piece in self._grippers[robot]
        ]
        return max(min(gaps, default=np.inf), 0.0)

    def is_pierced(self, robot: int, configuration: Array, part: int, pose: Array | None = None) -> bool:
        """Return whether a gripper reaches deeper into a part, in place or displaced, than it may press into it."""
        flange, body = self.flange(robot, configuration), self._touched(robot, part, pose)
        return any(self._collide(piece, flange, body.shape, body.placement) for piece in self._grippers[robot])

    def flange(self, robot: int, configuration: Array) -> Array:
        """Return the pose of a flange in the world, shape (4, 4)."""
        frame = self.frames(robot, configuration, self._joints[robot][-1:])[0]
        return frame @ self.cell.robots[robot].model.flange

    def frames(self, robot: int, configuration: Array, joints: Sequence[int]) -> Array:
        """Return the poses of Pinocchio's joints of an arm in the world, shape (joints, 4, 4)."""
        self._values[self.slots[robot]] = configuration
        self._pin.forwardKinematics(self.model, self._data, self._values)
        return np.array([self._data.oMi[joint].homogeneous for joint in joints])

    def arm(self, robot: int, load: Load | None = None) -> list[CollisionBody]:
        """Return the moving bodies of an arm, in full size, with the part that it carries or has put down."""
        loaded = [] if load is None else self._loaded(robot, load, False)
        return [body for _, body in self._robot_bodies(robot)] + loaded

    def standing_part(self, part: int, pose: Array | None = None) -> CollisionBody:
        """Return a part in place, or displaced by a pose, shape (4, 4), in full size."""
        name = f"part {self.parts.names[part]}"
        return CollisionBody(name, self._parts[part], WORLD, np.eye(4) if pose is None else pose)

    def _add_chain(self, robot) -> None:
        pin, model = self._pin, robot.model
        parent, joints, placement = WORLD, [], robot.base
        begin = self.model.nq
        for j in range(model.joints):
            origin = placement @ model.origins[j]
            kind = pin.JointModelPrismaticUnaligned if model.prismatic[j] else pin.JointModelRevoluteUnaligned
            axis = np.array(model.axes[j], dtype=float)
            frame = pin.SE3(np.array(origin[:3, :3]), np.array(origin[:3, 3]))
            parent = self.model.addJoint(parent, kind(axis), frame, f"{robot.name} {model.joint_names[j]}")
            joints.append(parent)
            placement = np.eye(4)
        self._joints.append(joints)
        self.slots.append(slice(begin, self.model.nq))

    def _robot_bodies(self, robot: int) -> list[tuple[int, CollisionBody]]:
        """Return the moving bodies with the link of each, `joints + 1` for the gripper."""
        entry = self.cell.robots[robot]
        found = []
        for link in range(1, entry.model.joints + 1):
            name = f"{entry.name} {entry.model.link_names[link]}"
            for shape in self._links[robot][link]:
                found.append((link, CollisionBody(name, shape, self._joints[robot][link - 1], np.eye(4))))
        for shape in self._grippers[robot]:
            body = CollisionBody(f"{entry.name} gripper", shape, self._joints[robot][-1], entry.model.flange)
            found.append((entry.model.joints + 1, body))
        return found

    def _loaded(self, robot: int, load: Load, at_place: bool) -> list[CollisionBody]:
        """Return the load of a robot; where it may touch its neighbours, once for each shrinking distance."""
        entry, part = self.cell.robots[robot], load.part
        if load.grip is None:
            return [self.standing_part(part, load.pose)]
        placement = entry.model.flange @ inverse_pose(self.flange(robot, load.grip)) @ load.pose
        name, joint = f"part {self.parts.names[part]}", self._joints[robot][-1]
        if not at_place:
            return [CollisionBody(name, self._parts[part], joint, placement)]
        (least, _), *more = self.loose(part)
        tangled: frozenset[int] = frozenset().union(*(others for _, others in more))
        found = [CollisionBody(name, self._shrunk(part, least), joint, placement, spared=tangled)]
        return found + [
            CollisionBody(name, self._shrunk(part, slack), joint, placement, against=others, slack=slack)
            for slack, others in more
        ]

    def _touched(self, robot: int, part: int, pose: Array | None) -> CollisionBody:
        """Return a part that the gripper of a robot touches, shrunk by how far it may press into it."""
        shape = self._shrunk(part, self.cell.robots[robot].gripper.press_depth)
        return replace(self.standing_part(part, pose), shape=shape)

    def _shrunk(self, part: int, slack: float) -> Any:
        if (part, slack) not in self._shrunken:
            mesh = self.parts.meshes[part]
            self._shrunken[part, slack] = self._surface(mesh, shrink(mesh, min(slack, mesh.thickness / 4)))
        return self._shrunken[part, slack]

    def loose(self, part: int) -> list[tuple[float, frozenset[int]]]:
        """Return the distances by which a part is shrunk where it may touch its neighbours, and the neighbours of each.

        The tolerance, as long as the part does not collide with them in place then. Where the meshes themselves overlap
        by more, both are shrunk, doubling the distance until they separate, and once more for the motion; at
        most by a quarter of their thickness. The clearance table treats such pairs in the same way.
        """
        if part in self._looseness:
            return self._looseness[part]
        (low, high), place = self.parts.meshes[part].bounds, np.eye(4)
        left = {
            number
            for number, other in enumerate(self.parts.meshes)
            if number != part and (other.bounds[0] <= high).all() and (other.bounds[1] >= low).all()
        }
        tangled = {
            other
            for other in left
            if self._collide(self._shrunk(part, self.tolerance), place, self._parts[other], place)
        }
        slack, found = self.tolerance, [(self.tolerance, frozenset(left - tangled))]
        while tangled:
            slack *= 2
            last = slack > self.parts.meshes[part].thickness / 4
            apart = {
                other
                for other in tangled
                if last or not self._collide(self._shrunk(part, slack), place, self._shrunk(other, slack), place)
            }
            if apart:
                found.append((2 * slack, frozenset(apart)))
                self.slack = max(self.slack, min(2 * slack, self.parts.meshes[part].thickness / 4))
            tangled -= apart
        self._looseness[part] = found
        return found

    def _at(self, pose: Array) -> Any:
        return self._coal.Transform3s(pose[:3, :3], pose[:3, 3])

    def _collide(self, one: Any, here: Array, other: Any, there: Array) -> bool:
        """Return whether two shapes at some poses collide."""
        request, result = self._coal.CollisionRequest(), self._coal.CollisionResult()
        return bool(self._coal.collide(one, self._at(here), other, self._at(there), request, result))

    def _standing(self, robot: int, present: NDArray[np.bool_]) -> list[tuple[str, int, CollisionBody]]:
        found: list[tuple[str, int, CollisionBody]] = []
        for other, entry in enumerate(self.cell.robots):
            name = f"{entry.name} {entry.model.link_names[0]}"
            kind = "base" if other == robot else "robot"
            found += [(kind, other, CollisionBody(name, shape, WORLD, entry.base)) for shape in self._links[other][0]]
            if other != robot:
                found += [("robot", other, body) for _, body in self._robot_bodies(other)]
        for part in np.flatnonzero(present).tolist():
            found.append(("part", part, self.standing_part(part)))
        found += [
            ("obstacle", k, CollisionBody(name, shape, WORLD, np.eye(4)))
            for k, (name, shape) in enumerate(self._obstacles)
        ]
        if self.cell.floor is not None:
            below = np.eye(4)
            below[2, 3] = self.cell.floor - 0.5
            found.append(("floor", 0, CollisionBody("floor", self._floor, WORLD, below)))
        return found

    @staticmethod
    def _against_itself(one: int, other: int, joints: int, ignored: frozenset[tuple[int, int]]) -> bool:
        """Return whether two bodies of one arm are checked: not neighbours, nor the gripper with its own wrist."""
        low, high = sorted((one, other))
        if high <= joints:
            return low != high and (low, high) not in ignored
        return low < (joints - 1 if high == joints + 1 else joints)

    def _link_shapes(self, model: RobotModel) -> list[list[Any]]:
        """Return the shapes of every link: the triangles of its meshes, or its convex pieces if there are no meshes."""
        if model.meshes is None:
            return [[convex_shape(piece) for piece in link] for link in model.pieces]
        return [[self._triangles(mesh.vertices, mesh.faces) for mesh in link] for link in model.meshes]

    def _surface(self, mesh: TriangleMesh, vertices: Array) -> Any:
        """Return a convex solid if the part is convex, else its triangles."""
        hull = ConvexHull(vertices)
        corners = vertices[mesh.faces]
        volume = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        if hull.volume - volume <= 1e-6 * hull.volume:
            return convex_shape(vertices[hull.vertices])
        return self._triangles(vertices, mesh.faces)

    def _triangles(self, vertices: Array, faces: NDArray[np.int32]) -> Any:
        made = self._coal.BVHModelOBBRSS()
        made.beginModel(len(faces), len(vertices))
        made.addVertices(np.ascontiguousarray(vertices, dtype=float))
        made.addTriangles(np.ascontiguousarray(faces, dtype=np.int64))
        made.endModel()
        return made


def convex_shape(points: Array) -> Any:
    """Return the convex hull of points as a shape of Coal."""
    _, coal = import_pinocchio()
    vertices = coal.StdVec_Vec3s()
    vertices.extend([np.array(point, dtype=float) for point in points])
    return coal.ConvexBase.convexHull(vertices, True, None)


def import_pinocchio() -> tuple[Any, Any]:
    """Return the modules Pinocchio and Coal; DependencyError without them."""
    with importing("checking robot plans needs Pinocchio and Coal; install them: pip install 'falsework[robots]'"):
        import coal
        import pinocchio
    return pinocchio, coal
