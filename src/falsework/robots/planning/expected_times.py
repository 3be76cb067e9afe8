"""Expected times of a plan whose robots move at the same time, for the choice of actions while it is made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.robot_model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Clock:
    """Times at a keyframe if every robot moves as soon as its own motions and the order of the states allow."""

    robots: tuple[float, ...] = ()
    """When each is done with what it does, seconds; empty at the start."""
    state: float = 0.0
    """When the structure comes to the state of the keyframe."""

    def of(self, robot: int) -> float:
        """Return how much longer than the first to be done a robot is busy, seconds."""
        return self.robots[robot] - min(self.robots) if self.robots else 0.0

    def held(self, robot: int, seconds: float, robots: int) -> Clock:
        """Return the clock after a robot has gone to a part, which takes `seconds`, and holds it."""
        times = list(self.robots or (0.0,) * robots)
        times[robot] = max(times[robot] + seconds, self.state)
        return Clock(tuple(times), times[robot])

    def removed(self, robot: int, seconds: float, robots: int) -> Clock:
        """Return the clock after a robot has left with the part that it holds, and carried it away in `seconds`."""
        times = list(self.robots or (0.0,) * robots)
        begin = max(times[robot], self.state)
        times[robot] = begin + seconds
        return Clock(tuple(times), begin)


NO_TIME = Clock()
"""At the start."""


def expected_seconds(model: RobotModel, path: Array, speed: float) -> float:
    """Return about how long a path takes from rest to rest: that of the joint that needs longest for its travel.

    Args:
        model: the arm.
        path: configurations, shape (points, joints).
        speed: share of the velocity limits; accelerations are limited to its square.
    """
    travel = np.abs(np.diff(path, axis=0)).sum(axis=0)
    velocity, acceleration = model.velocity * speed, model.acceleration * speed**2
    ramp = velocity**2 / acceleration
    times = np.where(travel < ramp, 2 * np.sqrt(travel / acceleration), travel / velocity + velocity / acceleration)
    return float(times.max(initial=0.0))
