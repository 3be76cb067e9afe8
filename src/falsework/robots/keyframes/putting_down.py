"""Parts put down on the floor on their way, to be gripped again in a way in which they can be delivered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, product

import numpy as np
from scipy.spatial import ConvexHull
from shapely import MultiPoint, Point, Polygon

from falsework.geometry.arrays import apply
from falsework.robots.grasping.grasp import Grasp
from falsework.robots.kernels.collision import distance_between
from falsework.robots.keyframes.grasp_configurations import GraspConfigurations
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.keyframes.withdrawal import Reaching, lifted
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.shapes import Array, inverse_pose, least_turn, move_pieces
from falsework.robots.model.shapes import pose as upright
from falsework.robots.motion.collision_world import PUT_DOWN, Scene, grasp_contact

_MOST_FACES = 6
"""Faces on which a part is put down, those for which it turns least first."""
_YAWS = 8
"""Turns about the vertical in which it is put down."""
_RADII = np.linspace(0.4, 1.3, 7)
"""Distances from the base of the robot, in that of the place of the part."""
_ANGLES = 24
"""Directions from the base."""
_STEADY = 0.1
"""Least distance of the centre of mass from the edges of the face, in square roots of its area."""
_MOST_GRASPS = 24
"""Grasps in which the part can be delivered that are tried."""
_MOST_PLACES = 12
"""Places where the robot can put the part down that are tried with these grasps."""
_MOST_POSES = 1000
"""Free poses on the floor for which the robot is tried."""
_MOST_LINES = 100
"""Configurations of the robot with the part on the floor from which it is tried to lift it."""
_MOST_MOTIONS = 6
"""Grasps at one place to which a motion of the empty gripper is tried."""
_DOWN = np.array([0.0, 0.0, -1.0])
_LIFT = 0.5
"""Length of the line on which a part is put down or lifted, in approach margins of the cell."""


@dataclass(frozen=True, eq=False)
class Detour:
    """Paths on which a part is put down, gripped again and delivered."""

    segments: tuple[PathSegment, ...]
    pose: Array
    """Displacement of the part from its place while it lies, shape (4, 4)."""
    end: Array
    """Configuration at the drop-off, shape (joints,)."""


@dataclass(frozen=True, eq=False)
class _Down:
    """Part put down at a place, its robot still there."""

    pose: Array
    segments: tuple[PathSegment, ...]
    scene: Scene
    """With the part on the floor."""
    retreat: Array
    """Line on which the empty gripper leaves, shape (points, joints)."""


class PuttingDown:
    """Detours by way of the floor for parts whose grasp allows no delivery."""

    def __init__(self, grips: GraspConfigurations, reaching: Reaching) -> None:
        self.cell, self.parts, self.cache, self.reasons = grips.cell, grips.parts, grips.cache, grips.reasons
        self._grips, self._reaching = grips, reaching
        self._faces: dict[int, list[Array]] = {}

    def detour(self, part: int, robot: int, here: Array, end: Array, scene: Scene) -> Detour | None:
        """Return a detour for a part that a robot has withdrawn but cannot deliver; None if none is found.

        `here` and `end` are its configurations before and after the withdrawal; in the scene the part is carried.
        """
        if self.cell.floor is None:
            return None
        wanted = self._deliverable(scene, part, robot)
        if not wanted:
            self.reasons.add("remove", part, robot, "every grasp collides at every drop-off pose")
            return None
        for down in islice(self._downs(scene, part, robot, here, end), _MOST_PLACES):
            for found in self._again(down, scene, part, robot, wanted):
                return found
        self.reasons.add("remove", part, robot, "no place on the floor from which it can be gripped again")
        return None

    def lies_free(self, scene: Scene, part: int, robot: int, pose: Array) -> bool:
        """Return whether a part that a robot carries in a scene can lie at a pose relative to its place."""
        return self._is_free(part, pose, self._fixed(scene, robot))

    def _deliverable(self, scene: Scene, part: int, robot: int) -> list[tuple[Grasp, Array]]:
        """Return grasps of the part, each with the drop-off configurations that are free with it, shape (n, joints)."""
        places, alone = self._grips.places(robot), np.zeros(self.parts.part_count, bool)
        alone[part] = True
        found: list[tuple[Grasp, Array]] = []
        if not len(places):
            return found
        for grasp in self._grips.grasps(part, alone, self.cell.robots[robot].gripper):
            carried = scene.with_attached(robot, part, grasp.tool)
            free = places[self.cache.view(carried, robot).hits(places) < 0]
            if len(free):
                found.append((grasp, free))
            if len(found) == _MOST_GRASPS:
                break
        return found

    def _downs(self, scene: Scene, part: int, robot: int, here: Array, end: Array) -> Iterator[_Down]:
        """Yield places to which the robot can bring the part, nearest first, and leave it there."""
        entry = self.cell.robots[robot]
        tool, line = tool_pose(entry, here), self.cache.view(scene, robot, PUT_DOWN)
        lines = 0
        for pose in islice(self._poses(scene, part, robot), _MOST_POSES):
            values = inverse(entry, (pose @ tool)[None])[0]
            if not len(values):
                continue
            values = values[line.hits(values) < 0]
            for at in values[np.argsort(np.abs(values - end).max(axis=1), kind="stable")]:
                lines += 1
                if lines > _MOST_LINES:
                    return
                up = lifted(self.cache, scene, robot, at, PUT_DOWN, _LIFT)
                if up is None:
                    continue
                lying = scene.with_put_down(robot, part, pose)
                retreat = self._leave(lying, part, robot, at)
                way = None if retreat is None else self.cache.motion(scene, robot, end, up[-1]).path
                if retreat is None or way is None:
                    continue
                over = PathSegment("free", way, part=part, view=self.cache.view(scene, robot))
                yield _Down(pose, (over, PathSegment("line", up[::-1].copy(), part=part)), lying, retreat)
                break

    def _again(
        self, down: _Down, scene: Scene, part: int, robot: int, wanted: list[tuple[Grasp, Array]]
    ) -> Iterator[Detour]:
        """Yield detours over one place, the grasps nearest to the robot there first."""
        entry = self.cell.robots[robot]
        view, clear = self.cache.view(down.scene, robot, grasp_contact(part)), self.cache.view(down.scene, robot)
        branches = inverse(entry, np.array([down.pose @ grasp.tool for grasp, _ in wanted]))
        which = np.repeat(np.arange(len(wanted)), [len(values) for values in branches])
        values = np.concatenate(branches)
        good = np.flatnonzero(view.hits(values) < 0) if len(values) else np.zeros(0, np.int64)
        motions, far = 0, np.abs(values[good] - down.retreat[-1]).max(axis=1)
        for row in good[np.argsort(far, kind="stable")].tolist():
            at, goals = values[row], wanted[which[row]][1]
            carried = scene.with_attached(robot, part, inverse_pose(down.pose) @ tool_pose(entry, at))
            up = lifted(self.cache, carried, robot, at, PUT_DOWN, _LIFT)
            if up is None:
                continue
            approach = self._leave(down.scene, part, robot, at)
            if approach is None:
                continue
            motions += 1
            if motions > _MOST_MOTIONS:
                return
            across = self.cache.motion(down.scene, robot, down.retreat[-1], approach[-1]).path
            if across is None:
                continue
            for goal in goals[np.argsort(np.abs(goals - up[-1]).max(axis=1), kind="stable")]:
                away = self.cache.motion(carried, robot, up[-1], goal).path
                if away is not None:
                    segments = (
                        *down.segments,
                        PathSegment("line", down.retreat, touches=part),
                        PathSegment("free", across, view=clear),
                        PathSegment("line", approach[::-1].copy(), touches=part),
                        PathSegment("line", up, part=part),
                        PathSegment("free", away, part=part, view=self.cache.view(carried, robot)),
                    )
                    yield Detour(segments, down.pose, goal)
                    break

    def _poses(self, scene: Scene, part: int, robot: int) -> Iterator[Array]:
        """Yield poses in which the part lies free on the floor, as displacements from its place, nearest first."""
        center, base = self.parts.center[part], self.cell.robots[robot].base[:3, 3]
        far = float(np.linalg.norm(center[:2] - base[:2]))
        angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
        spots = base[:2] + far * np.array([(r * np.cos(a), r * np.sin(a)) for r, a in product(_RADII, angle)])
        spots = spots[np.argsort(np.linalg.norm(spots - center[:2], axis=1), kind="stable")]
        turns = list(product(self._standing(part), 2 * np.pi * np.arange(_YAWS) / _YAWS))
        pairs = np.array(list(np.ndindex(len(spots), len(turns)))).reshape(-1, 2)
        fixed = self._fixed(scene, robot)
        # Farther spots and other turns come in alternately: what fails at one spot often fails beside it.
        for number, which in pairs[
            np.argsort(pairs @ (1 / len(spots), 1 / max(len(turns), 1)), kind="stable")
        ].tolist():
            turn, yaw = turns[which]
            pose = np.array(upright(yaw=yaw))
            pose[:3, :3] = pose[:3, :3] @ turn
            pose[:2, 3] = spots[number] - (pose[:3, :3] @ center)[:2]
            pose[2, 3] = self.cell.floor - (self.parts.meshes[part].vertices @ pose[2, :3]).min()
            if self._is_free(part, pose, fixed):
                yield pose

    def _standing(self, part: int) -> list[Array]:
        """Return rotations that put a part on each face on which it stands, the least turn first."""
        if part not in self._faces:
            corners, center = self.parts.meshes[part].vertices, self.parts.center[part]
            planes = np.unique(np.round(ConvexHull(corners).equations, 6) + 0.0, axis=0)
            size = float(np.ptp(corners, axis=0).max())
            found = []
            for normal in planes[:, :3]:
                turn = least_turn(normal, _DOWN, np.array([1.0, 0.0, 0.0]))
                level = corners @ turn.T
                base = MultiPoint(level[level[:, 2] <= level[:, 2].min() + 1e-4 * size, :2]).convex_hull
                over = Point((turn @ center)[:2])
                if not isinstance(base, Polygon) or not base.contains(over):
                    continue
                if base.exterior.distance(over) >= _STEADY * np.sqrt(base.area):
                    found.append(turn)
            self._faces[part] = sorted(found, key=lambda turn: -round(float(np.trace(turn)), 6))[:_MOST_FACES]
        return self._faces[part]

    def _fixed(self, scene: Scene, robot: int) -> list[Array]:
        """Return the pieces of all that stays where it is while a robot moves, with the base of that robot."""
        entry = self.cell.robots[robot]
        return self.cache.view(scene, robot).obstacles + [apply(entry.base, p) for p in entry.model.pieces[0]]

    def _is_free(self, part: int, pose: Array, fixed: Sequence[Array]) -> bool:
        """Return whether a part at a pose keeps the margin of free motions from fixed pieces."""
        margin = self.cell.margins.free
        for piece in move_pieces(pose, self.parts.pieces[part]):
            low, high = piece.min(axis=0) - margin, piece.max(axis=0) + margin
            for other in fixed:
                apart = (other.min(axis=0) > high).any() or (other.max(axis=0) < low).any()
                if not apart and distance_between(np.array(piece), np.array(other)) <= margin:
                    return False
        return True

    def _leave(self, lying: Scene, part: int, robot: int, at: Array) -> Array | None:
        """Return the line on which an empty gripper leaves a part that lies on the floor; None if it is blocked."""
        way = -tool_pose(self.cell.robots[robot], at)[:3, 2]
        return self._reaching.retreat("remove", lying, part, robot, at, way)
