"""Controllers of arms: their makers, signals and names in programs, and what must be set up at them."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np

from falsework.errors import InputError
from falsework.robots.model.cell import Cell, CellRobot, maker_of
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.utils.quantity import format_number

Language = Literal["rapid", "urscript"]

MAKERS: dict[Language, str] = {"rapid": "ABB", "urscript": "Universal Robots"}
"""Maker whose controllers run a language."""
REGISTER = 128
"""First general-purpose Modbus register of a UR controller."""
_UPRIGHT = 0.1
"""Degrees up to which a base counts as upright."""
_SIGNALS: dict[Language, tuple[str, str]] = {
    "rapid": (r"[A-Za-z]\w{0,31}", "the name of a digital output, such as do_vacuum"),
    "urscript": (r"(standard|configurable|tool) [0-7]", "standard, configurable or tool and a number, such as tool 0"),
}


def check_makers(cell: Cell, language: Language) -> None:
    """Raise InputError if arms are not, or not known to be, of the maker whose controllers run a language."""
    wanted = MAKERS[language]
    for robot in cell.robots:
        maker, _ = maker_of(robot)
        if maker is None:
            raise InputError(
                f"{language} programs are for arms of {wanted}, and the maker of robot {robot.name}, "
                f'{robot.model.name}, is unknown; if it is one, write maker = "{wanted}" into its entry of the cell '
                "(--force writes them all the same)"
            )
        if maker.strip().casefold() != wanted.casefold():
            raise InputError(
                f"{language} programs are for arms of {wanted}, and robot {robot.name} ({robot.model.name}) is of "
                f"{maker}; choose another format (--force writes them all the same)"
            )


def grip_signal(robot: CellRobot, name: str, language: Language) -> str:
    """Return the output that closes the gripper of a robot; InputError if the language does not have it."""
    standard = f"do_{name}_grip" if language == "rapid" else "standard 0"
    given = robot.signals.grip or standard
    pattern, example = _SIGNALS[language]
    if not re.fullmatch(pattern, given):
        raise InputError(f"signals.grip of robot {robot.name} is {given!r}; for {language} give {example}")
    return given


def program_axes(robot: CellRobot, language: Language) -> list[int]:
    """Return the joints of a robot in the order in which a language has them: six axes, in RAPID perhaps one more.

    That is a track, the only joint that slides, or the seventh axis of an arm, which is not the last one of its chain;
    the names of the joints tell which one it is. InputError for an arm that the language cannot move.
    """
    model, axes = robot.model, range(robot.model.joints)
    sliding = [joint for joint in axes if model.prismatic[joint]]
    if model.joints == 6 and not sliding:
        return [*axes]
    if language == "rapid" and model.joints == 7 and len(sliding) == 1:
        return [joint for joint in axes if joint not in sliding] + sliding
    if language == "rapid" and model.joints == 7 and not sliding:
        found = [re.fullmatch(r"\D*([1-7])\D*", name) for name in model.joint_names]
        numbers = [int(number[1]) - 1 for number in found if number is not None]
        if sorted(numbers) == [*axes]:
            return [numbers.index(joint) for joint in axes]
        raise InputError(
            f"RAPID has the seventh axis of {robot.name} apart from the others, and its joints do not tell which one "
            f"that is: {', '.join(model.joint_names)}; give them names with the numbers 1 to 7 in its URDF file"
        )
    more = ", and perhaps a track or a seventh axis" if language == "rapid" else ""
    raise InputError(
        f"{language} programs are for arms of six turning joints{more}; {robot.name} has {model.joints} joints, "
        f"{len(sliding)} of which slide"
    )


def program_notes(cell: Cell, language: Language) -> list[str]:
    """Return what programs take for granted, and could be wrong, each in one line."""
    notes = []
    for robot in cell.robots:
        maker, from_name = maker_of(robot)
        if from_name:
            notes.append(
                f"robot {robot.name} is taken to be of {maker} after the name {robot.model.name} of its description; "
                "maker in its entry of the cell states it"
            )
    for gripper in {robot.gripper.name: robot.gripper for robot in cell.robots}.values():
        lacks = [
            text
            for text, missing in (
                ("mass", gripper.mass == 0),
                ("center_of_mass (that of its shapes is used)", gripper.center_of_mass is None),
                ("inertia (zero is used)", gripper.inertia is None),
            )
            if missing
        ]
        if lacks:
            notes.append(f"the tool load in programs lacks {', '.join(lacks)}: add it to [grippers.{gripper.name}]")
    return notes


def controller_settings(plan: RobotPlan, cell: Cell, robot: int, language: Language) -> list[str]:
    """Return what must be set up at the controller of a robot for its program, each in one line."""
    names = program_names(plan)
    entry, level = cell.robots[robot], int(cell.robots[robot].signals.closed)
    output = grip_signal(entry, names[robot], language)
    lines = [f"digital output {output} at {level} closes the gripper"]
    tilt = np.degrees(np.arccos(np.clip(entry.base[2, 2], -1.0, 1.0)))
    if tilt > _UPRIGHT:  # controllers take weights to act along their own z
        lines.append(f"it is mounted {format_number(tilt, 3)} degrees off upright, as the cell has its base")
    others = [k for k in range(len(names)) if k != robot]
    if language == "urscript":
        reads = [f"its register {REGISTER} is read at {address_of(entry, names[robot])} by the others"]
    else:
        joint = {k for step in plan.steps if step.partners for k in step.robots}
        if robot in joint:
            tasks = ", ".join(f"{names[k]} {rapid_task(k)}" for k in sorted(joint))
            lines.append(f"arms of one MultiMove controller, with the motion tasks {tasks}")
        if len(axes := program_axes(entry, language)) > 6:
            lines.append(f"joint {entry.model.joint_names[axes[6]]} is external axis a")
        reads = [f"group output go_{names[robot]}_count, 16 bits, counts its motions"]
        reads += [f"group input gi_{names[k]}_count, 16 bits, is connected to go_{names[k]}_count" for k in others]
    return lines + reads * bool(others)


def rapid_task(robot: int) -> str:
    """Return the name of the motion task of a robot at a MultiMove controller."""
    return f"T_ROB{robot + 1}"


def address_of(robot: CellRobot, name: str) -> str:
    """Return the network address of the controller of a robot with a name in a program."""
    return ascii_text(robot.signals.address or f"{name}.local").replace('"', "'")  # URScript has no escapes


def program_names(plan: RobotPlan, size: int = 16) -> list[str]:
    """Return distinct names of the robots of a plan: letters, digits and underscores, a letter first, of limited size.

    By default they are short enough for suffixes in both languages. Case does not count in RAPID.
    """
    found: list[str] = []
    for robot in plan.robots:
        name = re.sub(r"\W", "_", robot.name, flags=re.ASCII)
        name = (name if name[:1].isalpha() else f"r{name}")[:size]
        chosen, number = name, 2
        while chosen.lower() in (entry.lower() for entry in found):
            chosen, number = f"{name[: size - 3]}_{number}", number + 1
        found.append(chosen)
    return found


def ascii_text(text: str) -> str:
    """Return text with ASCII characters only."""
    return re.sub(r"[^ -~]", "?", text)
