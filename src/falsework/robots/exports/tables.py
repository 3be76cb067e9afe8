"""Tables of the motions of a robot plan as CSV: positions of all joints at a fixed rate, and presses."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from falsework.robots.plans.robot_forces import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan

_PRESS_ENDS = ("mode", "center_x", "center_y", "center_z")
"""Last columns of the table of presses: what robots control, and the point of the moment in the world, metres."""


def csv_tables(plan: RobotPlan, presses: Sequence[TimedPress], rate: float) -> Iterator[tuple[str, str]]:
    """Yield a table for each step and one for the plan, with one motion after the other, at some rows per second.

    The first column is `time`, for a plan with a schedule, which the table does not keep, `time_without_schedule`.
    """
    header = ["time" if plan.schedule is None else "time_without_schedule", "step", "do", "moving", "carried"]
    header += [f"{robot.name}_{joint}" for robot in plan.robots for joint in robot.joint_names]
    everything: list[list[Any]] = []
    start = 0.0
    for index in range(len(plan)):
        rows: list[list[Any]] = []
        standing = [np.array(values) for values in plan.keyframes[index].configurations]
        robots = plan.steps[index].robots
        moving = " and ".join(plan.robots[robot].name for robot in robots)
        for legs in zip(*(plan.steps[index].of(robot) for robot in robots), strict=True):
            seconds = legs[0].seconds
            moments = np.linspace(0.0, seconds, max(int(np.ceil(seconds * rate)), 1) + 1)
            carried = " and ".join(plan.plan.part_names[leg.part] for leg in legs if leg.part is not None)
            samples = [leg.sample(moments) for leg in legs]
            for row, moment in enumerate(moments):
                for robot, positions in zip(robots, samples, strict=True):
                    standing[robot] = positions[row]
                joints = [f"{value:.7f}" for values in standing for value in values]
                rows.append([f"{start + moment:.6f}", index + 1, plan.does(index), moving, carried, *joints])
            start += seconds
        everything += rows
        yield f"step-{index + 1:03d}.csv", _table(header, rows)
    yield "plan.csv", _table(header, everything)
    if presses:
        axes = [f"{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"]
        columns = [f"{frame}_{axis}" for frame in ("world", "tool") for axis in axes]
        rows = [_press_row(plan, press) for press in presses]
        yield "presses.csv", _table(["start", "end", "step", "robot", "part", *columns, *_PRESS_ENDS], rows)


def _press_row(plan: RobotPlan, press: TimedPress) -> list[Any]:
    about = [press.step + 1, plan.robots[press.robot].name, plan.plan.part_names[press.part]]
    numbers = [f"{value:.6f}" for value in (*press.wrench, *press.wrench_in(press.tool))]
    center = [f"{value:.6f}" for value in press.center]
    return [f"{press.start:.6f}", f"{press.end:.6f}", *about, *numbers, press.mode.value, *center]


def _table(header: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
