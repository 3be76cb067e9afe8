"""Motions for those who carry them out: ROS 2 joint trajectories, tables, and ABB RAPID modules."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.robots.plans.mcap_bag import write_bag
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.search.problem.task import Direction
from falsework.utils.archive import write_whole

Array = NDArray[np.float64]
Format = Literal["ros2-json", "ros2-yaml", "csv", "rapid", "mcap"]

FORMATS: tuple[str, ...] = get_args(Format)

_NANO = 1_000_000_000


@dataclass(frozen=True)
class Written:
    """One file of an export."""

    name: str
    """Path inside the folder that is written."""
    text: str


def export_plan(plan: RobotPlan, folder: Path | str, form: str, *, rate: float = 50.0) -> list[Path]:
    """Write the motions of a robot plan into a folder.

    Args:
        plan: what to write; reverse it first to export the assembly of a plan for disassembly.
        folder: where to; made if it is not there.
        form: `ros2-json` and `ros2-yaml` (one file a step and one for the plan), `csv` (the same), or `rapid` (one
            module a robot), or `mcap` (one bag with the times of the schedule).
        rate: positions a second for `csv` and `rapid`; ROS 2 gets the knots with their velocities.

    Returns:
        The files written.

    Raises:
        InputError: no such format, a rate that is not above zero, or a folder that cannot be written.
    """
    if form not in FORMATS:
        raise InputError(f"no export format {form!r}; choose {', '.join(FORMATS)}")
    if not 0 < rate <= 10_000:
        raise InputError(f"a rate of {rate:g} positions a second cannot be exported; give one up to 10000")
    writers: dict[str, Callable[[], Iterable[Written]]] = {
        "ros2-json": lambda: _ros(plan, "json"),
        "ros2-yaml": lambda: _ros(plan, "yaml"),
        "csv": lambda: _csv(plan, rate),
        "rapid": lambda: _rapid(plan),
    }
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose another place") from None
    paths = []
    if form == "mcap":
        paths.append(folder / "plan.mcap")
        write_bag(plan, paths[0])
    for entry in writers[form]() if form in writers else ():
        path, data = folder / entry.name, entry.text.encode()
        write_whole(path, lambda file, data=data: file.write(data))
        paths.append(path)
    return paths


# ROS 2


def joint_trajectory(plan: RobotPlan, robot: int, trajectory: Trajectory, start: float = 0.0) -> dict[str, Any]:
    """A `trajectory_msgs/JointTrajectory` message as plain values; its times begin at `start` seconds."""
    record = plan.robots[robot]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": record.name},
        "joint_names": [f"{record.name}_{joint}" for joint in record.joint_names],
        "points": [
            {
                "positions": _plain(positions),
                "velocities": _plain(velocities),
                "accelerations": [],
                "effort": [],
                "time_from_start": _duration(start + moment),
            }
            for moment, positions, velocities in zip(
                trajectory.times.tolist(), trajectory.positions, trajectory.velocities, strict=True
            )
        ],
    }


def _ros(plan: RobotPlan, kind: Literal["json", "yaml"]) -> Iterator[Written]:
    dump = _json if kind == "json" else _yaml
    everything = []
    start = 0.0
    for index in range(len(plan)):
        entries = []
        for event, robot, trajectory in _events(plan, index):
            if trajectory is None:
                entries.append({"gripper": event, "robot": plan.robots[robot].name, "part": _part(plan, index)})
            else:
                message = joint_trajectory(plan, robot, trajectory)
                entries.append(
                    {"robot": plan.robots[robot].name, "start": round(start, 9), "joint_trajectory": message}
                )
                start += trajectory.seconds
        step = {"step": index + 1, "do": plan.plan.describe(index), "sequence": entries}
        everything.append(step)
        yield Written(f"step-{index + 1:03d}.{kind}", dump(step))
    yield Written(f"plan.{kind}", dump({"name": plan.plan.name, "seconds": round(start, 9), "steps": everything}))


def _events(plan: RobotPlan, index: int) -> Iterator[tuple[str, int, Trajectory | None]]:
    """Motions of a step and what the gripper does between them, in time."""
    step = plan.steps[index]
    parts = len(plan.plan.boundary)
    removes = int(plan.plan.actions[index]) >= parts
    apart = plan.direction is Direction.DISASSEMBLY
    # Taking apart: hold = approach, close; remove = leave, carry, open. Putting together is the mirror image.
    before = None if apart else "close" if removes else "open"
    after = None if not apart else "open" if removes else "close"
    if before is not None:
        yield before, step.robot, None
    for trajectory in step.trajectories:
        yield "move", step.robot, trajectory
    if after is not None:
        yield after, step.robot, None


def _part(plan: RobotPlan, index: int) -> str:
    parts = len(plan.plan.boundary)
    return plan.plan.part_names[int(plan.plan.actions[index]) % parts]


def _duration(seconds: float) -> dict[str, int]:
    whole = round(seconds * _NANO)
    return {"sec": whole // _NANO, "nanosec": whole % _NANO}


def _plain(values: Array) -> list[float]:
    return (np.round(values, 9) + 0.0).tolist()


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def _yaml(value: Any, indent: int = 0) -> str:
    """Plain values as YAML: mappings and lists of mappings in blocks, lists of numbers in one line."""
    space = "  " * indent
    lines = []
    if isinstance(value, dict):
        for key, entry in value.items():
            if isinstance(entry, dict) or (isinstance(entry, list) and entry and isinstance(entry[0], dict)):
                lines.append(f"{space}{key}:\n{_yaml(entry, indent + 1)}")
            else:
                lines.append(f"{space}{key}: {_yaml_value(entry)}\n")
    else:
        for entry in value:
            block = _yaml(entry, indent + 1)
            lines.append(f"{space}- {block[2 * (indent + 1) :]}")
    return "".join(lines)


def _yaml_value(value: Any) -> str:
    """A number, a text or a list of such. YAML 1.1 takes 1e-05 for a text, 1.0e-05 for a number."""
    if isinstance(value, list):
        return "[" + ", ".join(_yaml_value(entry) for entry in value) + "]"
    written = json.dumps(value, ensure_ascii=False)
    return written.replace("e", ".0e") if isinstance(value, float) and "." not in written else written


# Tables


def _csv(plan: RobotPlan, rate: float) -> Iterator[Written]:
    header = ["time", "step", "do", "moving", "carried"]
    header += [f"{robot.name}_{joint}" for robot in plan.robots for joint in robot.joint_names]
    everything: list[list[Any]] = []
    start = 0.0
    for index in range(len(plan)):
        rows: list[list[Any]] = []
        standing = [np.array(values) for values in plan.keyframes[index].configurations]
        for trajectory in plan.steps[index].trajectories:
            robot = plan.steps[index].robot
            count = max(int(np.ceil(trajectory.seconds * rate)), 1)
            moments = np.linspace(0.0, trajectory.seconds, count + 1)
            carried = "" if trajectory.part is None else plan.plan.part_names[trajectory.part]
            for moment, positions in zip(moments, trajectory.sample(moments), strict=True):
                standing[robot] = positions
                joints = [f"{value:.7f}" for values in standing for value in values]
                about = [index + 1, plan.plan.describe(index), plan.robots[robot].name, carried]
                rows.append([f"{start + moment:.6f}", *about, *joints])
            start += trajectory.seconds
        everything += rows
        yield Written(f"step-{index + 1:03d}.csv", _table(header, rows))
    yield Written("plan.csv", _table(header, everything))


def _table(header: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


# RAPID


def _rapid(plan: RobotPlan) -> Iterator[Written]:
    names = _distinct([_identifier(robot.name) for robot in plan.robots])
    for robot, name in enumerate(names):
        yield Written(f"{name}.mod", _rapid_module(plan, robot, name))


def _rapid_module(plan: RobotPlan, robot: int, name: str) -> str:
    """A module with one procedure a step; other robots' steps only wait for their turn.

    Knots become joint targets in degrees that `MoveAbsJ` goes to in the time that the plan gives them. Steps are kept
    in order across robots by `WaitSyncTask`, so that only one robot moves.
    """
    record = plan.robots[robot]
    if len(record.joint_names) not in (6, 7):
        raise InputError(f"RAPID supports robots of 6 or 7 joints; {record.name} has {len(record.joint_names)}")
    tasks = ", ".join(f'["T_{entry}"]' for entry in _distinct([_identifier(r.name) for r in plan.robots]))
    lines = [
        f"MODULE {name}",
        f"  ! {_comment(plan.plan.name)}: {plan.direction.value} with {_comment(record.model)}, {len(plan)} steps",
        f"  PERS tooldata {name}_tool := {_tooldata(record.tool)};",
        f"  PERS tasks all_tasks{{{len(plan.robots)}}} := [{tasks}];",
    ]
    lines += [f"  VAR syncident sync_{index + 1};" for index in range(len(plan))]
    targets: list[str] = []
    procedures: list[str] = []
    mine: list[int] = []
    for index, step in enumerate(plan.steps):
        if step.robot != robot:
            continue
        mine.append(index)
        procedures.append(f"  PROC {name}_step{index + 1}()")
        procedures.append(f"    ! {_comment(plan.plan.describe(index))}")
        for event, _, trajectory in _events(plan, index):
            if trajectory is None:
                procedures.append(f"    {name}_gripper {'TRUE' if event == 'close' else 'FALSE'};")
                continue
            last = len(trajectory.times) - 1
            for knot in range(1, last + 1):
                target = f"{name}_j{index + 1}_{len(targets) + 1}"
                targets.append(f"  CONST jointtarget {target} := {_jointtarget(trajectory.positions[knot])};")
                seconds = trajectory.times[knot] - trajectory.times[knot - 1]
                zone = "fine" if knot == last else "z0"
                procedures.append(f"    MoveAbsJ {target}, v1000\\T:={max(seconds, 0.001):.3f}, {zone}, {name}_tool;")
        procedures.append("  ENDPROC")
    lines += targets
    lines += [
        f"  PROC {name}_gripper(bool closed)",
        "    IF closed THEN",
        f"      SetDO do_{name}_grip, 1;",
        "    ELSE",
        f"      SetDO do_{name}_grip, 0;",
        "    ENDIF",
        "    WaitTime\\InPos, 0.5;",
        "  ENDPROC",
        *procedures,
        f"  PROC {name}_run()",
        f"    MoveAbsJ {_jointtarget(plan.keyframes[0].configurations[robot])}, v200, fine, {name}_tool;",
    ]
    for index in range(len(plan)):
        lines.append(f"    WaitSyncTask sync_{index + 1}, all_tasks;")
        if index in mine:
            lines.append(f"    {name}_step{index + 1};")
    lines += ["  ENDPROC", "ENDMODULE"]
    return "\n".join(lines) + "\n"


def _jointtarget(values: Array) -> str:
    degrees = np.degrees(values)
    robax = ",".join(f"{value:.5f}" for value in degrees[:6])
    seventh = f"{degrees[6]:.5f}" if len(degrees) > 6 else "9E9"
    return f"[[{robax}],[{seventh},9E9,9E9,9E9,9E9,9E9]]"


def _tooldata(tool: Array) -> str:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(tool[:3, :3]).as_quat()
    turn = ",".join(f"{value:.7f}" for value in (w, x, y, z))
    place = ",".join(f"{1000 * value:.3f}" for value in tool[:3, 3])
    return f"[TRUE,[[{place}],[{turn}]],[1,[0,0,50],[1,0,0,0],0,0,0]]"


def _identifier(text: str) -> str:
    """A RAPID name: letters, digits and underscores, a letter first, short enough to leave room for endings."""
    made = re.sub(r"\W", "_", text, flags=re.ASCII)
    return (made if made[:1].isalpha() else f"r{made}")[:16]


def _distinct(names: list[str]) -> list[str]:
    """RAPID names are equal whatever their case."""
    found: list[str] = []
    for name in names:
        chosen, number = name, 2
        while chosen.lower() in (entry.lower() for entry in found):
            chosen, number = f"{name[:13]}_{number}", number + 1
        found.append(chosen)
    return found


def _comment(text: str) -> str:
    return re.sub(r"[^ -~]", "?", text)
