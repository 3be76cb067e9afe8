"""Compiled forward kinematics of batches of configurations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.geometry.paths.gjk import OUTER
from falsework.robots.kernels.collision import Bodies, Chain, place_frames
from falsework.robots.kernels.kernel_arrays import make_chain, turns
from falsework.robots.model.cell import CellRobot
from falsework.robots.model.robot_model import RobotModel
from falsework.utils.kernels import njit

Array = NDArray[np.float64]


def link_poses(model: RobotModel, configurations: ArrayLike, base: Array | None = None) -> Array:
    """Return the poses of all links, shape (joints + 1, 4, 4), or (batch, joints + 1, 4, 4).

    Args:
        model: the arm.
        configurations: joint values.
        base: pose of the base link in the world, shape (4, 4); by default the identity.
    """
    values = np.ascontiguousarray(np.atleast_2d(configurations), dtype=np.float64)
    chain = make_chain(model, np.eye(4) if base is None else base)
    frames = np.empty((len(values), model.joints + 1, 3, 4))
    place_many(values, chain, frames)
    found = np.zeros((len(values), model.joints + 1, 4, 4))
    found[..., :3, :] = frames
    found[..., 3, 3] = 1.0
    back = np.swapaxes(turns(model), 1, 2)
    found[:, 1:] = found[:, 1:] @ back
    return found[0] if np.ndim(configurations) == 1 else found


def flange_pose(model: RobotModel, configurations: ArrayLike, base: Array | None = None) -> Array:
    """Return the pose of the flange, shape (joints,) to (4, 4), or batched."""
    return link_poses(model, configurations, base)[..., -1, :, :] @ model.flange


def tool_pose(robot: CellRobot, configurations: ArrayLike) -> Array:
    """Return the pose of the tool frame of a robot of a cell in the world, shape (joints,) to (4, 4), or batched."""
    return flange_pose(robot.model, configurations, robot.base) @ robot.gripper.tool


def placed_bodies(chain: Chain, bodies: Bodies, values: Array) -> list[Array]:
    """Return the vertices of each piece of an arm in the world, at joint values of shape (joints,)."""
    frames = np.empty((1, len(values) + 1, 3, 4))
    place_many(values[None], chain, frames)
    return [
        bodies.vertices[bodies.start[k] : bodies.start[k + 1]] @ frames[0, frame, :, :3].T + frames[0, frame, :, 3]
        for k, frame in enumerate(bodies.frame.tolist())
    ]


@njit(**OUTER)
def place_many(values, chain, found):
    """Compute `place_frames` for a batch, shape (batch, joints + 1, 3, 4)."""
    for i in range(len(values)):
        place_frames(values[i], chain, found[i])
