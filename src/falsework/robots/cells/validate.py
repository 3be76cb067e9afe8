"""Validation of a cell before any planning: bases, homes, tools and payloads; and proposals of free homes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from falsework.errors import CellError
from falsework.geometry.arrays import apply
from falsework.robots.kernels.collision import distance_between
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.cell import Cell, CellRobot
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, Pieces, looking_down
from falsework.robots.motion.collision_world import CollisionQuery, CollisionWorld, Scene
from falsework.robots.motion.near_pairs import NearPair, near_pairs, separation
from falsework.utils.quantity import format_quantity

_SAMPLES = 4000
"""Random configurations that are tried."""
_STEPS = (0.1, 0.3, 1.0)
"""Shares of the range of the joints within which they are drawn: near the given configuration first."""
_AHEAD, _HEIGHTS, _TURNS = (0.4, 0.5, 0.3), (0.4, 0.5, 0.3), 8
"""Distances in front of a base and heights above it, as shares of the reach, and rotations about the vertical, in which
the tool of an arm without a home is tried."""
_MARGIN = 0.02
"""Distance that a proposal keeps where it can, metres."""
BASE_DEPTH = 0.002
"""Largest penetration of a base into the surface below it, metres."""


def home_faults(cell: Cell, parts: PartShapes, robot: int) -> list[NearPair]:
    """Return which bodies are too near each other with one robot, and all others, at home."""
    view = CollisionWorld(cell, parts).view(Scene.at_home(cell, parts), robot)
    home = cell.robots[robot].home
    return near_pairs(view, home) if view.collides(home)[0] else []


def has_home(robot: CellRobot) -> bool:
    """Return whether the cell, the SRDF of an arm or its built-in model says where it is at home."""
    model = robot.model
    return model.source == "built-in" or "home" in dict(model.group_states) or robot.home is not model.home


def propose_home(cell: Cell, parts: PartShapes, robot: int) -> Array | None:
    """Return a configuration without collisions for a robot, with the others at home.

    It is near the home of the robot, and its tool points down if it can. For an arm without a home the tool is in
    front of the base and points down, with the joints far from their limits. The result is deterministic.

    Args:
        parts: the structure in it.

    Returns:
        Joint values in rad or m, rounded to half a degree or half a centimetre, shape (joints,); None if no free one
        is found.
    """
    world, scene = CollisionWorld(cell, parts), Scene.at_home(cell, parts)
    entry = cell.robots[robot]
    if not has_home(entry):
        found = _in_front(cell, world.view(scene, robot, margin=max(_MARGIN, cell.margins.free)), robot)
        if found is not None:
            return found
    model, rng = entry.model, np.random.default_rng(0)
    start = np.clip(entry.home, model.lower, model.upper)
    # A joint that turns more than once need not.
    low, high = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
    low, high = np.where(model.prismatic, model.lower, low), np.where(model.prismatic, model.upper, high)
    for margin in (max(_MARGIN, cell.margins.free), cell.margins.free):
        view = world.view(scene, robot, margin=margin)
        for share in _STEPS:
            reach = share * (high - low) / 2
            drawn = start + rng.uniform(-1, 1, (_SAMPLES, model.joints)) * reach
            drawn = _rounded(model, np.clip(drawn, low, high))
            free = drawn[~view.collides(drawn) & model.within_limits(drawn)]
            if len(free):
                return free[int(np.argmax(_quality(cell, robot, free, start, high - low)))]
    return None


def _in_front(cell: Cell, view: CollisionQuery, robot: int) -> Array | None:
    """Return a free configuration with the tool in front of the base and pointing down; None without one."""
    entry = cell.robots[robot]
    model = entry.model
    at = [(ahead * model.reach, 0.0, height * model.reach) for ahead in _AHEAD for height in _HEIGHTS]
    turns = 2 * np.pi * np.arange(_TURNS) / _TURNS
    tools = [looking_down(entry.base, place, turn) for place in at for turn in turns]
    solutions = _rounded(model, np.concatenate(inverse(entry, np.array(tools))))
    free = solutions[model.within_limits(solutions)]
    free = free[~view.collides(free)] if len(free) else free
    if not len(free):
        return None
    # Far from the limits, and not turned without need.
    room = np.minimum(free - model.lower, model.upper - free) / (model.upper - model.lower)
    turned = np.where(model.prismatic, 0.0, np.abs(free) / np.pi)
    return free[int(np.argmax(np.minimum(room, 0.2).min(axis=1) - 0.05 * turned.sum(axis=1)))]


def home_text(model: RobotModel, values: ArrayLike) -> str:
    """Return joint values as a cell file has them: degrees, or metres of sliding joints, such as `[0, -45, 90]`."""
    pairs = zip(np.asarray(values) / model.units, model.prismatic, strict=True)
    numbers = [round(float(value), 4 if slides else 1) + 0.0 for value, slides in pairs]
    return "[" + ", ".join(f"{value:g}" for value in numbers) + "]"


def proposal_text(cell: Cell, parts: PartShapes, robot: int) -> str:
    """Return what to write as `home` of a robot, as the end of a message; empty if nothing is found."""
    found = propose_home(cell, parts, robot)
    return "" if found is None else f"home = {home_text(cell.robots[robot].model, found)} is free"


def missing_homes(cell: Cell, parts: PartShapes) -> list[str]:
    """Return for each robot without a home, whose joints are taken at zero, a line that proposes one."""
    found = []
    for number, robot in enumerate(cell.robots):
        if not has_home(robot):
            proposal = proposal_text(cell, parts, number) or "no free one was found"
            found.append(f"robot {robot.name} has no home, so its joints are at zero; {proposal}")
    return found


def with_homes(cell: Cell, parts: PartShapes, robots: Sequence[int]) -> Cell:
    """Return a cell in which some robots have proposed homes, one after the other; those without one keep theirs."""
    for robot in robots:
        found = propose_home(cell, parts, robot)
        if found is not None:
            entries = list(cell.robots)
            entries[robot] = replace(entries[robot], home=found)
            cell = replace(cell, robots=tuple(entries))
    return cell


def _rounded(model: RobotModel, values: Array) -> Array:
    step = np.where(model.prismatic, 0.005, np.radians(0.5))
    return np.round(values / step) * step


def _quality(cell: Cell, robot: int, free: Array, start: Array, span: Array) -> Array:
    """Rate configurations: the tool looks down and is above the base, joints are near where they were."""
    entry = cell.robots[robot]
    tools = tool_pose(entry, free)
    down = -tools[:, 2, 2]
    away = np.linalg.norm((free - start) / span, axis=1)
    return down + np.clip(tools[:, 2, 3] - entry.base[2, 3], -0.5, 0.5) - 2 * away


def check_cell(cell: Cell, parts: PartShapes | None = None) -> None:
    """Validate a cell: bases and home configurations without collision, payloads sufficient for the parts.

    Args:
        parts: the structure in it; without it only the cell itself is checked.

    Raises:
        CellError: a base inside an obstacle, another base or a part; a home below the floor or in collision; a tool
            that collides with its own arm; a part that is too heavy for every robot.
    """
    check_bases(cell, parts)
    _check_homes(cell, parts)
    if parts is not None:
        _check_payload(cell, parts)


def check_bases(cell: Cell, parts: PartShapes | None = None) -> None:
    """Raise CellError unless bases stand clear of obstacles, parts, other bases and the floor.

    A base whose own frame is upright on the floor stands on it, whatever its shapes do below that frame.
    """
    stands = [(f"obstacle {obstacle.name}", obstacle.pieces) for obstacle in cell.obstacles]
    if parts is not None:
        stands += [(f"part {name}", pieces) for name, pieces in zip(parts.names, parts.pieces, strict=True)]
    bases = [shrunk(tuple(apply(robot.base, p) for p in robot.model.pieces[0])) for robot in cell.robots]
    for index, (robot, base) in enumerate(zip(cell.robots, bases, strict=True)):
        others = [(f"the base of {cell.robots[k].name}", bases[k]) for k in range(index)]
        for name, pieces in (*stands, *others):
            depth = max((-separation(a, b) for a in base for b in pieces if overlap(a, b)), default=None)
            if depth is not None:
                raise CellError(
                    f"{cell.name}: the base of robot {robot.name} is inside {name} by "
                    f"{format_quantity(depth + BASE_DEPTH, 'length')}; move one of them"
                )
        lowest = min((float(piece[:, 2].min()) for piece in base), default=np.inf) - BASE_DEPTH
        if cell.floor is not None and cell.floor - lowest > BASE_DEPTH and not _stands_on(robot, cell.floor):
            depth = cell.floor - lowest
            raise CellError(
                f"{cell.name}: the base of robot {robot.name} is {format_quantity(depth, 'length')} below the "
                f"floor; raise it to "
                f"z = {round(robot.base[2, 3] + depth, 4) + 0.0:g}, or set floor to {round(lowest, 4):g}"
            )


def _stands_on(robot: CellRobot, floor: float) -> bool:
    """Return whether the frame of a base is upright on the floor, which is how descriptions have it."""
    return robot.is_upright and bool(abs(robot.base[2, 3] - floor) <= BASE_DEPTH)


def _check_homes(cell: Cell, parts: PartShapes | None) -> None:
    shown = parts or no_parts()
    for index, robot in enumerate(cell.robots):
        pairs = home_faults(cell, shown, index)
        if not pairs:
            continue
        own = [pair for pair in pairs if pair.second.startswith(f"{robot.name} ")]
        worst, proposal = (own or pairs)[0], proposal_text(cell, shown, index)
        if own:
            tool = "gripper" in worst.first + worst.second
            what = "its tool collides with its own arm" if tool else "it collides with itself"
            cure = proposal or "change home or the gripper's shapes"
            raise CellError(f"{cell.name}: robot {robot.name} at home: {what} ({worst.words}); {cure}")
        cure = proposal or "change home or move the base"
        raise CellError(f"{cell.name}: robot {robot.name} at home is too near: {worst.words}; {cure}")


def _check_payload(cell: Cell, parts: PartShapes) -> None:
    most = max(robot.payload for robot in cell.robots)
    heavy = ~parts.boundary & (parts.mass > most)
    if heavy.any():
        part = int(np.argmax(np.where(heavy, parts.mass, 0)))
        strongest = max(cell.robots, key=lambda robot: robot.payload)
        raise CellError(
            f"{cell.name}: part {parts.names[part]} weighs {format_quantity(parts.mass[part], 'mass')} and the "
            f"payload of "
            f"{strongest.name} is {format_quantity(strongest.payload, 'mass')}; "
            "use a stronger arm or gripper, or set density or scale of [structure]"
        )


def no_parts() -> PartShapes:
    """Return a structure without parts."""
    return PartShapes((), np.zeros(0, bool), (), (), np.zeros(0), np.zeros((0, 3)), np.eye(3))


def overlap(a: Array, b: Array) -> bool:
    """Return whether two convex pieces intersect: whether no plane separates them."""
    apart = (a.min(axis=0) > b.max(axis=0)).any() or (b.min(axis=0) > a.max(axis=0)).any()
    return not apart and distance_between(np.ascontiguousarray(a), np.ascontiguousarray(b)) <= 0.0


def shrunk(pieces: Pieces) -> Pieces:
    """Shrink pieces towards their centre by `BASE_DEPTH` along every axis, so that a base may rest on another body."""
    found = []
    for piece in pieces:
        low, high = piece.min(axis=0), piece.max(axis=0)
        middle = (low + high) / 2
        share = np.maximum(0.0, 1 - 2 * BASE_DEPTH / np.maximum(high - low, 1e-9))
        found.append((piece - middle) * share + middle)
    return tuple(found)
