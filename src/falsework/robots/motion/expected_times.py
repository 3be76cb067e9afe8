"""Expected durations of paths, from the limits of an arm alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.robot_model import RobotModel

Array = NDArray[np.float64]


def expected_seconds(model: RobotModel, path: Array, speed: float) -> float:
    """Return an estimate of the duration of a path from rest to rest: that of the joint that needs longest.

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
