"""Time-optimal path parameterization (TOPP-RA) and resampling for checks and replay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falsework.errors import InputError
from falsework.robots.kernels.speed_profile import evaluate, fastest
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array

JOINT_STEP = 0.0099
"""Neighbouring samples differ by at most this in every joint, rad or m."""
TIME_STEP = 0.05
"""Longest time between samples, s."""
CORNER_DEVIATION = 0.0005
"""Largest distance of a point of the arm from its path where corners are rounded, metres: well below all margins."""
LIMIT_SHARE = 0.995
"""Share of the limits given to the optimiser, which enforces them only on a grid."""
GRID_STEPS = 100
"""Least number of intervals of constant acceleration along a path; every piece has two at least."""
_JUMP = 0.1
"""Jump of acceleration that gets a sample of its own, in velocity limits per second."""
_SWITCH_MARGIN = 0.02
"""Share of the time between two samples within which such a moment replaces a sample."""


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
        path: configurations, shape (points, joints).
        speed: share of the velocity limits; accelerations are limited to its square.
    """
    points = _distinct(model, path)
    if not 0 < speed <= 1:
        raise InputError(f"speed is {speed:g}; give a share of the limits above 0, at most 1")
    velocity, acceleration = model.velocity * speed, model.acceleration * speed**2
    if len(points) == 1:
        still = np.zeros((1, model.joints))
        return Timed(np.zeros(1), points, still, still)
    trajectory = _Trajectory(
        points, CORNER_DEVIATION / (model.reach + 0.5), velocity * LIMIT_SHARE, acceleration * LIMIT_SHARE
    )
    times = _sample_times(trajectory, velocity)
    positions, velocities, accelerations = trajectory(times)
    velocities[[0, -1]] = 0.0
    over = max((np.abs(velocities) / velocity).max(), np.sqrt((np.abs(accelerations) / acceleration).max()))
    stretch = 1.0 if over <= 1.0 else float(over) * (1 + 1e-9)
    return Timed(times * stretch, positions, velocities / stretch, accelerations / stretch**2)


class _Trajectory:
    """Fastest motion from rest to rest along straight edges with corners rounded by parabolas."""

    def __init__(self, points: Array, deviation: float, velocity: Array, acceleration: Array) -> None:
        edges = np.diff(points, axis=0)
        # Length in the 1-norm of joint values bounds how far points of the arm move.
        length = np.abs(edges).sum(axis=1)
        along, slopes = np.concatenate([[0.0], np.cumsum(length)]), edges / length[:, None]
        turn = np.diff(slopes, axis=0)
        room = np.minimum(length[:-1], length[1:]) / 2 * 0.999
        half = np.minimum(room, 4 * deviation / np.maximum(np.abs(turn).sum(axis=1), 1e-12))
        # Pieces in turn: the straight part of an edge, and the corner at its end.
        count = 2 * len(edges) - 1
        origin, slope, bend = np.zeros(count), np.repeat(slopes, 2, axis=0)[:count], np.zeros((count, len(velocity)))
        start = np.repeat(points, 2, axis=0)[:count]
        origin[1::2], origin[2::2] = along[1:-1] - half, along[1:-1] + half
        start[1::2], start[2::2] = points[1:-1] - half[:, None] * slopes[:-1], points[1:-1] + half[:, None] * slopes[1:]
        bend[1::2] = turn / (2 * half[:, None])
        size = np.diff(origin, append=along[-1])
        steps = np.maximum(2, np.ceil(size * (GRID_STEPS / along[-1]))).astype(np.int64)
        piece = np.repeat(np.arange(count), steps)
        step = np.arange(len(piece)) - np.repeat(np.cumsum(steps) - steps, steps)
        grid = np.append(origin[piece] + step * (size / steps)[piece], along[-1])
        squares = np.empty(len(grid))
        fastest(grid, piece, origin, slope, bend, velocity, acceleration, squares)
        rate = np.sqrt(squares)
        clock = np.concatenate([[0.0], np.cumsum(2 * np.diff(grid) / (rate[:-1] + rate[1:]))])
        self.duration = float(clock[-1])
        self._profile = (clock, grid, squares, piece, origin, start, slope, bend)

    def __call__(self, times: Array) -> tuple[Array, Array, Array]:
        """Return joint values, velocities and accelerations at ascending times, each of shape (times, joints)."""
        joints = self._profile[-1].shape[1]
        found = np.empty((3, len(times), joints))
        evaluate(times, *self._profile, found[0], found[1], found[2])
        return found[0], found[1], found[2]

    def jumps(self, least: Array) -> Array:
        """Return times at which the acceleration of a joint jumps by more than `least`, shape (joints,)."""
        clock, grid, squares, piece, origin, _, slope, bend = self._profile
        push = (np.diff(squares) / (2 * np.diff(grid)))[:, None]
        ends = [
            bend[piece] * square[:, None] + push * (slope[piece] + (at - origin[piece])[:, None] * bend[piece])
            for square, at in ((squares[1:], grid[1:]), (squares[:-1], grid[:-1]))
        ]
        return clock[1:-1][(np.abs(ends[1][1:] - ends[0][:-1]) > least).any(axis=1)]


def _sample_times(trajectory: _Trajectory, velocity: Array) -> Array:
    """Return times at which a trajectory is sampled: uniform ones, and those of jumping accelerations."""
    duration = trajectory.duration
    _, speeds, _ = trajectory(np.linspace(0.0, duration, max(3, int(np.ceil(duration / 0.01)))))
    step = min(TIME_STEP, JOINT_STEP / max(float(np.abs(speeds).max()) * 1.1, 1e-9))
    for _ in range(12):
        times = np.linspace(0.0, duration, max(2, int(np.ceil(duration / step))) + 1)
        if np.abs(np.diff(trajectory(times)[0], axis=0)).max() <= JOINT_STEP:
            break
        step /= 1.3
    jumps = trajectory.jumps(_JUMP * velocity)
    # A cubic from sample to sample across a jump from full acceleration to full braking would need half as much again.
    after = np.searchsorted(jumps, times)
    gaps = np.abs(times[:, None] - np.append(jumps, np.inf)[np.stack([after, after - 1], axis=1)]).min(axis=1)
    alone = gaps > _SWITCH_MARGIN * times[1]
    alone[[0, -1]] = True
    return np.sort(np.concatenate([times[alone], jumps]))


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
