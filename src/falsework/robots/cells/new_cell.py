"""First draft of a cell file: arms around the structure that face it, a gripper, homes and places that are free."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import CellError
from falsework.robots.cells.cell_file import FORMAT, parse_cell
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.cells.validate import has_home, home_faults, home_text, no_parts, with_homes
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.builtin_robots import BUILTIN
from falsework.robots.model.cell import Cell, CellRobot, maker_of
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.model.shapes import looking_down
from falsework.utils.quantity import format_number

GripperKind = Literal["suction", "jaw"]

DISTANCE = 0.62
"""Distance of the bases from the middle of the structure, as a share of the longest reach."""
CLEAR = 0.2
"""Distance of a base from the structure, and width that it needs, as shares of the longest reach."""
_PLACES = (0.50, 0.42, 0.34, 0.26)
"""Distances of places beside an arm that are tried, as shares of its reach."""


@dataclass(frozen=True)
class Arm:
    """Arm of a new cell."""

    name: str
    model: str
    """Name of a built-in arm, or path of a URDF file."""


def new_cell(
    arms: Sequence[Arm], folder: Path, *, gripper: GripperKind = "suction", assembly: Assembly | None = None
) -> str:
    """Return the text of a cell file with some arms, evenly spaced around the structure, whose middle they face.

    Bases and homes are clear of the structure; without one the origin is in the middle.
    """
    if not arms:
        raise CellError(f"a cell needs an arm; give built-in ones, {', '.join(sorted(BUILTIN))}, or URDF files")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CellWarning)  # the cell is read again, with warnings, when it is used
        nowhere = [(0.0, 0.0, 0.0)] * len(arms)
        cell = parse_cell(_text(arms, folder, gripper, nowhere), "the new cell", folder)
        parts = no_parts() if assembly is None else place_parts(assembly, cell.placement)
        bases = _bases(cell, parts)
        cell = parse_cell(_text(arms, folder, gripper, bases), "the new cell", folder)
        wrong = [
            robot for robot, entry in enumerate(cell.robots) if not has_home(entry) or home_faults(cell, parts, robot)
        ]
        cell = with_homes(cell, parts, wrong)
    return _text(arms, folder, gripper, bases, cell)


def _bases(cell: Cell, parts: PartShapes) -> list[tuple[float, float, float]]:
    """Return x and y, metres, and yaw, degrees, of the base of each robot: around the structure, and clear of it."""
    points = np.concatenate([mesh.vertices[:, :2] for mesh in parts.meshes]) if parts.meshes else np.zeros((1, 2))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = max(robot.model.reach for robot in cell.robots)
    found = []
    for number in range(len(cell.robots)):
        angle = np.pi + 2 * np.pi * number / len(cell.robots)
        way = np.array([np.cos(angle), np.sin(angle)])
        ahead = (points - middle) @ way
        near = np.abs((points - middle) @ [-way[1], way[0]]) < CLEAR * reach
        extent = float(ahead[near].max(initial=0.0))
        x, y = middle + max(DISTANCE * reach, extent + CLEAR * reach) * way
        found.append((round(float(x), 3) + 0.0, round(float(y), 3) + 0.0, float(np.degrees(angle) + 180) % 360))
    return found


def _text(
    arms: Sequence[Arm],
    folder: Path,
    gripper: GripperKind,
    bases: Sequence[tuple[float, float, float]],
    cell: Cell | None = None,
) -> str:
    names = [arm.name for arm in arms]
    grippers = files("falsework.robots.cells").joinpath("new_grippers.txt").read_text(encoding="utf-8")
    lines = [
        "# Lengths in metres, angles in degrees, masses in kilograms. Look at it while you edit: falsework view",
        f'format = "{FORMAT}"',
        f'name = "{_quoted(" and ".join([", ".join(names[:-1])] * bool(names[:-1]) + names[-1:]))}"',
        "speed = 0.5                         # share of the largest speed of the arms",
        "floor = 0.0",
        "",
        "[structure]                         # where it stands, and its size",
        "position = [0.0, 0.0, 0.0]",
        "scale = 1.0",
        "",
        grippers.split("\n\n")[gripper == "jaw"].rstrip("\n") + "\n",
    ]
    for number, (arm, (x, y, yaw)) in enumerate(zip(arms, bases, strict=True)):
        lines += [
            "[[robots]]",
            f'name = "{_quoted(arm.name)}"',
            f'model = "{_quoted(_model(arm.model, folder))}"',
            f'gripper = "{"cup" if gripper == "suction" else "jaw"}"',
            f"base = {{ position = [{x:g}, {y:g}, 0.0], yaw = {yaw:g} }}",
        ]
        if cell is not None:
            lines += _of_robot(cell, number)
        lines.append("")
    return "\n".join(lines)


def _of_robot(cell: Cell, number: int) -> list[str]:
    """Return home, places and hints of a robot."""
    robot = cell.robots[number]
    model = robot.model
    lines = [f"home = {home_text(model, robot.home)}  # of {', '.join(model.joint_names)}"]
    if model.assumed:
        numbers = ", ".join(f"{round(float(value), 2):g}" for value in model.acceleration / model.units)
        lines.append(f"# acceleration = [{numbers}]  # from the data sheet; these are assumed")
    if model.source != "built-in":
        maker, _ = maker_of(robot)
        lines.append(
            f'maker = "{maker}"  # after the name of its description; programs are for arms of one maker'
            if maker
            else '# maker = "..."                    # programs for controllers are for arms of one maker'
        )
    lines.append('# signals = { grip = "..." }         # output that closes the gripper, for programs')
    places = _places(robot)
    if places:
        shown = ", ".join(
            f"{{ position = [{format_number(x)}, {format_number(y)}, {format_number(z)}] }}" for x, y, z in places
        )
        lines.append(f"places = [{shown}]  # in the frame of the base")
    else:
        lines.append("# places = [{ position = [...] }]   # where parts are picked up, in the frame of the base")
    return lines


def _places(robot: CellRobot) -> list[tuple[float, float, float]]:
    """Return places on both sides of an arm that it reaches with its tool down, in the frame of its base."""
    found = []
    for side in (-1.0, 1.0):
        for share in _PLACES:
            at = (0.1 * robot.model.reach, side * share * robot.model.reach, 0.3 * robot.model.reach)
            if len(inverse(robot, looking_down(robot.base, at)[None])[0]):
                found.append(at)
                break
    return found


def _model(model: str, folder: Path) -> str:
    """Return a model as a file in a folder names it."""
    if model in BUILTIN or not model.lower().endswith((".urdf", ".xml")):
        return model
    return Path(os.path.relpath(Path(model).resolve(), folder.resolve())).as_posix()


def _quoted(text: str) -> str:
    """Return text for a string of TOML."""
    return text.replace("\\", "\\\\").replace('"', '\\"')
