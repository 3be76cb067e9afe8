"""Export of motions for execution: ROS 2 joint trajectories, tables, RAPID and URScript programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import starmap
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.errors import InputError, PlanError
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.commands import Grip, events_of
from falsework.robots.plans.grip_loads import GripLoad
from falsework.robots.plans.mcap_bag import PlacedParts, write_bag
from falsework.robots.plans.motion_limits import first_limit_fault
from falsework.robots.plans.presses import TimedPress, has_presses, timed_presses
from falsework.robots.plans.programs import rapid_modules, ur_scripts
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.robot_plan_file import rounded
from falsework.robots.plans.timeline import schedule_of
from falsework.utils.files.output_file import write_whole

Array = NDArray[np.float64]
Format = Literal["ros2-json", "ros2-yaml", "csv", "rapid", "urscript", "mcap"]

FORMATS: tuple[str, ...] = get_args(Format)

_NANO = 1_000_000_000


@dataclass(frozen=True)
class Written:
    """One file of an export."""

    name: str
    """Path inside the output folder."""
    text: str


def export_plan(
    plan: RobotPlan,
    folder: Path | str,
    form: str,
    *,
    rate: float = 50.0,
    structure: AnyStructure | None = None,
    cell: AnyCell | None = None,
) -> list[Path]:
    """Write the motions of a robot plan into a folder.

    Args:
        plan: the robot plan; reverse it first to export the assembly of a plan for disassembly.
        folder: output folder; created if it does not exist.
        form: `ros2-json` and `ros2-yaml` (one file per step and one for the plan), `csv` (the same, and one for presses
            if there are any), `rapid` and `urscript` (one program per robot, synchronised according to the schedule),
            or `mcap` (one bag with the times of the schedule).
        rate: positions per second for `csv` and `urscript`; the other formats get the knots.
        structure: structure of the plan; with it and the cell a bag has the shapes of the parts. A plan for assembly in
            which robots press needs both.
        cell: cell of the plan; with it nothing is written for other robots than those of the cell, nor motions and
            presses beyond its limits. Without it the plan is taken as it is.

    Returns:
        The files written.

    Raises:
        InputError: no such format, a rate that is not above zero, or a folder that cannot be written.
        PlanError: the plan is for another structure or cell, or exceeds the limits of the cell, or robots press and
            the structure or cell is missing.
    """
    if form not in FORMATS:
        raise InputError(f"no export format {form!r}; choose {', '.join(FORMATS)}")
    if not 0 < rate <= 10_000:
        raise InputError(f"a rate of {rate:g} positions per second cannot be exported; give one above 0, up to 10000")
    writers: dict[str, Callable[[], Iterable[Written]]] = {
        "ros2-json": lambda: _ros(plan, presses, "json"),
        "ros2-yaml": lambda: _ros(plan, presses, "yaml"),
        "csv": lambda: _csv(plan, presses, rate),
        "rapid": lambda: starmap(Written, rapid_modules(plan, presses)),
        "urscript": lambda: starmap(Written, ur_scripts(plan, rate, presses)),
    }
    placed = None
    if cell is not None:
        cell = as_cell(cell)
        plan.check_cell(cell)
        if fault := first_limit_fault(plan, cell):
            raise PlanError(f"the robot plan cannot be exported for {cell.name}: {fault}; plan again")
    presses = _presses(plan, structure, cell, form)
    if form == "mcap" and structure is not None and cell is not None:
        structure = as_assembly(structure)
        plan.check_identity(structure, cell)
        placed = PlacedParts(place_parts(structure, cell.placement), cell)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose another place") from None
    paths = []
    if form == "mcap":
        paths.append(folder / "plan.mcap")
        write_bag(plan, paths[0], placed, presses)
    for entry in writers[form]() if form in writers else ():
        path, data = folder / entry.name, entry.text.encode("utf-8", "backslashreplace")
        write_whole(path, lambda file, data=data: file.write(data))
        paths.append(path)
    return paths


def _presses(plan: RobotPlan, structure: AnyStructure | None, cell: Cell | None, form: str) -> tuple[TimedPress, ...]:
    """Return the presses of a plan, at the times of its schedule in a bag, else at those of one motion after the other.

    Raises:
        PlanError: structure or cell are missing, or a gripper of the cell bears less.
    """
    if not has_presses(plan):
        return ()
    if structure is None or cell is None:
        missing = "its structure" if structure is None else "its cell"
        raise PlanError(f"robots press in this plan, and only with the places of its parts it says how; give {missing}")
    graph = schedule_of(plan if form == "mcap" else replace(plan, schedule=None))
    presses = timed_presses(plan, as_assembly(structure), cell, graph)
    for press in presses:
        force, moment = np.split(press.wrench_in(press.tool), 2)
        load = GripLoad(press.step + 1, press.robot, press.part, force, moment, presses=True)
        if fault := load.fault(plan, cell):
            raise PlanError(f"the robot plan cannot be exported for {cell.name}: {fault}; plan again")
    return presses


# ROS 2


def joint_trajectory(plan: RobotPlan, robot: int, trajectory: Trajectory) -> dict[str, Any]:
    """Return a `trajectory_msgs/JointTrajectory` message as plain values.

    Args:
        plan: the robot plan.
        robot: number of the robot that moves.
        trajectory: one of its trajectories.
    """
    record = plan.robots[robot]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": record.name},
        "joint_names": [f"{record.name}_{joint}" for joint in record.joint_names],
        "points": [
            {
                "positions": rounded(positions),
                "velocities": rounded(velocities),
                "accelerations": [],
                "effort": [],
                "time_from_start": _duration(moment),
            }
            for moment, positions, velocities in zip(
                trajectory.times.tolist(), trajectory.positions, trajectory.velocities, strict=True
            )
        ],
    }


def _ros(plan: RobotPlan, presses: Sequence[TimedPress], kind: Literal["json", "yaml"]) -> Iterator[Written]:
    dump = _json if kind == "json" else _yaml
    everything = []
    start = 0.0
    for index in range(len(plan)):
        entries: list[dict[str, Any]] = []
        robot = plan.steps[index].robot
        for event in events_of(plan, index):
            if isinstance(event, Grip):
                what = "close" if event.close else "open"
                entries.append({"gripper": what, "robot": plan.robots[robot].name, "part": _part(plan, index)})
            else:
                message = joint_trajectory(plan, robot, event)
                entries.append(
                    {"robot": plan.robots[robot].name, "start": round(start, 9), "joint_trajectory": message}
                )
                start += event.seconds
        pressed = [_press(plan, press) for press in presses if press.step == index]
        step = {"step": index + 1, "do": plan.does(index), "sequence": entries, "presses": pressed}
        everything.append(step)
        yield Written(f"step-{index + 1:03d}.{kind}", dump(step))
    yield Written(f"plan.{kind}", dump({"name": plan.plan.name, "seconds": round(start, 9), "steps": everything}))


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
    part = int(plan.actions[index]) % len(plan.plan.boundary)
    if plan.steps[index].transit:
        part = next(leg.part for leg in plan.steps[index].trajectories if leg.part is not None)
    return plan.plan.part_names[part]


def _duration(seconds: float) -> dict[str, int]:
    whole = round(seconds * _NANO)
    return {"sec": whole // _NANO, "nanosec": whole % _NANO}


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def _yaml(value: Any, indent: int = 0) -> str:
    """Return plain values as YAML: mappings and lists of mappings in blocks, lists of numbers in one line."""
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
    """Return a number, a text or a list of such. YAML 1.1 reads 1e-05 as text, 1.0e-05 as a number."""
    if isinstance(value, list):
        return "[" + ", ".join(_yaml_value(entry) for entry in value) + "]"
    written = json.dumps(value, ensure_ascii=False)
    return written.replace("e", ".0e") if isinstance(value, float) and "." not in written else written


# Tables


def _csv(plan: RobotPlan, presses: Sequence[TimedPress], rate: float) -> Iterator[Written]:
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
                about = [index + 1, plan.does(index), plan.robots[robot].name, carried]
                rows.append([f"{start + moment:.6f}", *about, *joints])
            start += trajectory.seconds
        everything += rows
        yield Written(f"step-{index + 1:03d}.csv", _table(header, rows))
    yield Written("plan.csv", _table(header, everything))
    if presses:
        axes = [f"{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"]
        columns = [f"{frame}_{axis}" for frame in ("world", "tool") for axis in axes]
        rows = [_press_row(plan, press) for press in presses]
        yield Written("presses.csv", _table(["start", "end", "step", "robot", "part", *columns], rows))


def _press_row(plan: RobotPlan, press: TimedPress) -> list[Any]:
    about = [press.step + 1, plan.robots[press.robot].name, plan.plan.part_names[press.part]]
    numbers = [f"{value:.6f}" for value in (*press.wrench, *press.wrench_in(press.tool))]
    return [f"{press.start:.6f}", f"{press.end:.6f}", *about, *numbers]


def _table(header: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
