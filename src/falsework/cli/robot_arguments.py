"""Parsers of robot configurations and held parts given as command-line arguments."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.cli.arguments import parse_parts, parse_state
from falsework.errors import InputError
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.robots.model.cell import Cell


def parse_joints(text: str | None, cell: Cell) -> list[Any] | None:
    """Read configurations of the robots of a cell; those that are not named are at home.

    Args:
        text: such as `left=0,0.1,-0.5,0,1,0;right=home`, or a JSON file with an object of lists by robot; rad.

    Returns:
        Joint values of every robot, not yet checked against its limits; None where nothing is given.
    """
    if text is None:
        return None
    found: list[Any] = list(cell.homes)
    for name, given in _by_robot(text, "--joints").items():
        robot = _robot(name, cell, "--joints")
        if given != "home":
            found[robot] = _values(given, f"--joints: {name}", ", or `home`")
    return found


def parse_grips(
    text: str | None, held: Sequence[int | None], state: States, cell: Cell, assembly: Assembly
) -> list[Any]:
    """Read the configurations in which robots would hold the parts that they carry at the places of these.

    Args:
        text: as for `parse_joints`, or the file of a robot plan in which the robots hold these parts.

    Returns:
        For every robot joint values, not yet checked against its limits, or None where nothing is given.
    """
    found: list[Any] = [None] * cell.robot_count
    if text is None:
        return found
    if Path(text).is_file() and isinstance(content := _json_file(text, "--grips"), dict) and "format" in content:
        from falsework.robots.plans.robot_plan_file import robot_plan_from_dict

        plan = robot_plan_from_dict(content, text)
        plan.check_identity(assembly, cell)
        carried = [None if part is None or state[part] else part for part in held]
        return [None if part is None else plan.grip_of(robot, part) for robot, part in enumerate(carried)]
    for name, given in _by_robot(text, "--grips").items():
        found[_robot(name, cell, "--grips")] = _values(given, f"--grips: {name}", "")
    return found


def parse_now(text: str, held: Sequence[int | None], assembly: Assembly) -> States:
    """Read the state at the start, in which robots hold some parts, shape (parts,)."""
    from falsework.assembly.state import HELD, REMOVED

    state = parse_state(text, "--state", assembly).copy()
    for part in held:
        if part is not None and state[part] != REMOVED:
            state[part] = HELD
    return state


def _values(given: Any, what: str, other: str) -> list[float]:
    try:
        return [float(value) for value in given.split(",")] if isinstance(given, str) else _numbers(given)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {given!r}; give joint values in rad{other}") from None


def _numbers(values: Any) -> list[float]:
    """Return a list of JSON numbers; a bool, a text or another list in it is none."""
    if not isinstance(values, list) or any(isinstance(value, bool | str) for value in values):
        raise TypeError
    return [float(value) for value in values]


def _by_robot(text: str, option: str) -> dict[str, Any]:
    if "=" in text and not Path(text).is_file():
        pairs = [_pair(piece, option, "left=0,0.1,-0.5,0,1,0;right=0,0,0,0,0,0") for piece in text.split(";")]
        if len({name for name, _ in pairs}) < len(pairs):
            raise InputError(f"{option} {text}: a robot has one configuration; name each robot once")
        return dict(pairs)
    content = _json_file(text, option)
    if not isinstance(content, dict):
        raise InputError(f"{option} {text} contains no object; give lists of joint values by robot")
    return content


def _json_file(text: str, option: str) -> Any:
    try:
        return parse_json(read_text(text))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, ValueError):
        raise InputError(f"{option} {text}: no JSON file; give one, or values such as left=0,0,0,0,0,0") from None


def parse_holding(text: str | None, cell: Cell, assembly: Assembly) -> list[int | None]:
    """Read which part each robot holds, such as `left=3,right=keystone`."""
    held: list[int | None] = [None] * cell.robot_count
    for piece in () if text is None else text.split(","):
        name, part = _pair(piece, "--holding", "left=3,right=keystone")
        robot = _robot(name, cell, "--holding")
        numbers = parse_parts(part, "--holding", assembly.names)
        number = numbers[0]
        if len(numbers) > 1:
            raise InputError(f"--holding {piece}: a robot holds one part; name one")
        if not 0 <= number < assembly.part_count:
            raise InputError(f"--holding {piece}: no part {number}; there are 0 to {assembly.part_count - 1}")
        if assembly.boundary[number]:
            raise InputError(f"--holding {piece}: part {assembly.names[number]} is fixed, so no robot holds it")
        if held[robot] is not None or number in held:
            raise InputError(f"--holding {text}: a robot holds one part, and a part is held by one robot")
        held[robot] = number
    return held


def _pair(piece: str, option: str, example: str) -> tuple[str, str]:
    name, sign, value = piece.strip().partition("=")
    if not (name and sign and value):
        raise InputError(f"{option}: {piece!r} names no robot and value; give {example}")
    return name.strip(), value.strip()


def _robot(name: str, cell: Cell, option: str) -> int:
    names = [robot.name for robot in cell.robots]
    if name not in names:
        raise InputError(f"{option}: the cell {cell.name} has no robot {name!r}; there are {', '.join(names)}")
    return names.index(name)
