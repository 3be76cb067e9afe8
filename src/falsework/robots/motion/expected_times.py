"""Choice of actions for robots that move at the same time: expected times, and a balance of work between robots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, Mask, States
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.robot_model import RobotModel
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]


_NEAR = 0.4
"""Two robots with parts no farther apart than this are in each other's way, metres."""
_CLEAR = 0.6
"""Share of the time of a removal after which the robot is out of the way."""


@dataclass(frozen=True, eq=False)
class Leaving:
    """Robot that leaves the place of a part, with it or without it."""

    robot: int
    clear: float
    """Time at which it has left the surroundings of its part, seconds."""
    center: Array
    """Centre of the part, shape (3,)."""
    configuration: Array
    """Configuration at which it held the part, shape (joints,)."""


@dataclass(frozen=True, eq=False)
class Clock:
    """Times at a keyframe if every robot moves as soon as its own motions and the order of the states allow."""

    robots: tuple[float, ...] = ()
    """Time at which each robot is done, seconds; empty at the start."""
    state: float = 0.0
    """Time at which the structure reaches the state of the keyframe, seconds."""
    left: tuple[Leaving, ...] = ()
    """Latest removals and releases."""

    def of(self, robot: int) -> float:
        """Return the time at which a robot is done, seconds."""
        return self.robots[robot] if self.robots else 0.0

    def late(self, robot: int) -> float:
        """Return how much longer than the first available robot a robot is busy, seconds."""
        return self.robots[robot] - min(self.robots) if self.robots else 0.0

    def clear_near(self, robot: int, center: Array) -> float:
        """Return the time at which other robots that leave from nearby are out of the way of a part, seconds."""
        near = (
            entry.clear for entry in self.left if entry.robot != robot and np.linalg.norm(entry.center - center) < _NEAR
        )
        return max(near, default=0.0)

    def held(self, robot: int, seconds: float, robots: int, clear: float) -> Clock:
        """Return the clock after a robot has moved to a part, not before `clear`, in `seconds`, and holds it."""
        times = list(self.robots or (0.0,) * robots)
        times[robot] = max(max(times[robot], clear) + seconds, self.state)
        return Clock(tuple(times), times[robot], self.left)

    def left_place(self, robot: int, seconds: float, robots: int, center: Array, here: Array) -> Clock:
        """Return the clock after a robot has left the place of a part in `seconds`, with it or without it.

        Args:
            robot: index of the robot.
            seconds: expected duration.
            robots: number of robots.
            center: centre of the part, shape (3,).
            here: configuration at which it held the part, shape (joints,).
        """
        times = list(self.robots or (0.0,) * robots)
        begin = max(times[robot], self.state)
        times[robot] = begin + seconds
        others = (entry for entry in self.left if entry.robot != robot)
        return Clock(tuple(times), begin, (*others, Leaving(robot, begin + _CLEAR * seconds, center, here)))


NO_TIME = Clock()
"""Clock at the start."""


def expected_seconds(model: RobotModel, path: Array, speed: float) -> float:
    """Return an estimate of the duration of a path from rest to rest: that of the joint that needs longest.

    Args:
        model: the arm.
        path: configurations, shape (points, joints).
        speed: share of the velocity limits; accelerations are limited to its square.
    """
    return float(_from_rest_to_rest(model, np.abs(np.diff(path, axis=0)).sum(axis=0), speed))


def straight_seconds(model: RobotModel, here: Array, goals: Array, speed: float) -> Array:
    """Return estimates of the durations of straight motions in joint space, as `expected_seconds`.

    Args:
        model: the arm.
        here: configuration at one end, shape (joints,).
        goals: configurations at the other end, shape (batch, joints).
        speed: as in `expected_seconds`.
    """
    return _from_rest_to_rest(model, np.abs(goals - here), speed)


def _from_rest_to_rest(model: RobotModel, travel: Array, speed: float) -> Array:
    velocity, acceleration = model.velocity * speed, model.acceleration * speed**2
    ramp = velocity**2 / acceleration
    times = np.where(travel < ramp, 2 * np.sqrt(travel / acceleration), travel / velocity + velocity / acceleration)
    slowest: Array = times.max(axis=-1, initial=0.0)
    return slowest


class BalanceGuide:
    """Heuristic that balances the shares of remaining parts near each robot, on top of another heuristic.

    Each part counts for the nearest robot. Robots then find work on their own sides at any time, far
    from each other.
    """

    def __init__(self, base: Guide | None, cell: Cell, parts: PartShapes) -> None:
        """Assign parts to robots; `base` is the other heuristic."""
        self._base = base
        bases = np.array([robot.base[:2, 3] for robot in cell.robots])
        nearest = np.linalg.norm(parts.center[:, None, :2] - bases, axis=2).argmin(axis=1)
        self._near = (nearest[:, None] == np.arange(cell.robot_count)) & ~parts.boundary[:, None]

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """Return scores as `Guide`."""
        near = self._near.astype(np.float64)
        left = (states != REMOVED).astype(np.float64) @ near
        whole = near.sum(axis=0)
        share = left / np.maximum(whole, 1.0)
        ahead = (share - (left.sum(axis=1) / max(whole.sum(), 1.0))[:, None]) * whole
        score = np.clip(ahead / 2, -1.0, 1.0) @ near.T
        if direction is Direction.ASSEMBLY:
            score = -score
        found: NDArray[np.float64] = np.concatenate([score, score], axis=1)
        return found if self._base is None else found + self._base(states, actions, direction)
