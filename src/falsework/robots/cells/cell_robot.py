"""Robots of a cell file: arm, base, gripper, home, places and settings of the controller."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import CellError
from falsework.robots.cells.cell_model import Place, RobotEntry, pose_of
from falsework.robots.cells.urdf import LIMITS_FILE, load_urdf
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.model.builtin_robots import BUILTIN, builtin_robot
from falsework.robots.model.cell import CellRobot, Gripper, Signals
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import Array, looking_down
from falsework.utils.quantity import format_number

LEAST_RATE = 0.01
"""Least limit of speed and acceleration of a joint, degrees or m per s and s2: with less, motions take hours."""
PLACE_TURNS = 8
"""Rotations about the vertical in which a part may be put down at a drop-off pose."""


def read_robot(
    values: Any, place: Place, grippers: dict[str, Gripper], folder: Path, faults: list[str] | None = None
) -> CellRobot:
    """Return a robot from its entry in a cell file; errors as of `load_cell`.

    `faults` takes an error of the home, which is then that of the arm; None raises it.
    """
    entry = place.read(RobotEntry, values)
    model = _model(entry, place, folder)
    if entry.acceleration is not None:
        given = _joint_values(entry.acceleration, place, "acceleration", model)
        model = replace(model, acceleration=given * model.units)
    elif model.assumed:
        some = "" if len(model.assumed) == model.joints else f" of {', '.join(model.assumed)}"
        warnings.warn(
            f"{place.source}: robot {entry.name} has no acceleration{some}, which neither its URDF nor a "
            f"joint_limits.yaml states; joints are taken to reach full speed in {ACCELERATION_TIME:g} s",
            CellWarning,
            stacklevel=4,
        )
    for rate, unit in (("velocity", "s"), ("acceleration", "s2")):
        limits = getattr(model, rate) / model.units
        slow = int(np.argmin(limits))
        if not limits[slow] >= LEAST_RATE:
            raise CellError(
                f"{place.source}: {place.where}: the {rate} of {model.joint_names[slow]} is {limits[slow]:g}; give at "
                f"least {LEAST_RATE:g}, in degrees (or m) per {unit}"
            )
    if entry.gripper not in grippers:
        known = ", ".join(grippers) or "none"
        raise place.fail("gripper", f"is {entry.gripper!r}, which [grippers] does not have; there are: {known}")
    base, home = pose_of(entry.base, place.inside("base")), model.home
    try:
        home = _home(entry.home, place, model)
    except CellError as error:
        if faults is None:
            raise
        faults.append(f"{error} (robot {entry.name} is shown in another one)")
    turns = [2 * np.pi * turn / PLACE_TURNS for turn in range(PLACE_TURNS)]
    places = [looking_down(base, put.position, turn) for put in entry.places for turn in turns]
    given = entry.signals
    signals = Signals(grip=given.grip, closed=bool(given.closed), seconds=given.seconds, address=given.address)
    gripper = grippers[entry.gripper]
    return CellRobot(entry.name, model, base, gripper, home, np.array(places).reshape(-1, 4, 4), entry.maker, signals)


def _model(entry: RobotEntry, place: Place, folder: Path) -> RobotModel:
    """Return the arm of a robot entry."""
    name = entry.model
    srdf, limits = (None if given is None else str(folder / given) for given in (entry.srdf, entry.joint_limits))
    if name in BUILTIN:
        return builtin_robot(name)
    if not name.lower().endswith((".urdf", ".xml")):
        known = ", ".join(sorted(BUILTIN))
        raise place.fail("model", f"is {name!r}; give the path of a URDF file or one of {known}")
    changed = _changed(folder / name, srdf, limits)
    try:
        return _from_file(str(folder / name), entry.base_link, entry.tip_link, srdf, limits, changed)
    except CellError as error:
        raise CellError(f"{place.source}: {place.name('model')}: {error}") from error


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


def _joint_values(given: list[float], place: Place, key: str, model: RobotModel) -> Array:
    """Return a number for each joint of an arm, shape (joints,); the CellError for another number names the joints."""
    if len(given) == model.joints:
        return np.array(given)
    changes = f"; its arm ends at link {model.link_names[-1]}, which tip_link changes"
    raise place.fail(
        key,
        f"has {len(given)} values, but {model.name} has {model.joints} joints: {', '.join(model.joint_names)}"
        f"{'' if model.source == 'built-in' else changes}",
    )


def _home(given: list[float] | dict[str, float] | str | None, place: Place, model: RobotModel) -> Array:
    """Return the home joint values: a list or a table by joint, degrees, a state of the SRDF, or those of the model."""
    units, states = model.units, dict(model.group_states)
    if given is None:
        return model.home
    if isinstance(given, str):
        if given not in states:
            known = ", ".join(states) or "no states for all its joints"
            where = f"{Path(model.srdf).name} has {known}" if model.srdf else f"{model.name} has no SRDF"
            raise place.fail("home", f"is the state {given!r}, but {where}; name one, or give joint values")
        values = states[given]
    elif isinstance(given, dict):
        values = np.array(model.home)
        for joint, value in given.items():
            if joint not in model.joint_names:
                known = ", ".join(model.joint_names)
                raise place.fail("home", f"names joint {joint!r}, which {model.name} does not have; it has {known}")
            values[model.joint_names.index(joint)] = value * units[model.joint_names.index(joint)]
    else:
        values = _joint_values(given, place, "home", model) * units
    if (joint := model.first_outside(values)) is not None:
        low, value, high = (limit[joint] / units[joint] for limit in (model.lower, values, model.upper))
        unit = "m" if model.prismatic[joint] else "degrees"
        raise place.fail(
            "home",
            f"cannot be reached: {model.joint_names[joint]} is {format_number(value, 4)} {unit}, outside its limits "
            f"{format_number(low, 4)} to {format_number(high, 4)}",
        )
    return np.array(values)
