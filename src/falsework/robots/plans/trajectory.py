"""Trajectories of robots, and what is checked of them by arithmetic alone: limits and durations, and straight lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from falsework.geometry.clearance.moves import PathMove
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array
from falsework.utils.quantity import format_quantity

STRAIGHT = 0.001
"""Largest distance of the tool from a straight line, metres."""
TURNED = 0.01
"""Largest rotation of the tool on a straight line, rad."""
LIMIT_EXCESS = 0.01
"""Share by which rounded knots may exceed a velocity or acceleration limit."""
OUTSIDE = 1e-6
"""Amount by which a joint may exceed a position limit, rad or m."""
JOINS = 1e-5
"""Joint values that differ by no more are equal, rad or m."""
_AT_REST = 1e-6
"""Speed below which a joint is at rest, rad/s or m/s."""
_SAMPLED = 10.0
"""Largest speed of motions that are sampled, in velocity limits."""
_PAUSE, _SLOWEST = 60.0, 20.0
"""A motion may take this many seconds, and this many times as long as joints need for their whole range."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Trajectory of one robot: knots connected by cubic polynomials.

    Between two knots the positions are the cubics that match the positions and velocities of both, as a controller with
    position and velocity input interpolates.
    """

    kind: Literal["free", "line"]
    """`free` moves clear of everything; `line` moves the tool straight to or from the place of a part, or on a move of
    its way."""
    times: Array
    """Seconds from the start of the trajectory, ascending from 0, shape (knots,)."""
    positions: Array
    """Shape (knots, joints)."""
    velocities: Array
    """Shape (knots, joints)."""
    part: int | None = None
    """Part in the gripper."""
    touches: int | None = None
    """Part in place, or put down, that the gripper may touch: an approach ends at it, or a retreat starts from it."""

    @property
    def seconds(self) -> float:
        """Duration."""
        return float(self.times[-1])

    def reverse(self) -> Trajectory:
        """Return the reverse trajectory, of the same duration."""
        return replace(
            self,
            times=(self.times[-1] - self.times[::-1]).copy(),
            positions=self.positions[::-1].copy(),
            velocities=-self.velocities[::-1],
        )

    def sample(self, seconds: Array) -> Array:
        """Return positions at given times, shape (samples,) to (samples, joints)."""
        return self._cubics(np.clip(seconds, 0.0, self.times[-1]))

    def rates(self, seconds: Array) -> Array:
        """Return velocities at given times, shape (samples,) to (samples, joints)."""
        return self._cubics(np.clip(seconds, 0.0, self.times[-1]), 1)

    def peaks(self) -> tuple[Array, Array]:
        """Return the exact largest speed and acceleration of each joint, both of shape (joints,)."""
        cubics, span = self._cubics, np.diff(self.times)
        # The speed is a parabola between two knots: it peaks at a knot or where the acceleration is zero.
        ends = np.abs(self.velocities).max(axis=0)
        first = cubics(self.times[:-1], 2)
        second = 2 * cubics(self.times[:-1] + span / 2, 2) - first
        with np.errstate(divide="ignore", invalid="ignore"):
            share = first / (first - second)
        inside = (share > 0) & (share < 1)
        top = np.zeros_like(first)
        rows, columns = np.nonzero(inside)
        moments = self.times[rows] + share[rows, columns] * (self.times[rows + 1] - self.times[rows])
        top[rows, columns] = np.abs(cubics(moments, 1)[np.arange(len(rows)), columns])
        return np.maximum(ends, top.max(axis=0)), np.maximum(np.abs(first), np.abs(second)).max(axis=0)

    def dense(self, step: float) -> tuple[Array, Array]:
        """Return times, and positions of which no joint differs from the previous one by more than `step`, rad or m."""
        times = [np.zeros(1)]
        reach = self.travel(self.times).max(axis=1)
        for begin, end, far in zip(self.times[:-1], self.times[1:], reach, strict=True):
            count = max(int(np.ceil(far / step)), 1)
            times.append(begin + (end - begin) * np.arange(1, count + 1) / count)
        found = np.concatenate(times)
        return found, self.sample(found)

    def travel(self, times: Array) -> Array:
        """Return bounds on how far each joint travels between times, knots included, shape (times - 1, joints)."""
        begin, end = times[:-1], times[1:]
        knot = np.clip(np.searchsorted(self.times, (begin + end) / 2, side="right") - 1, 0, len(self.times) - 2)
        span = np.diff(self.times)[:, None]
        # Speed between two knots as a quadratic in Bernstein form, then its part between two times in the same form.
        ends = span * self.velocities[:-1], span * self.velocities[1:]
        middle = 3 * np.diff(self.positions, axis=0) - ends[0] - ends[1]
        a, b = ((moment - self.times[knot])[:, None] / span[knot] for moment in (begin, end))

        def polar(s: Array, t: Array) -> Array:
            return (1 - s) * (1 - t) * ends[0][knot] + (s + t - 2 * s * t) * middle[knot] + s * t * ends[1][knot]

        return (b - a) * np.max([np.abs(polar(s, t)) for s, t in ((a, a), (a, b), (b, b))], axis=0)

    @cached_property
    def _cubics(self) -> Any:
        from scipy.interpolate import CubicHermiteSpline  # a tenth of a second to import

        return CubicHermiteSpline(self.times, self.positions, self.velocities)


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
        faults.append(
            f"a motion takes {format_quantity(trajectory.seconds, 'duration', 4)}; this arm needs no more than "
            f"{format_quantity(longest, 'duration', 4)}"
        )
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


def line_fault(tools: Array, longest: float) -> str:
    """Return why tool poses, shape (samples, 4, 4), are not on a short straight line, metres; empty if they are.

    On a line the tool moves in one direction only and does not turn.
    """
    far = tools[-1, :3, 3] - tools[0, :3, 3]
    length = float(np.linalg.norm(far))
    if fault := move_fault(tools, PathMove.straight((), far / length if length > 0 else far, length)):
        return fault
    if length > longest + STRAIGHT:
        return f"is a line of {1000 * length:.0f} mm; the cell allows {1000 * longest:.0f} mm"
    return ""


def move_fault(tools: Array, move: PathMove, *, whole: bool = False) -> str:
    """Return why tool poses, shape (samples, 4, 4), are not on a line, a turn or a screw; empty if they are.

    They go along it one way from its beginning, to its end if it is `whole`, and beyond only on a line.
    """
    what = f"is no turn by {np.degrees(move.angle):.0f} degrees" if move.turns else "is no straight line"
    along, at = np.array(move.direction), tools[:, :3, 3] - tools[0, :3, 3]
    if move.turns:
        turned = np.einsum("nij,kj->nik", tools[:, :3, :3], tools[0, :3, :3])
        sine = np.stack(
            [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]],
            axis=1,
        )
        cosine = (np.einsum("nii->n", turned) - 1) / 2
        share = np.unwrap(np.arctan2(sine @ along / 2, cosine)) / move.angle
        radius = float(np.linalg.norm(np.cross(tools[0, :3, 3] - np.array(move.point), along)))
        length = float(np.hypot(move.distance, max(radius, 0.1) * move.angle))
    else:
        length = move.distance
        share = at @ along / length if length > 0 else np.zeros(len(at))
    wanted = np.array([move.displacement(float(some)) for some in share]) @ tools[0]
    aside = float(np.linalg.norm(wanted[:, :3, 3] - tools[:, :3, 3], axis=1).max())
    if aside > STRAIGHT:
        return f"{what}: the tool is {1000 * aside:.1f} mm beside it"
    back = length * float((np.maximum.accumulate(share) - share).max())
    if back > STRAIGHT:
        return f"{what}: the tool turns back by {1000 * back:.1f} mm"
    trace = np.einsum("nij,nij->n", tools[:, :3, :3], wanted[:, :3, :3])
    turn = float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)).max())
    if turn > TURNED:
        return f"{what}: the tool turns by {np.degrees(turn):.1f} degrees"
    left = length * float(1 - share[-1])
    if (whole and abs(left) > STRAIGHT) or (move.turns and left < -STRAIGHT):
        return f"{what}: it ends {1000 * abs(left):.1f} mm {'before' if left > 0 else 'beyond'} its end"
    return ""
