"""Time-optimal path parameterization (TOPP-RA) and resampling for checks and replay."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import DependencyError, InputError, SolverError
from falsework.robots.model.robot_model import RobotModel

Array = NDArray[np.float64]

JOINT_STEP = 0.0099
"""Neighbouring samples differ by at most this in every joint, rad or m."""
TIME_STEP = 0.05
"""Longest time between samples, s."""
CORNER_DEVIATION = 0.0005
"""Largest distance of a point of the arm from its path where corners are rounded, metres: well below all margins."""
LIMIT_SHARE = 0.98
"""Share of the limits given to the optimiser, which enforces them only on a grid."""
SLOWDOWNS = 8
_SWITCH_PASSES = 2
"""Times that moments of jumping acceleration are looked for between samples."""
_JUMP = 0.1
"""Jump of acceleration that gets a sample of its own, in velocity limits per second."""
_SWITCH_MARGIN = 0.02
"""Share of the time between two samples that such a moment keeps from both."""


@dataclass(frozen=True, eq=False)
class Timed:
    """Trajectory of one robot."""

    times: Array
    """Seconds from its start, ascending from 0, shape (samples,)."""
    positions: Array
    """Shape (samples, joints)."""
    velocities: Array
    """Shape (samples, joints); zero at both ends."""
    accelerations: Array
    """Shape (samples, joints)."""

    @property
    def duration(self) -> float:
        """Duration of the trajectory, s."""
        return float(self.times[-1])


def time_path(model: RobotModel, path: ArrayLike, speed: float = 1.0) -> Timed:
    """Compute the time-optimal trajectory along a path of straight edges under velocity and acceleration limits.

    Corners are rounded, so that the robot need not stop at them, by so little that no point of the arm leaves the path
    by more than `CORNER_DEVIATION`. The speed along it comes from TOPP-RA (Pham and Pham 2018).

    Args:
        model: the arm.
        path: configurations, shape (points, joints).
        speed: share of the velocity limits; accelerations are limited to its square.

    Raises:
        InputError: a path with another number of joints, outside the limits or with values that are not finite, or a
            speed that is not in (0, 1].
        DependencyError: toppra is missing.
        SolverError: the optimiser found no feasible speed; this is a defect.
    """
    points = _distinct(model, path)
    if not 0 < speed <= 1:
        raise InputError(f"speed is {speed:g}; give a share of the limits above 0, at most 1")
    velocity, acceleration = model.velocity * speed, model.acceleration * speed**2
    if len(points) == 1:
        still = np.zeros((1, model.joints))
        return Timed(np.zeros(1), points, still, still)
    curve = _Curve(points, CORNER_DEVIATION / (model.reach + 0.5))
    trajectory = _optimal(curve, velocity * LIMIT_SHARE, acceleration * LIMIT_SHARE)
    duration = float(trajectory.duration)
    stretch = 1.0
    for _ in range(SLOWDOWNS):
        timed = _sample(trajectory, duration, stretch, velocity)
        over = max(
            float((np.abs(timed.velocities) / velocity).max()),
            float(np.sqrt((np.abs(timed.accelerations) / acceleration).max())),
        )
        if over <= 1.0:
            return timed
        stretch *= over * 1.001
    raise SolverError(f"no time parameterisation of a path of {model.name} keeps its limits; this is a defect")


class _Curve:
    """Straight edges with corners rounded by parabolas, parameterised by length along the edges."""

    def __init__(self, points: Array, deviation: float) -> None:
        edges = np.diff(points, axis=0)
        # Length in the 1-norm of joint values bounds how far points of the arm move.
        length = np.abs(edges).sum(axis=1)
        self.along = np.concatenate([[0.0], np.cumsum(length)])
        self.points, self.slopes = points, edges / length[:, None]
        turn = np.abs(np.diff(self.slopes, axis=0)).sum(axis=1)
        room = np.minimum(length[:-1], length[1:]) / 2 * 0.999
        self.half = np.minimum(room, 4 * deviation / np.maximum(turn, 1e-12))
        self.dof = points.shape[1]
        self.path_interval = np.array([0.0, self.along[-1]])

    def breaks(self) -> Array:
        """Return the positions where straight segments and rounded corners meet."""
        inner = self.along[1:-1]
        return np.unique(np.concatenate([[0.0], inner - self.half, inner, inner + self.half, [self.along[-1]]]))

    def __call__(self, where: Any, order: int = 0) -> Array:
        """Return position or derivative by length, shape (...) to (..., joints)."""
        s = np.atleast_1d(np.asarray(where, float))
        edge = np.clip(np.searchsorted(self.along, s, side="right") - 1, 0, len(self.slopes) - 1)
        if order == 0:
            value = self.points[edge] + (s - self.along[edge])[:, None] * self.slopes[edge]
        elif order == 1:
            value = self.slopes[edge].copy()
        else:
            value = np.zeros((len(s), self.dof))
        if len(self.half):
            near = np.clip(np.searchsorted(self.along[1:-1], s), 0, len(self.half) - 1)
            for corner in (near, np.maximum(near - 1, 0)):
                away = s - self.along[1:-1][corner]
                inside = np.abs(away) <= self.half[corner]
                c, d, h = corner[inside], away[inside][:, None], self.half[corner][inside][:, None]
                change = self.slopes[c + 1] - self.slopes[c]
                if order == 0:
                    value[inside] = self.points[c + 1] + d * self.slopes[c] + change * (d + h) ** 2 / (4 * h)
                elif order == 1:
                    value[inside] = self.slopes[c] + change * (d + h) / (2 * h)
                else:
                    value[inside] = change / (2 * h)
        return value.reshape(*np.shape(where), self.dof)


def _optimal(curve: _Curve, velocity: Array, acceleration: Array) -> Any:
    """Return the fastest trajectory along a curve, from rest to rest."""
    try:
        import toppra
    except ImportError as error:
        raise DependencyError("timing needs toppra: pip install 'falsework[robots]'") from error
    logging.getLogger("toppra").setLevel(logging.ERROR)

    class Path(toppra.interpolator.AbstractGeometricPath):
        """The curve in the interface of toppra."""

        dof: Any = curve.dof
        path_interval: Any = curve.path_interval
        waypoints: Any = (curve.along, curve.points)

        def __call__(self, path_positions: Any, order: int = 0) -> Array:
            return curve(path_positions, order)

    breaks = curve.breaks()
    finest = curve.along[-1] / 100
    pieces = [
        np.linspace(a, b, 1 + max(2, int(np.ceil((b - a) / finest))))[:-1]
        for a, b in pairwise(breaks.tolist())
        if b - a > 1e-9
    ]
    grid = np.append(np.concatenate(pieces), breaks[-1])
    grid = grid[np.concatenate([[True], np.diff(grid) > 1e-9])]
    grid[-1] = breaks[-1]
    limits = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    solver = toppra.algorithm.TOPPRA(limits, Path(), gridpoints=grid, parametrizer="ParametrizeConstAccel")
    found = solver.compute_trajectory(0.0, 0.0)
    if found is None:
        raise SolverError("no speed profile along a path keeps the limits; this is a defect")
    return found


def _sample(trajectory: Any, duration: float, stretch: float, velocity: Array) -> Timed:
    """Return samples of a trajectory slowed down by a factor."""
    coarse = np.linspace(0.0, duration, max(3, int(np.ceil(duration / 0.01))))
    fastest = float(np.abs(trajectory(coarse, 1)).max()) * 1.1
    step = min(TIME_STEP, JOINT_STEP / max(fastest, 1e-9))
    for _ in range(12):
        count = max(2, int(np.ceil(duration / step))) + 1
        times = np.linspace(0.0, duration, count)
        positions = trajectory(times)
        if np.abs(np.diff(positions, axis=0)).max() <= JOINT_STEP:
            break
        step /= 1.3
    for _ in range(_SWITCH_PASSES):
        times = _with_switches(trajectory, times, velocity)
    positions = trajectory(times)
    velocities, accelerations = trajectory(times, 1) / stretch, trajectory(times, 2) / stretch**2
    velocities[[0, -1]] = 0.0
    return Timed(np.asarray(times) * stretch, positions, velocities, accelerations)


def _with_switches(trajectory: Any, times: Array, velocity: Array) -> Array:
    """Return times of samples with the moments added at which the acceleration jumps between two of them.

    A cubic from sample to sample across a jump from full acceleration to full braking would need half as much again.
    """
    speeds, pushes, spans = trajectory(times, 1), trajectory(times, 2), np.diff(times)
    jumps = pushes[:-1] - pushes[1:]
    size = (jumps**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = ((np.diff(speeds, axis=0) - pushes[1:] * spans[:, None]) * jumps).sum(axis=1) / (size * spans)
    large = (np.abs(jumps) > _JUMP * velocity).any(axis=1)
    inside = large & (share > _SWITCH_MARGIN) & (share < 1 - _SWITCH_MARGIN)
    found: Array = np.union1d(times, (times[:-1] + share * spans)[inside])
    return found


def _distinct(model: RobotModel, path: ArrayLike) -> Array:
    """Return a validated path without consecutive duplicate points."""
    points = np.array(path, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != model.joints or not len(points):
        raise InputError(f"path has shape {points.shape}; {model.name} needs (points, {model.joints})")
    if not np.isfinite(points).all():
        raise InputError("path holds a value that is not finite")
    if not model.within_limits(points, 1e-6).all():
        row = int(np.argmin(model.within_limits(points, 1e-6)))
        model.check_configuration(points[row], f"point {row} of the path")
    keep = np.concatenate([[True], np.abs(np.diff(points, axis=0)).sum(axis=1) > 1e-9])
    return points[keep]
