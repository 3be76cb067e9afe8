"""Check of single motions by arithmetic alone: limits and durations before anything is sampled, and straight lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from falsework.robots.model.cell import Cell
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.utils.arrays import Array

STRAIGHT = 0.001
"""Largest distance of the tool from a straight line, metres."""
TURNED = 0.01
"""Largest rotation of the tool on a straight line, rad."""
LIMIT_EXCESS = 0.01
"""Share by which rounded knots may exceed a velocity or acceleration limit."""
OUTSIDE = 1e-6
"""Amount by which a joint may exceed a position limit, rad or m."""
_AT_REST = 1e-6
"""Speed below which a joint is at rest, rad/s or m/s."""
_SAMPLED = 10.0
"""Largest speed of motions that are sampled, in velocity limits."""
_PAUSE, _SLOWEST = 60.0, 20.0
"""A motion may take this many seconds, and this many times as long as joints need for their whole range."""


@dataclass(frozen=True)
class LimitReport:
    """Limits of one motion: faults, and how much of the limits it uses."""

    faults: tuple[str, ...]
    bounded: bool
    """Whether it may be sampled: its duration and speed bound the number of samples."""
    velocity_share: float
    """Largest speed of a joint as a share of the limit in the cell."""
    acceleration_share: float


def longest_motion(model: RobotModel, speed: float) -> float:
    """Return the longest duration of a motion that is checked or exported, seconds.

    It follows from the arm, so that neither memory nor time of a check grows with the numbers in a file.
    """
    needed = (model.upper - model.lower) / model.velocity + 2 * model.velocity / model.acceleration
    return _PAUSE + _SLOWEST * float(needed.max()) / speed


def check_limits(trajectory: Trajectory, model: RobotModel, speed: float) -> LimitReport:
    """Check the limits of a motion at its knots, its exact peaks of speed and acceleration, and its duration."""
    # Of plans that are no file: readers refuse such numbers.
    times = trajectory.times
    numbers = (times, trajectory.positions, trajectory.velocities)
    if not (all(np.isfinite(values).all() for values in numbers) and (np.diff(times) > 0).all()):
        return LimitReport(("a motion has numbers that are none, or times that do not ascend",), False, np.inf, np.inf)
    faults: list[str] = []
    longest = longest_motion(model, speed)
    if not trajectory.seconds <= longest:
        faults.append(f"a motion takes {trajectory.seconds:.4g} s; this arm needs no more than {longest:.4g} s")
    beyond = np.maximum(trajectory.positions - model.upper, model.lower - trajectory.positions).max(axis=0)
    if not (beyond <= OUTSIDE).all():
        faults.append(f"{model.joint_names[int(np.argmax(beyond))]} is outside its limits")
    with np.errstate(all="ignore"):  # knots that nearly coincide give numbers that are not finite, and are refused
        fastest, strongest = trajectory.peaks()
    velocity = fastest / (model.velocity * speed)
    push = strongest / (model.acceleration * speed**2)
    velocity, push = (np.where(np.isnan(share), np.inf, share) for share in (velocity, push))
    for what, found in (("speed", velocity), ("acceleration", push)):
        if not (found <= 1 + LIMIT_EXCESS).all():
            worst = int(np.argmax(found))
            faults.append(f"the {what} of {model.joint_names[worst]} is {100 * found[worst]:.0f} % of its limit")
    if any(np.abs(trajectory.velocities[end]).max() > _AT_REST for end in (0, -1)):
        faults.append("a motion does not start or end at rest")
    # Knots that are so far apart that numbers overflow have no speed between them.
    bounded = trajectory.seconds <= longest and bool((velocity <= _SAMPLED).all() and np.isfinite(push).all())
    return LimitReport(tuple(faults), bounded, float(velocity.max()), float(push.max()))


def first_limit_fault(plan: RobotPlan, cell: Cell) -> str:
    """Return the first fault that `check_limits` finds in a plan, with its step and robot; empty if there is none."""
    for step, robot, trajectory in plan.moves():
        faults = check_limits(trajectory, cell.robots[robot].model, cell.speed).faults
        if faults:
            return f"step {step + 1}, {cell.robots[robot].name}: {faults[0]}"
    return ""


def line_fault(tools: Array, longest: float) -> str:
    """Return why tool poses, shape (samples, 4, 4), are not on a short straight line, metres; empty if they are.

    On a line the tool moves in one direction only and does not turn.
    """
    at = tools[:, :3, 3] - tools[0, :3, 3]
    length = float(np.linalg.norm(at[-1]))
    along = at[-1] / length if length > 0 else np.zeros(3)
    ahead = at @ along
    aside = float(np.linalg.norm(at - ahead[:, None] * along, axis=1).max())
    if aside > STRAIGHT:
        return f"is no straight line: the tool is {1000 * aside:.1f} mm beside it"
    back = float((np.maximum.accumulate(ahead) - ahead).max())
    if back > STRAIGHT:
        return f"is no straight line: the tool turns back by {1000 * back:.1f} mm"
    trace = np.einsum("nij,ij->n", tools[:, :3, :3], tools[0, :3, :3])
    turn = float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)).max())
    if turn > TURNED:
        return f"is no straight line: the tool turns by {np.degrees(turn):.1f} degrees"
    if length > longest + STRAIGHT:
        return f"is a line of {1000 * length:.0f} mm; the cell allows {1000 * longest:.0f} mm"
    return ""
