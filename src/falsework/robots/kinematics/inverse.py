"""Inverse kinematics: all configurations that bring a tool to a pose.

Arms with six revolute joints whose second and third axes are parallel, at right angles to the first, have closed forms
(products of exponentials and Paden-Kahan subproblems, Murray, Li and Sastry 1994, chapter 3):

- `wrist`: the fourth and fifth axes meet. If the sixth passes through the same point (IRB 2600 and most industrial
  arms), the solution is closed-form; with an offset (GoFa), one equation in the sixth angle remains, whose roots are
  bracketed on a grid.
- `parallel`: the fourth axis is parallel to the third, the fifth meets the sixth (Universal Robots).
- `general`: all other arms, such as those with seven joints: damped Newton steps from many starts. With seven joints
  the solutions form a curve, of which samples are returned.

Every solution is refined and checked by forward kinematics before it is returned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import InputError
from falsework.robots.kernels.kernel_arrays import make_chain, turns
from falsework.robots.kernels.numeric_ik import reach_poses
from falsework.robots.kinematics.analytic_ik import Screws, solve_parallel, solve_wrist
from falsework.robots.kinematics.forward import link_poses
from falsework.robots.model.cell import CellRobot
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, inverse_pose

Kind = Literal["spherical", "wrist", "parallel", "general"]

RANDOM_STARTS = 80
"""Random starts for arms without a closed form."""
REDUNDANT_SOLUTIONS = 24
"""Solutions that are kept per pose for an arm with more than six joints."""
SAME_SOLUTION = 1e-4
"""Distance below which solutions of an arm with six joints count as equal, rad."""
SOLUTION_SPACING = 0.25
"""Least distance between solutions of an arm with more joints, rad."""


@dataclass(frozen=True, eq=False)
class IkSolver:
    """Inverse kinematics of one arm, prepared once by `solver_of`."""

    kind: Kind = "general"
    screws: Screws | None = None
    """Joint axes at zero, for arms with a closed form."""


def inverse(robot: CellRobot, tools: ArrayLike) -> list[Array]:
    """Return all configurations that bring the tool frame of a robot to poses in the world.

    Args:
        tools: poses of the tool frame in the world, shape (4, 4) or (batch, 4, 4).

    Returns:
        For every pose an array of shape (solutions, joints): all branches, with all full turns that the limits allow.
    """
    poses = np.asarray(tools, dtype=np.float64).reshape(-1, 4, 4)
    flange = inverse_pose(robot.base) @ poses @ inverse_pose(robot.gripper.tool)
    return inverse_flange(robot.model, flange)


def inverse_flange(model: RobotModel, flanges: ArrayLike) -> list[Array]:
    """Solve as `inverse` does for flange poses in the base frame, shape (4, 4) or (batch, 4, 4)."""
    targets = np.ascontiguousarray(np.asarray(flanges, dtype=np.float64).reshape(-1, 4, 4))
    if not np.isfinite(targets).all():
        raise InputError("a pose holds a value that is not finite")
    solver = solver_of(model)
    if solver.screws is None:
        guesses, owner = _random_starts(model, len(targets))
        newton = 60, 0.3, 0.8
    else:
        solve = solve_parallel if solver.kind == "parallel" else solve_wrist
        guesses, owner = solve(solver.screws, targets)
        newton = 12, 0.0, 0.3
    found, owner = _polish(model, guesses, targets, owner, newton)
    turning = ~model.prismatic
    found[:, turning] = (found[:, turning] + np.pi) % (2 * np.pi) - np.pi
    if model.joints <= 6:
        found, owner = _distinct(found, owner)
    else:
        found, owner = _spread(found, owner, turning)
    found, owner = _windings(model, found, owner)
    return np.split(found, np.searchsorted(owner, np.arange(1, len(targets))))


@lru_cache(maxsize=64)
def solver_of(model: RobotModel) -> IkSolver:
    """Analyse the axes of an arm and choose its inverse kinematics."""
    if model.joints != 6 or model.prismatic.any():
        return IkSolver()
    poses = link_poses(model, np.zeros(6))
    axes = np.einsum("jik,jk->ji", poses[1:, :3, :3], model.axes)
    screws = Screws(axes, poses[1:, :3, 3].copy(), poses[-1] @ model.flange)
    parallel = np.abs(axes @ axes.T) > 1 - 1e-9
    square = np.abs(axes @ axes.T) < 1e-9
    if not (square[0, 1] and parallel[1, 2] and square[3, 4] and square[4, 5]):
        return IkSolver()
    meet45, meet56 = screws.meeting(3, 4), screws.meeting(4, 5)
    if parallel[2, 3] and meet56 is not None:
        return IkSolver("parallel", replace(screws, center=meet56))
    if meet45 is not None:
        spherical = screws.distance(5, meet45) < 1e-6
        kind = "spherical" if spherical else "wrist"
        return IkSolver(kind, replace(screws, center=meet45, spherical=spherical))
    return IkSolver()


def tail_of(model: RobotModel, tool: Array | None = None) -> Array:
    """Return the pose of a frame at the flange in the last rotated frame of the compiled chain, shape (3, 4)."""
    end = model.flange if tool is None else model.flange @ tool
    return np.array((inverse_pose(turns(model)[-1]) @ end)[:3], order="C")


def _polish(
    model: RobotModel, guesses: Array, targets: Array, owner: NDArray[np.int64], newton: tuple[int, float, float]
) -> tuple[Array, NDArray[np.int64]]:
    """Refine guesses by Newton steps, damping and longest step as of `reach_poses`; return those that reach a pose."""
    values = np.array(guesses, order="C")
    reached = np.zeros(len(values), bool)
    chain = make_chain(model, np.eye(4))
    poses = np.array(targets[owner][:, :3], order="C")
    reach_poses(values, poses, chain, tail_of(model), *newton, False, reached)
    return values[reached], owner[reached]


def _random_starts(model: RobotModel, poses: int) -> tuple[Array, NDArray[np.int64]]:
    """Return random configurations to begin with, and the pose that each is for."""
    random = np.random.default_rng(0)
    low = np.where(model.prismatic, model.lower, np.maximum(model.lower, -np.pi))
    high = np.where(model.prismatic, model.upper, np.minimum(model.upper, np.pi))
    starts = random.uniform(low, high, (poses, RANDOM_STARTS, model.joints)).reshape(-1, model.joints)
    return starts, np.repeat(np.arange(poses), RANDOM_STARTS)


def _distinct(values: Array, owner: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return distinct solutions, by pose and then in order."""
    keys = np.concatenate([owner[:, None], np.cos(values), np.sin(values)], axis=1)
    _, first = np.unique(np.round(keys / SAME_SOLUTION), axis=0, return_index=True)
    first = first[np.lexsort((*np.round(values[first], 6).T[::-1], owner[first]))]
    return values[first], owner[first]


def _spread(values: Array, owner: NDArray[np.int64], turning: NDArray[np.bool_]) -> tuple[Array, NDArray[np.int64]]:
    """Select well separated solutions of every pose, in the order in which they were found."""
    kept: list[int] = []
    for row in np.unique(owner).tolist():
        mine: list[int] = []
        for k in np.flatnonzero(owner == row).tolist():
            apart = np.abs(values[mine] - values[k])
            apart[:, turning] = np.minimum(apart[:, turning], 2 * np.pi - apart[:, turning])
            if len(mine) < REDUNDANT_SOLUTIONS and (apart.max(axis=1, initial=0.0) >= SOLUTION_SPACING).all():
                mine.append(k)
        kept += mine
    return values[kept], owner[kept]


def _windings(model: RobotModel, values: Array, owner: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return every solution with all full turns that the limits allow, those without one first."""
    room = (model.lower < -np.pi) | (model.upper > np.pi)
    options = [
        (0.0, -2 * np.pi, 2 * np.pi) if wide and not slide else (0.0,)
        for wide, slide in zip(room, model.prismatic, strict=True)
    ]
    turns = np.array(list(product(*options)))
    made = values[:, None] + turns
    keep = model.within_limits(made)
    return made[keep], np.repeat(owner, keep.sum(axis=1))
