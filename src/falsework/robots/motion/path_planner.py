"""Motion planning of one robot among static obstacles: free paths, lines and turns of the tool, and a cache of both."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import InputError
from falsework.geometry.clearance.moves import PathMove
from falsework.robots.kernels.numeric_ik import reach_poses
from falsework.robots.kernels.rrt_connect import grow, shorten
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import tail_of
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import NO_CONTACT, CollisionQuery, CollisionWorld, Contact, Scene

LONGEST_EDGE = 1.0
"""Longest edge of a tree, rad in joint space."""
SHORTCUTS = 60
"""Shortcuts tried on a path found by the trees."""
SAMPLED_TURN = float(np.pi)
"""Joints with a larger range are sampled within it, unless start or goal lie outside, rad."""
ROUNDS_PER_CALL = 50
"""Rounds of tree growth between two deadline checks."""

LINE_STEP = 0.01
"""Initial distance between points of a line, metres; halved where the tool deviates or a joint moves too far."""
LINE_HALVINGS = 4
"""Halvings of that distance before the line counts as infeasible."""
LINE_DEVIATION = 0.0002
"""Largest distance of the tool from the line between two points, metres."""
TURN_STEP = 0.05
"""Initial angle between points of a turn, rad; halved like the distance."""
TURN_DEVIATION = 0.0005
"""Largest difference of an entry of the rotation of the tool from that of a turn between two points."""
LINE_JOINT_STEP = 0.2
"""Largest change of a joint from one point to the next, rad: more is a change of branch or a singularity."""

Reason = Literal[
    "found",
    "start outside limits",
    "goal outside limits",
    "start in collision",
    "goal in collision",
    "no connection",
    "no solution on the line",
    "joint limit on the line",
    "collision on the line",
]
_CACHED_SCENES = 128
"""Largest number of scenes whose query objects are cached; the oldest is evicted first."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Path of one robot, or the reason for its absence."""

    reason: Reason
    path: Array | None = None
    """Configurations connected by straight edges in joint space, proven free; shape (points, joints)."""
    pair: tuple[str, str] | None = None
    """Names of the bodies that came too near, where the reason is a collision."""
    at: Array | None = None
    """Configuration of the failure, shape (joints,)."""


def plan_free(view: CollisionQuery, start: ArrayLike, goal: ArrayLike, *, seed: int = 0, nodes: int = 4000) -> Motion:
    """Return a path from one configuration to another that keeps the margin of the view everywhere.

    The straight edge is tried first, then RRT-Connect, then the path is shortened by shortcuts. Every edge is
    proven free over its whole length (`rrt_connect.edge_free`). The same seed gives the same path.

    Args:
        start, goal: configurations, shape (joints,).
        nodes: largest number of nodes per tree, after which the search ends with "no connection".
    """
    model = view.model
    a, b = (np.ascontiguousarray(values, dtype=np.float64) for values in (start, goal))
    for values, which in ((a, "start"), (b, "goal")):
        if not model.within_limits(values):
            return Motion(f"{which} outside limits", at=values)  # type: ignore[arg-type]
        if pair := view.explain(values):
            return Motion(f"{which} in collision", pair=pair, at=values)  # type: ignore[arg-type]
    direct = np.stack([a, b])
    if view.is_free(direct):
        return Motion("found", direct)
    trees, met = np.empty((2, nodes, model.joints)), np.zeros(2, np.int64)
    trees[0, 0], trees[1, 0] = a, b
    parents = np.full((2, nodes), -1, np.int64)
    sizes = np.array([1, 1, 0])
    state = np.array([seed * 0x9E3779B97F4A7C15 % 2**64], np.uint64)
    low = np.minimum(np.maximum(model.lower, -SAMPLED_TURN), np.minimum(a, b))
    high = np.maximum(np.minimum(model.upper, SAMPLED_TURN), np.maximum(a, b))
    drawn = 0
    while True:
        grown = grow(
            trees, parents, sizes, low, high, LONGEST_EDGE, ROUNDS_PER_CALL, view.resolution, state, view.arrays, met
        )
        drawn += ROUNDS_PER_CALL
        if grown == 1:
            break
        if grown == -1 or drawn >= 10 * nodes:
            return Motion("no connection")
    path = _branch(trees[0], parents[0], int(met[0]))[::-1] + _branch(trees[1], parents[1], int(met[1]))
    room = np.empty((len(path) + 2 * SHORTCUTS + 2, model.joints))
    room[: len(path)] = path
    count = shorten(room, len(path), SHORTCUTS, view.resolution, state, view.arrays)
    return Motion("found", room[:count].copy())


def follow_line(view: CollisionQuery, start: ArrayLike, direction: ArrayLike, distance: float) -> Motion:
    """Move the tool along a straight line without rotation, as `follow_move`.

    Args:
        start: configuration at the start of the line, shape (joints,).
        direction: direction in the world, shape (3,); any length.
        distance: metres.
    """
    along = np.asarray(direction, dtype=np.float64)
    length = float(np.linalg.norm(along))
    if along.shape != (3,) or not length > 0 or not np.isfinite(length):
        raise InputError(f"direction is {direction!r}; give three numbers that are not all zero")
    if not distance > 0:
        raise InputError(f"the length of the line is {distance:g} m; give a distance above zero")
    return follow_move(view, start, PathMove.straight((), along / length, distance))


def follow_move(view: CollisionQuery, start: ArrayLike, move: PathMove, *, points: int = 2) -> Motion:
    """Move the tool in a line, a turn or a screw in the world, on one branch of the inverse kinematics.

    The contact rule of the view gives the pairs that may touch, its margin the distance to all others. The path is
    proven free between its points too; these are at equal shares of the move, `points` or more of them.
    """
    first = np.array(start, dtype=np.float64)
    if not view.model.within_limits(first):
        return Motion("start outside limits", at=first)
    if pair := view.explain(first):
        return Motion("start in collision", pair=pair, at=first)
    robot = view.world.cell.robots[view.robot]
    home = tool_pose(robot, first)
    arm = np.linalg.norm(np.cross(home[:3, 3] - np.array(move.point), move.direction))
    steps = max(np.hypot(move.distance, arm * move.angle) / LINE_STEP, abs(move.angle) / TURN_STEP)
    tail = tail_of(view.model, robot.gripper.tool)
    for halving in range(LINE_HALVINGS + 1):
        count = max(points - 1, int(np.ceil(steps * 2**halving)))
        targets = _poses(move, home, np.linspace(0.0, 1.0, count + 1))
        values = np.repeat(first[None], count + 1, axis=0)
        reached = np.zeros(count + 1, bool)
        wanted = np.ascontiguousarray(targets[:, :3])
        reach_poses(values, wanted, view.arrays.chain, tail, 20, 0.0, LINE_JOINT_STEP, True, reached)
        good = int(np.argmin(reached)) if not reached.all() else count + 1
        path = values[:good]
        smooth = (np.abs(np.diff(path, axis=0)).max(axis=1, initial=0.0) <= LINE_JOINT_STEP).all()
        if smooth and good > 1:
            middle = _poses(move, home, (np.arange(good - 1) + 0.5) / count)
            away = tool_pose(robot, (path[:-1] + path[1:]) / 2) - middle
            smooth = bool((np.linalg.norm(away[:, :3, 3], axis=1) <= LINE_DEVIATION).all())
            smooth &= not move.turns or bool((np.abs(away[:, :3, :3]) <= TURN_DEVIATION).all())
        if smooth and good == count + 1:
            break
        if halving == LINE_HALVINGS:
            return Motion("no solution on the line", at=path[-1])
    inside = view.model.within_limits(path)
    if not inside.all():
        bad = int(np.argmin(inside))
        return Motion("joint limit on the line", at=path[bad])
    free = view.free_edges(path)
    if free < len(path) - 1:
        return _blocked(view, path, free)
    return Motion("found", path)


def _poses(move: PathMove, home: Array, shares: Array) -> Array:
    """Return where a move brings a frame, shape (4, 4), after shares of it, shape (shares, 4, 4)."""
    if move.turns:
        return np.array([move.displacement(float(share)) for share in shares]).reshape(-1, 4, 4) @ home
    found = np.repeat(home[None], len(shares), axis=0)
    found[:, :3, 3] += np.outer(shares * move.distance, move.direction)
    return found


def _branch(tree: Array, parents: NDArray[np.int64], leaf: int) -> list[Array]:
    """Return configurations from a node to the root."""
    found = []
    while leaf >= 0:
        found.append(tree[leaf])
        leaf = int(parents[leaf])
    return found


def _blocked(view: CollisionQuery, path: Array, edge: int) -> Motion:
    """Return the failure on an edge that is not free."""
    for share in np.linspace(0, 1, 9):
        values = path[edge] + share * (path[edge + 1] - path[edge])
        if pair := view.explain(values):
            return Motion("collision on the line", pair=pair, at=values)
    return Motion("collision on the line", at=path[edge + 1])


class MotionCache:
    """Cache of collision queries and free motions of one collision world."""

    def __init__(self, world: CollisionWorld, *, nodes: int, seed: int) -> None:
        """Create an empty cache; `nodes` limits those of the trees of one free motion."""
        self.world = world
        self.motions = self.motions_kept = self.views = 0
        self._nodes, self._seed = nodes, seed
        self._motions: dict[bytes, Motion] = {}
        self._views: dict[bytes, dict[tuple[Contact, float], CollisionQuery]] = {}

    def motion(self, scene: Scene, robot: int, start: Array, goal: Array) -> Motion:
        """Return a free motion of one robot between configurations, with a seed that depends only on the arguments."""
        key = scene_digest(scene, robot) + np.round([start, goal], 6).tobytes()
        if key not in self._motions:
            self.motions += 1
            view = self.view(scene, robot)
            seed = (zlib.crc32(key) + self._seed) % 2**31
            self._motions[key] = plan_free(view, start, goal, seed=seed, nodes=self._nodes)
        else:
            self.motions_kept += 1
        return self._motions[key]

    def view(
        self, scene: Scene, robot: int, contact: Contact = NO_CONTACT, margin: float | None = None
    ) -> CollisionQuery:
        """Return the collision queries of one robot in a scene, with pairs that may touch and a margin in metres.

        The margin is by default that of lines if there is a contact rule, else that of free motions.
        """
        if margin is None:
            margins = self.world.cell.margins
            margin = margins.free if contact is NO_CONTACT else margins.line
        place, rules = scene_digest(scene, robot), (contact, margin)
        views = self._views.get(place)
        if views is None:
            while len(self._views) > _CACHED_SCENES:
                del self._views[next(iter(self._views))]
            views = self._views[place] = {}
        if rules not in views:
            self.views += 1
            known = next(iter(views.values()), None)
            views[rules] = (
                self.world.view(scene, robot, contact=contact, margin=margin)
                if known is None
                else known.under(contact, margin)
            )
        return views[rules]


def scene_digest(scene: Scene, robot: int) -> bytes:
    """Return a key of all data of a scene that a motion of one robot depends on."""
    away = {robot, *scene.beside}
    others = [np.round(values, 6) + 0.0 for other, values in enumerate(scene.configurations) if other not in away]
    pieces = [bytes([robot]), np.packbits(scene.present).tobytes(), *(values.tobytes() for values in others)]
    if scene.beside:
        pieces.append(bytes(sorted(scene.beside)))
    for owner, carried in enumerate(scene.attached):
        if carried is not None and owner not in scene.beside:
            who = np.array([owner, carried.part], dtype=np.int32)
            pieces.append(who.tobytes() + np.round(carried.tool_from_part, 7).tobytes())
    for part, pose in scene.elsewhere:
        pieces.append(np.array([part], dtype=np.int32).tobytes() + np.round(pose, 7).tobytes())
    return b"|".join(pieces)
