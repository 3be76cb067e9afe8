"""ROS 2 messages of a robot plan as JSON or YAML: trajectories in order, and goals of each arm that keep a schedule."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from falsework.errors import InputError
from falsework.robots.exports.commands import (
    COUNT_FROM,
    AtOnce,
    Begin,
    Grip,
    Pressing,
    PublishCount,
    Wait,
    commands_of,
    events_of,
)
from falsework.robots.plans.robot_forces import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.robot_plan_file import rounded
from falsework.robots.plans.trajectory import Trajectory
from falsework.utils.lazy import importing

GOALS_FORMAT = "falsework.ros2-goals/1"
ONE_AFTER_THE_OTHER = ("ros2-json", "ros2-yaml", "csv")
"""Formats that do not keep a schedule."""
NANO = 1_000_000_000
"""Nanoseconds a second."""


def joint_trajectory(plan: RobotPlan, robot: int, trajectory: Trajectory, prefix: str = "") -> dict[str, Any]:
    """Return a trajectory of a robot as a `trajectory_msgs/JointTrajectory` message of plain values."""
    record = plan.robots[robot]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": record.name},
        "joint_names": joint_names(plan, robot, prefix),
        "points": [
            {
                "positions": rounded(positions),
                "velocities": rounded(velocities),
                "accelerations": [],
                "effort": [],
                "time_from_start": duration(moment),
            }
            for moment, positions, velocities in zip(
                trajectory.times.tolist(), trajectory.positions, trajectory.velocities, strict=True
            )
        ],
    }


def joint_names(plan: RobotPlan, robot: int, prefix: str) -> list[str]:
    """Return the names of the joints of a robot with a prefix, in which `{robot}` stands for the name of the robot."""
    record = plan.robots[robot]
    whole = prefix.replace("{robot}", record.name)
    if "{" in whole or "}" in whole:
        raise InputError(f"the prefix {prefix!r} has braces; {{robot}} stands for the name of the robot")
    return [f"{whole}{joint}" for joint in record.joint_names]


def all_joint_names(plan: RobotPlan) -> list[str]:
    """Return the names of the joints of all robots, each with the name of its robot before it."""
    return [joint for robot in range(len(plan.robots)) for joint in joint_names(plan, robot, "{robot}_")]


def lost_schedule(plan: RobotPlan, form: str) -> str:
    """Return that a format does not keep the schedule of a plan; empty if it does, or there is none."""
    if plan.schedule is None or form not in ONE_AFTER_THE_OTHER:
        return ""
    return (
        f"{form} has one motion after the other, {plan.seconds:.1f} s; the schedule of the plan takes "
        f"{plan.makespan:.1f} s: ros2-goals, mcap, rapid and urscript keep its order"
    )


def ros2_messages(
    plan: RobotPlan, presses: Sequence[TimedPress], kind: Literal["json", "yaml"], prefix: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield names and texts of files with the trajectories of each step, and of the plan, one after the other."""
    dump = _json if kind == "json" else _yaml
    everything = []
    start = 0.0
    for index in range(len(plan)):
        entries: list[dict[str, Any]] = []
        robots = plan.steps[index].robots
        # Robots that move at the same instant do nothing else in their step, and each has a message with one start.
        for events in zip(*(events_of(plan, index, robot) for robot in robots), strict=True):
            for robot, event in zip(robots, events, strict=True):
                about = {"robot": plan.robots[robot].name}
                if isinstance(event, Grip):
                    what = "close" if event.close else "open"
                    entries.append({"gripper": what, **about, "part": _part(plan, index)})
                else:
                    message = joint_trajectory(plan, robot, event, prefix)
                    entries.append({**about, "start": round(start, 9), "joint_trajectory": message})
            start += 0.0 if isinstance(events[0], Grip) else events[0].seconds
        pressed = [_press(plan, press) for press in presses if press.step == index]
        step = {"step": index + 1, "do": plan.does(index), "sequence": entries, "presses": pressed}
        everything.append(step)
        yield f"step-{index + 1:03d}.{kind}", dump(step)
    about = {"name": plan.plan.name, "direction": plan.direction.value, "seconds": round(start, 9)}
    if lost := lost_schedule(plan, f"ros2-{kind}"):
        about["schedule"] = lost
    yield f"plan.{kind}", dump({**about, "steps": everything})


def ros2_goals(plan: RobotPlan, presses: Sequence[TimedPress] = (), prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield one file with what each arm does: goals of `FollowJointTrajectory`, grips, presses, and waits for others.

    An arm counts what it has finished; another one waits for its count, which keeps the order of the schedule whatever
    the delays. Goals that are `at_once_with` those of other arms are to have one `stamp` at which all of these begin.
    """
    arms = []
    for robot, record in enumerate(plan.robots):
        entries: list[dict[str, Any]] = []
        step, beside = 0, list[str]()
        for command in commands_of(plan, robot, presses):
            if isinstance(command, Begin):
                step = command.step
                entries.append({"step": step + 1, "do": plan.does(step)})
            elif isinstance(command, Wait):
                entries.append({"wait_for": plan.robots[command.robot].name, "count": command.count})
            elif isinstance(command, PublishCount):
                entries.append({"count": command.count})
            elif isinstance(command, AtOnce):
                beside = [plan.robots[other].name for other in command.robots if other != robot]
            elif isinstance(command, Grip):
                entries.append({"gripper": "close" if command.close else "open", "part": _part(plan, step)})
            elif isinstance(command, Pressing):
                entries.append({"press" if command.begins else "stay": _press(plan, command.press)})
            else:
                message = joint_trajectory(plan, robot, command, prefix)
                message["header"]["frame_id"] = ""
                goal = {"trajectory": message, "path_tolerance": [], "goal_tolerance": []}
                entries.append({"goal": {**goal, "goal_time_tolerance": duration(0.0)}})
                if beside:
                    entries[-1]["at_once_with"], beside = beside, []
        start = plan.keyframes[0].configurations[robot]
        arms.append(
            {
                "robot": record.name,
                "joint_names": joint_names(plan, robot, prefix),
                "start": rounded(start),
                "sequence": entries,
            }
        )
    about = {"format": GOALS_FORMAT, "name": plan.plan.name, "direction": plan.direction.value}
    yield "goals.json", _json({**about, "count_from": COUNT_FROM, "arms": arms})


def _press(plan: RobotPlan, press: TimedPress) -> dict[str, Any]:
    """Return a press as plain values; the moment in the world is about the centre of mass of the part."""
    world, tool = np.split(press.wrench, 2), np.split(press.wrench_in(press.tool), 2)
    return {
        "robot": plan.robots[press.robot].name,
        "part": plan.plan.part_names[press.part],
        "mode": press.mode.value,
        "start": round(press.start, 9),
        "end": round(press.end, 9),
        "center": rounded(press.center),
        "world": {"force": rounded(world[0]), "torque": rounded(world[1])},
        "tool": {"force": rounded(tool[0]), "torque": rounded(tool[1])},
    }


def _part(plan: RobotPlan, index: int) -> str:
    part, step = int(plan.actions[index]) % len(plan.plan.boundary), plan.steps[index]
    if step.transit:  # what it carries, takes or lets go of
        part = next(part for leg in step.trajectories for part in (leg.part, leg.touches) if part is not None)
    return plan.plan.part_names[part]


def duration(seconds: float) -> dict[str, int]:
    """Return a `builtin_interfaces/Duration`, or `Time`, as plain values."""
    whole = round(seconds * NANO)
    return {"sec": whole // NANO, "nanosec": whole % NANO}


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def _yaml(value: Any) -> str:
    """Return plain values as YAML, lists of numbers in one line."""
    with importing("YAML files need PyYAML; pip install 'falsework[robots]'"):
        import yaml
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return yaml.dump(value, Dumper=dumper, allow_unicode=True, default_flow_style=None, sort_keys=False, width=1 << 20)
