"""Record of a robot in a plan, of which programs are made: it must be that of the cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from falsework.robots.model.cell import Cell
from falsework.utils.arrays import Array

_SAME_POSE = 1e-9
"""Entries of poses that differ by no more are equal."""


@dataclass(frozen=True, eq=False)
class RobotRecord:
    """Robot of a plan, described without its cell file."""

    name: str
    model: str
    joint_names: tuple[str, ...]
    base: Array
    """Pose of the base in the world, shape (4, 4)."""
    gripper: str
    tool: Array
    """Tool frame in the frame of the flange, shape (4, 4)."""


def records_of(cell: Cell) -> tuple[RobotRecord, ...]:
    """Return the records of the robots of a cell for a plan."""
    return tuple(
        RobotRecord(
            robot.name,
            robot.model.name,
            tuple(robot.model.joint_names),
            np.array(robot.base),
            robot.gripper.name,
            np.array(robot.gripper.tool),
        )
        for robot in cell.robots
    )


def record_fault(records: Sequence[RobotRecord], cell: Cell) -> str:
    """Return how the robots that a plan records differ from those of a cell, in its order; empty if they do not."""
    wanted = records_of(cell)
    if len(records) != len(wanted):
        return f"has {len(records)} robots, the cell {cell.name} has {len(wanted)}"
    for number, (mine, robot) in enumerate(zip(records, wanted, strict=True)):
        for entry in fields(RobotRecord):
            here, there = getattr(mine, entry.name), getattr(robot, entry.name)
            if isinstance(there, np.ndarray):
                if here.shape != there.shape or not np.abs(here - there).max() <= _SAME_POSE:
                    return f"has another {entry.name} pose for robot {robot.name} than the cell {cell.name}"
            elif here != there:
                what = entry.name.replace("_", " ")
                return f"says {here!r} as the {what} of robot {number}, not {there!r} as the cell {cell.name}"
    return ""
