"""Robots of a cell file: arm, base, gripper, home, places and settings of the controller."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import CellError
from falsework.robots.cells.urdf import LIMITS_FILE, load_urdf
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.model.builtin_robots import BUILTIN, builtin_robot
from falsework.robots.model.cell import CellRobot, Gripper, Signals
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import pose
from falsework.utils.toml_table import Table

Array = NDArray[np.float64]

PLACE_TURNS = 8
"""Rotations about the vertical in which a part may be put down at a drop-off pose."""


def read_robot(table: Table, grippers: dict[str, Gripper], folder: Path, faults: list[str] | None = None) -> CellRobot:
    """Return a robot from its entry in a cell file.

    Args:
        table: the entry.
        grippers: grippers of the cell by name.
        folder: folder that relative paths start from.
        faults: takes an error of the home, which is then that of the arm; None raises it.

    Raises:
        CellError: a key that is missing, unknown or wrong.
        DependencyError: the arm is a URDF file and yourdfpy is missing.
    """
    name = table.text("name")
    model = _model(table, folder)
    if table.has("acceleration"):
        given = _joint_values(table, "acceleration", model)
        if not (given > 0).all():
            raise table.fail("acceleration", f"is {given.tolist()}; give numbers above 0, in degrees (or m) per s2")
        model = replace(model, acceleration=given * _units(model))
    elif model.assumed:
        some = "" if len(model.assumed) == model.joints else f" of {', '.join(model.assumed)}"
        warnings.warn(
            f"{table.source}: robot {name} has no acceleration{some}, which neither its URDF nor a joint_limits.yaml "
            f"states; joints are taken to reach full speed in {ACCELERATION_TIME:g} s",
            CellWarning,
            stacklevel=4,
        )
    wanted = table.text("gripper")
    if wanted not in grippers:
        known = ", ".join(grippers) or "none"
        raise table.fail("gripper", f"is {wanted!r}, which [grippers] does not have; there are: {known}")
    base = read_pose(table.table("base"))
    home = model.home
    try:
        home = _home(table, model)
    except CellError as error:
        if faults is None:
            raise
        faults.append(f"{error} (robot {name} is shown in another one)")
    local = np.array([place.numbers("position", 3) for place in table.tables("places")]).reshape(-1, 3)
    for place in table.tables("places"):
        place.numbers("position", 3)
        place.done()
    places = [base @ _down(at, 2 * np.pi * turn / PLACE_TURNS) for at in local for turn in range(PLACE_TURNS)]
    maker = table.text("maker") if table.has("maker") else None
    signals = _signals(table.table("signals"))
    table.done()
    return CellRobot(name, model, base, grippers[wanted], home, np.array(places).reshape(-1, 4, 4), maker, signals)


def _signals(table: Table) -> Signals:
    """Return the settings of a controller."""
    standard = Signals()
    found = Signals(
        grip=table.text("grip") if table.has("grip") else None,
        closed=bool(_level(table)) if table.has("closed") else standard.closed,
        seconds=table.number("seconds", standard.seconds, low=0.0, high=60.0),
        address=table.text("address") if table.has("address") else None,
    )
    table.done()
    return found


def _level(table: Table) -> int:
    value = table.take("closed")
    if value not in (0, 1):
        raise table.fail("closed", f"is {value!r}; give 0 or 1, the level of the output at which the gripper is closed")
    return int(value)


def _model(table: Table, folder: Path) -> RobotModel:
    """Return the arm of a robot entry."""
    name = table.text("model")
    base = table.text("base_link") if table.has("base_link") else None
    tip = table.text("tip_link") if table.has("tip_link") else None
    srdf, limits = (str(folder / table.text(key)) if table.has(key) else None for key in ("srdf", "joint_limits"))
    if name in BUILTIN:
        return _builtin(name)
    if not name.lower().endswith((".urdf", ".xml")):
        known = ", ".join(sorted(BUILTIN))
        raise table.fail("model", f"is {name!r}; give the path of a URDF file or one of {known}")
    try:
        return _from_file(str(folder / name), base, tip, srdf, limits, _changed(folder / name, srdf, limits))
    except CellError as error:
        raise CellError(f"{table.source}: {table.name('model')}: {error}") from error


@lru_cache(maxsize=16)
def _builtin(name: str) -> RobotModel:
    return builtin_robot(name)


@lru_cache(maxsize=16)
def _from_file(
    path: str, base: str | None, tip: str | None, srdf: str | None, joint_limits: str | None, changed: tuple[int, ...]
) -> RobotModel:
    """Return the arm of a file; `changed` tells the cache of files that have changed."""
    return load_urdf(path, base=base, tip=tip, srdf=srdf, joint_limits=joint_limits)


def _changed(urdf: Path, srdf: str | None, joint_limits: str | None) -> tuple[int, ...]:
    """Return when the files of an arm were changed, nanoseconds; 0 for one that is not there."""
    files = (
        urdf,
        urdf.with_suffix(".srdf") if srdf is None else Path(srdf),
        urdf.parent / LIMITS_FILE if joint_limits is None else Path(joint_limits),
    )
    return tuple(file.stat().st_mtime_ns if file.is_file() else 0 for file in files)


def _joint_values(table: Table, key: str, model: RobotModel) -> Array:
    """Return a number for each joint of an arm, shape (joints,).

    Raises:
        CellError: another number of values; the message has the names of the joints.
    """
    given = table.take(key)
    if isinstance(given, list) and len(given) != model.joints:
        asked = (
            f"; its arm ends at link {model.link_names[-1]}, which tip_link changes"
            if model.source != "built-in"
            else ""
        )
        raise table.fail(
            key,
            f"has {len(given)} values, but {model.name} has {model.joints} joints: "
            f"{', '.join(model.joint_names)}{asked}",
        )
    return table.numbers(key, model.joints)


def _units(model: RobotModel) -> Array:
    """Return the factors from the units of a cell file to those of joints, shape (joints,)."""
    return np.where(model.prismatic, 1.0, np.pi / 180)


def _home(table: Table, model: RobotModel) -> Array:
    """Return the home joint values: a list or a table by joint, degrees, or the name of a state of the SRDF.

    By default those of the model.
    """
    if not table.has("home"):
        return model.home
    given = table.take("home")
    units, states = _units(model), dict(model.group_states)
    if isinstance(given, str):
        if given not in states:
            known = ", ".join(states) or "no states for all its joints"
            where = f"{Path(model.srdf).name} has {known}" if model.srdf else f"{model.name} has no SRDF"
            raise table.fail("home", f"is the state {given!r}, but {where}; name one, or give joint values")
        values = states[given]
    elif isinstance(given, dict):
        values = np.array(model.home)
        for joint in given:
            if joint not in model.joint_names:
                known = ", ".join(model.joint_names)
                raise table.fail("home", f"names joint {joint!r}, which {model.name} does not have; it has {known}")
            number = table.table("home").number(joint)
            values[model.joint_names.index(joint)] = number * units[model.joint_names.index(joint)]
    else:
        values = _joint_values(table, "home", model) * units
    outside = (values < model.lower - 1e-9) | (values > model.upper + 1e-9)
    if outside.any():
        joint = int(np.argmax(outside))
        low, value, high = (limit[joint] / units[joint] for limit in (model.lower, values, model.upper))
        unit = "m" if model.prismatic[joint] else "degrees"
        raise table.fail(
            "home",
            f"cannot be reached: {model.joint_names[joint]} is {value:.4g} {unit}, outside its limits {low:.4g} to "
            f"{high:.4g}",
        )
    return np.array(values)


def read_pose(table: Table) -> Array:
    """Return the pose of a position and rotation (roll, pitch, yaw about fixed axes, or yaw alone), degrees.

    Raises:
        CellError: no numbers, or yaw beside roll, pitch and yaw.
    """
    made = np.array(pose(table.numbers("position", 3, (0, 0, 0))))
    turned = table.numbers("rpy", 3, (0, 0, 0))
    if table.has("yaw"):
        if table.has("rpy"):
            raise table.fail("yaw", "is given beside rpy; give one of them")
        turned = np.array([0.0, 0.0, table.number("yaw")])
    roll, pitch, yaw = np.radians(turned)
    cx, sx, cy, sy, cz, sz = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    made[:3, :3] = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    if table.where.endswith((".base", ".tool")):
        table.done()
    return made


def _down(position: Array, turn: float) -> Array:
    """Return a tool frame whose z points down, rotated about the vertical."""
    made = np.eye(4)
    made[:3, :3] = [[np.cos(turn), np.sin(turn), 0], [np.sin(turn), -np.cos(turn), 0], [0, 0, -1]]
    made[:3, 3] = position
    return made
