"""Flat arrays of robots, parts and obstacles for the compiled collision check."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import apply
from falsework.robots.kernels.collision import Bodies, Chain, Obstacles
from falsework.robots.model.cell import CellRobot
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, Pieces, square_to

GROUP = 6
"""Obstacles per bounding box in the broad phase."""


Carried = tuple[str, Pieces]
"""Name of the part that a robot carries, and its pieces in the frame of the flange."""


@lru_cache(maxsize=64)
def turns(model: RobotModel) -> Array:
    """Return for every joint the rotation from the rotated frame, whose z is the axis, to the link frame.

    Shape (joints, 4, 4). With such frames every axis is z and the compiled kinematics has no branches.
    """
    found = np.tile(np.eye(4), (model.joints, 1, 1))
    for j, axis in enumerate(model.axes):
        found[j, :3, :3] = np.column_stack([*square_to(axis), axis])
    found.setflags(write=False)
    return found


def make_chain(model: RobotModel, base: Array) -> Chain:
    """Return the joints of an arm with base pose `base`, shape (4, 4)."""
    turn = turns(model)
    origin = model.origins @ turn
    origin[1:] = np.swapaxes(turn[:-1], 1, 2) @ origin[1:]
    # Copies: numba compiles read-only and writable arrays as different types.
    return Chain(np.array(base[:3], order="C"), np.array(origin[:, :3], order="C"), np.array(model.prismatic))


def make_bodies(robot: CellRobot, carried: Carried | None = None) -> tuple[Bodies, tuple[str, ...], tuple[int, ...]]:
    """Pack the moving bodies of a robot; its base belongs to frame 0, which does not move.

    Returns:
        The pieces, their names, and the body of each: a link (0 is the base), `joints + 1` the gripper,
        `joints + 2` the part.
    """
    bare, names, kinds = _arm_bodies(robot)
    if carried is None:
        return bare, names, kinds
    joints, (name, pieces) = robot.model.joints, carried
    load = _packed(robot.model, [joints] * len(pieces), _mounted(robot.model, pieces))
    bodies = Bodies(
        np.append(bare.frame, load.frame),
        np.append(bare.start[:-1], bare.start[-1] + load.start),
        np.concatenate([bare.vertices, load.vertices]),
        np.concatenate([bare.center, load.center]),
        np.append(bare.radius, load.radius),
        np.concatenate([bare.sweep, load.sweep]),
    )
    return bodies, (*names, *[name] * len(pieces)), (*kinds, *[joints + 2] * len(pieces))


@lru_cache(maxsize=64)
def _arm_bodies(robot: CellRobot) -> tuple[Bodies, tuple[str, ...], tuple[int, ...]]:
    """Return what `make_bodies` does for an arm without a load."""
    model, gripper = robot.model, robot.gripper.pieces
    joints, turn, named = model.joints, turns(model), (*model.link_names, "gripper")
    links = [(link, piece) for link, pieces in enumerate(model.pieces) for piece in pieces]
    shapes = [apply(np.swapaxes(turn[link - 1], 0, 1), piece) if link else np.array(piece) for link, piece in links]
    kinds = (*(link for link, _ in links), *[joints + 1] * len(gripper))
    bodies = _packed(model, [min(kind, joints) for kind in kinds], shapes + _mounted(model, gripper))
    return bodies, tuple(named[kind] for kind in kinds), kinds


def _mounted(model: RobotModel, pieces: Pieces) -> list[Array]:
    """Return pieces given in the frame of the flange in the last rotated frame."""
    last = np.swapaxes(turns(model)[-1], 0, 1)  # a rotation: its inverse
    return [apply(last @ model.flange, piece) for piece in pieces]


def _packed(model: RobotModel, frames: Sequence[int], shapes: Sequence[Array]) -> Bodies:
    """Return pieces, each in a frame of the arm, with their bounds."""
    origin = make_chain(model, np.eye(4)).origin
    sweep = np.array([_sweep(model, origin, frame, piece) for frame, piece in zip(frames, shapes, strict=True)])
    return Bodies(np.array(frames, np.int64), *bounds_of(shapes), sweep)


def bounds_of(pieces: Sequence[Array]) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return first rows, stacked vertices, and centres and radii of bounding spheres of pieces."""
    start, vertices = _stack(pieces)
    low, high = np.minimum.reduceat(vertices, start[:-1]), np.maximum.reduceat(vertices, start[:-1])
    center = (low + high) / 2
    away = np.linalg.norm(vertices - np.repeat(center, np.diff(start), axis=0), axis=1)
    return start, vertices, center, np.maximum.reduceat(away, start[:-1])


def _sweep(model: RobotModel, origin: Array, frame: int, piece: Array) -> Array:
    """Return a bound on the motion of any point of a piece when each joint moves by one unit, shape (joints,).

    A point is at most as far from the axis of joint j as the origin of the next frame, plus the lengths of all
    later offsets, plus its own distance from the origin of its frame; prismatic joints add their full stroke.
    """
    found = np.zeros(model.joints)
    travel = np.where(model.prismatic, np.maximum(np.abs(model.lower), np.abs(model.upper)), 0.0)
    rest = float(np.linalg.norm(piece, axis=1).max())
    for j in range(frame - 1, -1, -1):
        if model.prismatic[j]:
            found[j] = 1.0
        elif j == frame - 1:
            found[j] = np.hypot(piece[:, 0], piece[:, 1]).max()
        else:
            found[j] = np.hypot(origin[j + 1, 0, 3], origin[j + 1, 1, 3]) + travel[j + 1] + rest
        if j < frame - 1:
            rest += float(np.linalg.norm(origin[j + 1, :, 3])) + travel[j + 1]
    return found


def self_pairs(model: RobotModel, links: Sequence[int]) -> NDArray[np.int64]:
    """Return pairs of moving pieces of one arm that can collide, shape (pairs, 2).

    The gripper is not checked against the last two links, nor its part against the last link and the gripper:
    they hardly move relative to each other, and whether they fit is checked once, with the cell.

    Args:
        links: the body of every piece, as `make_bodies` returns it.
    """
    return _self_pairs(model, tuple(links)).copy()


@lru_cache(maxsize=256)
def _self_pairs(model: RobotModel, links: tuple[int, ...]) -> NDArray[np.int64]:
    joints = model.joints
    found = []
    for a in range(len(links)):
        for b in range(a + 1, len(links)):
            low, high = sorted((links[a], links[b]))
            if high <= joints:
                wanted = low != high and (low, high) not in model.ignored
            elif high == joints + 1:
                wanted = low < joints - 1
            else:
                wanted = low < joints
            if wanted:
                found.append((a, b))
    return np.array(found, np.int64).reshape(-1, 2)


def make_obstacles(bodies: Sequence[Pieces]) -> tuple[Obstacles, NDArray[np.int64]]:
    """Pack static pieces in groups of neighbours.

    Returns:
        The pieces and, for each, the index of its body.
    """
    pieces = [piece for body in bodies for piece in body]
    owner = np.repeat(np.arange(len(bodies)), [len(body) for body in bodies])
    if not pieces:
        nothing = np.zeros((0, 3))
        one = np.zeros(1, np.int64)
        return Obstacles(one, nothing, nothing, nothing, one, nothing, nothing), owner
    start, vertices = _stack(pieces)
    low, high = np.minimum.reduceat(vertices, start[:-1]), np.maximum.reduceat(vertices, start[:-1])
    groups = _groups((low + high) / 2)
    order = [k for group in groups for k in group]
    sizes = [len(group) for group in groups]
    start, vertices = _stack([pieces[k] for k in order])
    first = np.concatenate([[0], np.cumsum(sizes)])
    low, high = low[order], high[order]
    obstacles = Obstacles(
        start,
        vertices,
        low,
        high,
        first,
        np.minimum.reduceat(low, first[:-1]),
        np.maximum.reduceat(high, first[:-1]),
    )
    return obstacles, owner[order]


def _groups(centers: Array) -> list[list[int]]:
    """Split points at the median of their widest extent until each group is small."""
    columns = centers.T.tolist()  # lists: numpy takes several times as long for so few numbers
    pending, found = [list(range(len(centers)))], []
    while pending:
        group = pending.pop()
        if len(group) <= GROUP:
            found.append(group)
            continue
        chosen = [[column[k] for k in group] for column in columns]
        extents = [max(values) - min(values) for values in chosen]
        order = sorted(group, key=columns[extents.index(max(extents))].__getitem__)
        pending += [order[: len(order) // 2], order[len(order) // 2 :]]
    return found


def _stack(pieces: Sequence[Array]) -> tuple[NDArray[np.int64], Array]:
    """Return the first row of every piece, and all vertices stacked."""
    start = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int64)
    return start, np.array(np.concatenate(pieces), order="C")
