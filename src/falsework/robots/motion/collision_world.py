"""Collision world of a cell: scenes at one instant, and collision queries for one moving robot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.robots.kernels.collision import CLEAR, Bodies, Query, Rules, check_many, distance_between, make_query
from falsework.robots.kernels.kernel_arrays import make_bodies, make_chain, make_obstacles, self_pairs
from falsework.robots.kernels.rrt_connect import edges_free
from falsework.robots.kinematics.forward import flange_pose, placed_bodies
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, Pieces, inverse_pose

NO_FLOOR = -1e9
"""Height of the floor of a cell without one, metres: below everything."""
_OBSTACLE, _ROBOT, _SUPPORT = -1, -2, -3
"""Owners of obstacles that are no parts."""
BLOCKED_MARGIN_SHARE = 0.5
"""Share of the margin below which an interval of an edge that is not proven free counts as blocked."""
BLOCKED_LENGTH = 0.0005
"""Lower bound of the same length where the margin is small, metres."""
_PLACED = 256
"""Configurations of arms whose pieces are kept."""


@dataclass(frozen=True, eq=False)
class Attached:
    """Part in a gripper."""

    part: int
    tool_from_part: Array
    """Pose of the part in the tool frame, shape (4, 4); a part at its place in the structure has the identity as its
    pose in the world, so for a part gripped there this is the inverse of the pose of the tool."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Configurations, present parts and loads at one instant; immutable."""

    configurations: tuple[Array, ...]
    """Joint values of every robot."""
    present: NDArray[np.bool_]
    """Which parts are in place in the structure, held or not; shape (parts,)."""
    attached: tuple[Attached | None, ...]
    """Part in the gripper of each robot; such a part is not `present`."""
    elsewhere: tuple[tuple[int, Array], ...] = ()
    """Parts lying elsewhere, with their pose (4, 4) relative to their place in the structure."""
    beside: frozenset[int] = frozenset()
    """Robots that move at the same instant, of which the moving robot is kept clear otherwise; their bases count."""

    @staticmethod
    def at_home(cell: Cell, parts: PartShapes) -> Scene:
        """Return all parts in place and all robots at home."""
        return Scene(cell.homes, np.ones(parts.part_count, bool), (None,) * cell.robot_count)

    def with_configuration(self, robot: int, values: ArrayLike) -> Scene:
        """Return the same scene with one robot in another configuration."""
        changed = list(self.configurations)
        changed[robot] = np.array(values, dtype=np.float64)
        return replace(self, configurations=tuple(changed))

    def with_removed(self, *parts: int) -> Scene:
        """Return the same scene without some parts."""
        present = self.present.copy()
        present[list(parts)] = False
        return replace(self, present=present)

    def with_attached(self, robot: int, part: int, tool: Array) -> Scene:
        """Return the same scene with a part removed by a robot whose tool frame is at `tool` in the world, (4, 4)."""
        return self._with_load(robot, part, Attached(part, inverse_pose(tool)))

    def with_put_down(self, robot: int, part: int, pose: Array) -> Scene:
        """Return the same scene with the load of a robot lying at a pose relative to its place, shape (4, 4)."""
        return self._with_load(robot, part, None, (part, pose))

    def _with_load(self, robot: int, part: int, load: Attached | None, *lying: tuple[int, Array]) -> Scene:
        attached = list(self.attached)
        attached[robot] = load
        elsewhere = (*(entry for entry in self.elsewhere if entry[0] != part), *lying)
        return replace(self.with_removed(part), attached=tuple(attached), elsewhere=elsewhere)


@dataclass(frozen=True)
class Contact:
    """Pairs that may touch during one motion; all others keep their distance.

    For an approach or a withdrawal: the gripper may touch the part that it grips. For the withdrawal of a part: the
    carried part may touch the parts, the floor and the obstacles that it leaves. The second rule is only safe along a
    straight line that the clearance table has proven free for the present parts; these pairs are not checked here.
    """

    gripper: frozenset[int] = frozenset()
    """Parts that the gripper of the moving robot may touch."""
    carried: frozenset[int] = frozenset()
    """Parts that the part in the gripper may touch."""
    carried_floor: bool = False
    """Whether the part in the gripper may touch the floor."""
    carried_supports: bool = False
    """Whether the part in the gripper may touch obstacles that it touches at its place."""


NO_CONTACT = Contact()
LIFT = Contact(carried_floor=True, carried_supports=True)
"""For the line on which a part that was withdrawn along the floor is lifted off it."""
PUT_DOWN = Contact(carried_floor=True)
"""For the lines on which a part is put down on the floor elsewhere, and lifted off it."""


def grasp_contact(part: int) -> Contact:
    """Return the pairs that may touch on the lines on which a gripper approaches a part or retreats from it."""
    return Contact(gripper=frozenset({part}))


def withdrawal_contact(scene: Scene, aside: Iterable[int] = ()) -> Contact:
    """Return the pairs that may touch on the line on which a part is withdrawn from the parts present in a scene.

    So may others that robots have moved aside for it.
    """
    carried = frozenset({*np.flatnonzero(scene.present).tolist(), *aside})
    return Contact(carried=carried, carried_floor=True, carried_supports=True)


@dataclass(frozen=True, eq=False)
class CollisionQuery:
    """Collision queries for one moving robot in a static scene; made by `CollisionWorld.view`.

    Not to be shared between threads, since queries reuse scratch arrays; make one query object per thread.
    """

    world: CollisionWorld
    scene: Scene
    robot: int
    arrays: Query = field(repr=False)
    """What compiled functions take."""
    links: NDArray[np.int64]
    """Link of each body, joints + 1 for the gripper, joints + 2 for the part; shape (bodies,)."""
    owners: NDArray[np.int64]
    """Part of each obstacle, negative where it is none; shape (obstacles,)."""
    body_names: tuple[str, ...]
    obstacle_names: tuple[str, ...]

    @property
    def model(self):
        """The moving arm."""
        return self.world.cell.robots[self.robot].model

    @property
    def margin(self) -> float:
        """Distance to keep, metres."""
        return float(self.arrays.rules.margin)

    @property
    def obstacles(self) -> list[Array]:
        """Vertices of each obstacle in the world, as `obstacle_names` has them."""
        found = self.arrays.obstacles
        return [found.vertices[a:b] for a, b in pairwise(found.start.tolist())]

    def under(self, contact: Contact, margin: float) -> CollisionQuery:
        """Return queries in the same scene under another contact rule and margin."""
        rules = self.world._rules(self.model, self.links, self.owners, contact, margin)
        return replace(self, arrays=self.arrays._replace(rules=rules))

    def hits(self, configurations: ArrayLike) -> NDArray[np.int64]:
        """Return the first pair that is too near for each configuration, or -1. Shape (batch, joints) to (batch,)."""
        values = np.ascontiguousarray(np.atleast_2d(configurations), dtype=np.float64)
        if values.shape[1] != self.model.joints:
            raise InputError(
                f"configurations have shape {values.shape}; {self.model.name} has {self.model.joints} joints"
            )
        found = np.empty(len(values), np.int64)
        check_many(values, self.arrays, found)
        return found

    def collides(self, configurations: ArrayLike) -> NDArray[np.bool_]:
        """Return whether any pair is nearer than the margin, (batch, joints) to (batch,); limits are not checked."""
        return self.hits(configurations) != CLEAR

    @property
    def resolution(self) -> float:
        """Motion of the farthest point in half an interval of an edge below which it counts as blocked, metres."""
        return max(BLOCKED_MARGIN_SHARE * self.margin, BLOCKED_LENGTH)

    def free_edges(self, path: Array) -> int:
        """Return the number of leading edges of a path that are proven free, shape (points, joints)."""
        return int(edges_free(np.ascontiguousarray(path), self.resolution, self.arrays))

    def is_free(self, path: Array) -> bool:
        """Return whether a path is proven free, shape (points, joints)."""
        return self.free_edges(path) == len(path) - 1

    def pair(self, hit: int) -> tuple[str, str]:
        """Return names of the two bodies of a hit, such as `("left link_4", "part 7")`."""
        count, many = len(self.body_names), len(self.obstacle_names)
        if hit < count * many:
            return self.body_names[hit // many], self.obstacle_names[hit % many]
        if hit < count * many + count:
            return self.body_names[hit - count * many], "floor"
        a, b = self.arrays.rules.self_pairs[hit - count * many - count]
        return self.body_names[a], self.body_names[b]

    def explain(self, configuration: ArrayLike) -> tuple[str, str] | None:
        """Return the names of the first pair that is too near at one configuration, or None."""
        hit = int(self.hits(configuration)[0])
        return None if hit == CLEAR else self.pair(hit)


class CollisionWorld:
    """Cell with the parts of a structure; data that depends only on these is computed once."""

    def __init__(self, cell: Cell, parts: PartShapes) -> None:
        self.cell = cell
        self.parts = parts
        self._resting: dict[int, tuple[int, ...]] = {}
        self.chains = [make_chain(robot.model, robot.base) for robot in cell.robots]
        self._placed: dict[tuple[int, bytes], list[tuple[str, int, Array]]] = {}

    @cached_property
    def _static(self) -> tuple[tuple[str, Pieces], ...]:
        """Bases of robots and obstacles, in the world frame."""
        found = [
            (f"{robot.name} {robot.model.link_names[0]}", tuple(apply(robot.base, p) for p in robot.model.pieces[0]))
            for robot in self.cell.robots
        ]
        return (*found, *((obstacle.name, obstacle.pieces) for obstacle in self.cell.obstacles))

    def _supports(self, part: int) -> tuple[int, ...]:
        """Return the obstacles that a part touches at its place, by their indices in `_static`."""
        if part not in self._resting:
            near = self.cell.margins.line
            self._resting[part] = tuple(
                index
                for index, (_, pieces) in enumerate(self._static)
                if index >= self.cell.robot_count
                and any(distance_between(a, b) <= near for a in self.parts.pieces[part] for b in pieces)
            )
        return self._resting[part]

    def carried(self, robot: int, held: Attached) -> Pieces:
        """Return the pieces of a load of a robot, in the frame of the flange."""
        pose = self.cell.robots[robot].gripper.tool @ held.tool_from_part
        return tuple(apply(pose, piece) for piece in self.parts.pieces[held.part])

    def robot_pieces(self, robot: int, scene: Scene) -> list[tuple[str, int, Array]]:
        """Return all moving pieces of a robot in the world: name, link (gripper joints + 1, part + 2), vertices."""
        held, values = scene.attached[robot], np.asarray(scene.configurations[robot], dtype=np.float64)
        key = robot, values.tobytes()
        if held is None and key in self._placed:
            return self._placed[key]
        bodies, names, links = self.bodies(robot, held)
        placed = placed_bodies(self.chains[robot], bodies, values)
        found = [piece for piece in zip(names, links, placed, strict=True) if piece[1]]  # the base does not move
        if held is None:
            if len(self._placed) >= _PLACED:
                self._placed.clear()
            self._placed[key] = found
        return found

    def bodies(self, robot: int, held: Attached | None) -> tuple[Bodies, tuple[str, ...], tuple[int, ...]]:
        """Return the bodies of a robot with its load, their names, and the link of each as of `make_bodies`."""
        entry = self.cell.robots[robot]
        carried = None if held is None else (f"part {self.parts.names[held.part]}", self.carried(robot, held))
        bodies, names, links = make_bodies(entry, carried)
        own = entry.model.joints + 1
        return bodies, tuple(f"{entry.name} {n}" if k <= own else n for n, k in zip(names, links, strict=True)), links

    def grip_distance(self, robot: int, configuration: ArrayLike, part: int) -> float:
        """Return the distance between a gripper and a part in place, metres; 0 where they touch."""
        entry = self.cell.robots[robot]
        flange = flange_pose(entry.model, configuration, entry.base)
        placed = [apply(flange, piece) for piece in entry.gripper.pieces]
        return min((float(distance_between(a, b)) for a in placed for b in self.parts.pieces[part]), default=np.inf)

    def view(
        self, scene: Scene, robot: int, *, contact: Contact = NO_CONTACT, margin: float | None = None
    ) -> CollisionQuery:
        """Prepare collision queries for one moving robot in a static scene.

        Args:
            scene: poses of everything; the configuration of `robot` in it is ignored.
            contact: pairs that may touch.
            margin: distance to keep, metres; by default that of free motions.
        """
        if not 0 <= robot < self.cell.robot_count:
            raise InputError(
                f"no robot {robot}; the cell has {self.cell.robot_count}, 0 to {self.cell.robot_count - 1}"
            )
        entry = self.cell.robots[robot]
        load, stands = scene.attached[robot], list[tuple[str, int, Pieces]]()
        bodies, names, kinds = self.bodies(robot, load)
        supports = () if load is None else self._supports(load.part)
        for index, (name, pieces) in enumerate(self._static):
            if index != robot:
                fixed = _SUPPORT if index in supports else _OBSTACLE
                stands.append((name, _ROBOT if index < self.cell.robot_count else fixed, pieces))
        for other in range(self.cell.robot_count):
            if other != robot and other not in scene.beside:
                held, part_link = scene.attached[other], self.cell.robots[other].model.joints + 2
                for name, link, piece in self.robot_pieces(other, scene):
                    carried = held is not None and link == part_link
                    stands.append((name, held.part if held is not None and carried else _ROBOT, (piece,)))
        for part in np.flatnonzero(scene.present).tolist():
            stands.append((f"part {self.parts.names[part]}", part, self.parts.pieces[part]))
        for part, pose in scene.elsewhere:
            pieces = tuple(apply(pose, piece) for piece in self.parts.pieces[part])
            stands.append((f"part {self.parts.names[part]}", part, pieces))
        obstacles, owner = make_obstacles([pieces for _, _, pieces in stands])
        links, owners = np.array(kinds), np.array([part for _, part, _ in stands], np.int64)[owner]
        if margin is None:
            margin = self.cell.margins.free
        rules = self._rules(entry.model, links, owners, contact, margin)
        return CollisionQuery(
            world=self,
            scene=scene,
            robot=robot,
            arrays=make_query(self.chains[robot], bodies, obstacles, rules),
            links=links,
            owners=owners,
            body_names=names,
            obstacle_names=tuple(stands[index][0] for index in owner),
        )

    def _rules(
        self, model: RobotModel, links: NDArray[np.int64], owners: NDArray[np.int64], contact: Contact, margin: float
    ) -> Rules:
        """Return the pairs of a query that are checked."""
        gripper, load = links == model.joints + 1, links == model.joints + 2
        pair = np.ones((len(links), len(owners)), bool)
        pair[links == 0] = False  # the base is fixed; other robots are checked against it when they move
        pair[np.ix_(gripper, np.isin(owners, list(contact.gripper)))] = False
        pair[np.ix_(load, np.isin(owners, list(contact.carried)))] = False
        on_floor = np.full(len(links), self.cell.floor is not None)
        on_floor[links == 0] = False
        if contact.carried_floor:
            on_floor[load] = False
        if contact.carried_supports:
            pair[np.ix_(load, owners == _SUPPORT)] = False
        return Rules(
            pair=pair,
            self_pairs=self_pairs(model, links.tolist()),
            floor=NO_FLOOR if self.cell.floor is None else float(self.cell.floor),
            on_floor=on_floor,
            margin=float(margin),
        )
