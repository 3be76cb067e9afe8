"""Controllers of arms: the maker of each arm, the load of its tool, and its signals."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.errors import InputError
from falsework.robots.model.cell import Cell, CellRobot, Gripper
from falsework.robots.model.maker import maker_of
from falsework.robots.model.shapes import Pieces

Array = NDArray[np.float64]
Language = Literal["rapid", "urscript"]

MAKERS: dict[Language, str] = {"rapid": "ABB", "urscript": "Universal Robots"}
"""Maker whose controllers run a language."""
_LEAST_MASS = 0.001
"""Mass of a tool without one, kg: that of `tool0`, since RAPID accepts no zero."""
_SIGNALS: dict[Language, tuple[str, str]] = {
    "rapid": (r"[A-Za-z]\w{0,31}", "the name of a digital output, such as do_vacuum"),
    "urscript": (r"(standard|configurable|tool) [0-7]", "standard, configurable or tool and a number, such as tool 0"),
}


@dataclass(frozen=True, eq=False)
class ToolLoad:
    """Load that a gripper is for its arm, in the frame of the flange."""

    mass: float
    """kg."""
    center: Array
    """Centre of mass, metres, shape (3,)."""
    inertia: Array
    """About the centre of mass, kg m2, shape (3, 3); zero where it is unknown."""


def check_makers(cell: Cell, language: Language) -> None:
    """Refuse programs for arms whose controllers do not run them.

    Raises:
        InputError: an arm is of another maker, or of an unknown one; the message names it.
    """
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


def tool_load(gripper: Gripper) -> ToolLoad:
    """Return the load of a gripper; the centre of mass of its shapes, of one density, stands in for a missing one."""
    center = gripper.center_of_mass if gripper.center_of_mass is not None else _centroid(gripper.pieces)
    inertia = np.zeros((3, 3)) if gripper.inertia is None else gripper.inertia
    return ToolLoad(gripper.mass, center, inertia)


def rapid_load(load: ToolLoad) -> str:
    """Return a load as RAPID's `loaddata`: kg, mm, axes of the moments of inertia as a quaternion, kg m2."""
    from scipy.spatial.transform import Rotation

    moments, axes = np.linalg.eigh(load.inertia)
    if np.array_equal(load.inertia, np.diag(np.diag(load.inertia))):
        moments, axes = np.diag(load.inertia), np.eye(3)
    axes = axes * np.where(np.arange(3) == 2, np.sign(np.linalg.det(axes)), 1.0)
    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    center = ",".join(f"{round(1000 * value, 3) + 0.0:.3f}" for value in load.center)
    turn = ",".join(map(_plain, (w, x, y, z)))
    return f"[{max(load.mass, _LEAST_MASS):.4f},[{center}],[{turn}],{','.join(map(_plain, moments.tolist()))}]"


def _plain(value: float) -> str:
    """Return a number without an exponent, to the seventh digit after the point."""
    return f"{round(value, 7) + 0.0:.7f}".rstrip("0").rstrip(".")


def ur_payload(load: ToolLoad) -> str:
    """Return the URScript command that sets a load: kg, m, kg m2."""
    center = ", ".join(f"{round(value, 6) + 0.0:.6f}" for value in load.center)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = load.inertia.tolist()
    inertia = ", ".join(f"{value:.6g}" for value in (xx, yy, zz, xy, xz, yz))
    return f"set_target_payload({load.mass:.4f}, [{center}], [{inertia}])"


def grip_signal(robot: CellRobot, name: str, language: Language) -> str:
    """Return the output that closes the gripper of a robot.

    Args:
        robot: the robot.
        name: its name in the program.
        language: of the program.

    Raises:
        InputError: the cell names an output that the language does not have.
    """
    standard = f"do_{name}_grip" if language == "rapid" else "standard 0"
    given = robot.signals.grip or standard
    pattern, example = _SIGNALS[language]
    if not re.fullmatch(pattern, given):
        raise InputError(f"signals.grip of robot {robot.name} is {given!r}; for {language} give {example}")
    return given


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


def _centroid(pieces: Pieces) -> Array:
    """Return the centroid of convex pieces, shape (3,); overlaps count twice."""
    volumes, centers = [], []
    for piece in pieces:
        corners = _tetrahedra(piece)
        volumes.append(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6)
        centers.append(corners.mean(axis=1))
    if not volumes:
        return np.zeros(3)
    weight = np.concatenate(volumes)
    return weight @ np.concatenate(centers) / weight.sum()


def _tetrahedra(piece: Array) -> Array:
    """Return tetrahedra that fill a convex piece, shape (tetrahedra, 4, 3)."""
    hull = ConvexHull(piece)
    inner = piece[hull.vertices].mean(axis=0)
    faces = piece[hull.simplices]
    return np.concatenate([np.broadcast_to(inner, (len(faces), 1, 3)), faces], axis=1)
