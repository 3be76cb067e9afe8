"""Loads of robots: parts in their grippers, and parts put down on the way to be gripped in another way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]

LoadKey = tuple[int, bytes, bytes]
_RIGID = 1e-6
"""Largest error of a rotation matrix."""


@dataclass(frozen=True, eq=False)
class Load:
    """Part that a robot carries, or has put down on the way."""

    part: int
    grip: Array | None
    """Configuration in which the robot grips the part at `pose`, shape (joints,); None: the part lies there."""
    pose: Array
    """Displacement of the part from its place in the structure, shape (4, 4)."""

    @property
    def lies(self) -> bool:
        """Whether the part is not in the gripper."""
        return self.grip is None

    @property
    def key(self) -> LoadKey:
        """Key that is equal for equal loads."""
        return self.part, b"" if self.grip is None else self.grip.tobytes(), self.pose.tobytes()


def load_of(plan: RobotPlan, step: int, motion: int | None) -> Load | None:
    """Return the load of a robot in a motion of a step; None without one.

    Args:
        plan: the robot plan.
        step: index of the step.
        motion: index of the trajectory; None for an action of the gripper.
    """
    entry, part = plan.steps[step], int(plan.actions[step]) - len(plan.plan.boundary)
    if motion is None or part < 0:
        return None
    apart = plan.direction is Direction.DISASSEMBLY
    lying = lying_motions(plan, step)
    if motion in lying:
        assert entry.put_down is not None
        return Load(part, None, entry.put_down)
    if entry.trajectories[motion].part is None:
        return None
    if not lying or (motion < lying.start) == apart:
        return Load(part, plan.keyframes[step + (0 if apart else 1)].configurations[entry.robot], np.eye(4))
    assert entry.put_down is not None
    first, last = entry.trajectories[lying.start], entry.trajectories[lying.stop - 1]
    return Load(part, last.positions[-1] if apart else first.positions[0], entry.put_down)


def lying_motions(plan: RobotPlan, step: int) -> range:
    """Return the motions of a step in which its part lies where it was put down; empty where it is not put down."""
    entry = plan.steps[step]
    if entry.put_down is None:
        return range(0)
    empty = [number for number, trajectory in enumerate(entry.trajectories) if trajectory.part is None]
    return range(empty[0], empty[-1] + 1) if empty else range(0)


def put_down_fault(plan: RobotPlan, step: int) -> str:
    """Return why the part of a step cannot be put down as the step says; empty if it can, or is not.

    Whether it is at rest there, and where the grippers are, needs the cell; see `check_robot_plan`.
    """
    entry, part = plan.steps[step], int(plan.actions[step]) - len(plan.plan.boundary)
    pose, lying = entry.put_down, lying_motions(plan, step)
    if pose is None:
        return ""
    if part < 0 or entry.hands_over is not None:
        return "a part is put down although it neither leaves the structure nor comes to it"
    name = plan.plan.part_names[part]
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() <= _RIGID and np.linalg.det(turn) > 0
    if not rigid or not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
        return f"{name} is put down with a pose that is not rigid"
    motions = entry.trajectories
    if len(lying) < 2 or lying.start == 0 or lying.stop == len(motions):
        return f"{name} is put down, but its robot does not carry it, leave it and carry it on"
    if any(motions[k].part is not None for k in lying):
        return f"{name} is put down more than once"
    if any(motions[k].kind != "line" or motions[k].touches != part for k in (lying.start, lying.stop - 1)):
        return f"the gripper must leave {name}, and take it again, on a line on which it may touch it"
    if any(motions[k].kind != "line" for k in (lying.start - 1, lying.stop)):
        return f"{name} must be put down, and lifted again, on a line"
    return ""
