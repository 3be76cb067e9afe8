"""Cell files in TOML, built in or user defined. Lengths in metres, angles in degrees, masses in kilograms."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import CellError, DependencyError, InputError
from falsework.geometry.arrays import apply
from falsework.robots.cells.cell_model import (
    FORMAT,
    CellFile,
    GripperEntry,
    JawEntry,
    ObstacleEntry,
    Place,
    RobotEntry,
    ShapeEntry,
    SuctionEntry,
    pose_of,
)
from falsework.robots.cells.urdf import LIMITS_FILE, load_urdf
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.cells.validate import check_cell
from falsework.robots.model.builtin_robots import BUILTIN, builtin_robot
from falsework.robots.model.cell import Cell, CellRobot, Gripper, Obstacle, Placement, Signals
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import Array, block, cylinder, looking_down
from falsework.utils.files.input_file import read_text
from falsework.utils.quantity import format_number

AnyCell = Cell | str | Path
"""Cell as it is, or what `load_cell` takes."""
LEAST_RATE = 0.01
"""Least limit of speed and acceleration of a joint, degrees or m per s and s2: with less, motions take hours."""
PLACE_TURNS = 8
"""Rotations about the vertical in which a part may be put down at a drop-off pose."""


def builtin_cells() -> tuple[str, ...]:
    """Return the names of the built-in cells."""
    folder = files("falsework.robots.cells")
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load_cell(name: str | Path, *, check: bool = True) -> Cell:
    """Read a cell.

    Args:
        name: a TOML file, or the name of a built-in cell such as `dome-37`.
        check: whether to reject an invalid cell, as `check_cell` does.

    Raises:
        CellError: no such cell, a key that is missing, unknown or wrong, or an invalid arrangement of robots.
        DependencyError: the cell names a URDF file and yourdfpy is missing.
    """
    cell = parse_cell(*_text_of(name))
    if check:
        check_cell(cell)
    return cell


def load_faulty_cell(name: str | Path) -> tuple[Cell | None, list[str]]:
    """Read as much of a cell as can be read, to show it while it is still wrong; None without any robot.

    The faults are returned too, each one line. A robot, gripper or obstacle with a fault is left out; a home with a
    fault is that of the arm.
    """
    faults: list[str] = []
    cell: Cell | None = None
    with _noted(faults):
        cell = parse_cell(*_text_of(name), faults=faults)
    if cell is not None:
        with _noted(faults):
            check_cell(cell)
    return cell, faults


def _text_of(name: str | Path) -> tuple[str, str, Path]:
    """Return the text of a cell, its name in messages, and the folder of its paths."""
    path = Path(name)
    if path.suffix.lower() == ".toml" and not path.exists():
        raise InputError(f"there is no cell file {path}; `falsework cell new` writes one")
    if path.suffix.lower() == ".toml" or path.is_file():
        try:
            return read_text(path), str(path), path.parent
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise CellError(f"cell file {path} cannot be read: {reason}") from error
    if str(name) in builtin_cells():
        text = (files("falsework.robots.cells") / f"{name}.toml").read_text(encoding="utf-8")
        return text, f"{name}.toml", Path()
    known = ", ".join(builtin_cells())
    raise CellError(f"unknown cell {name}; give a TOML file, or one of the built-in cells {known}")


@contextmanager
def _noted(faults: list[str] | None) -> Iterator[None]:
    """Note an error of a cell instead of raising it, if there is a list for it; a missing package is none."""
    try:
        yield
    except InputError as error:
        if faults is None or isinstance(error, DependencyError):
            raise
        faults.append(" ".join(str(error).split()))


def as_cell(cell: AnyCell) -> Cell:
    """Return a cell as it is, or read it by its name or file; InputError for something else."""
    if isinstance(cell, Cell):
        return cell
    if isinstance(cell, (str, Path)):
        return load_cell(cell)
    raise InputError(f"a cell is a Cell, a name or a file, not {type(cell).__name__}")


def parse_cell(text: str, source: str, folder: Path, *, faults: list[str] | None = None) -> Cell:
    """Return a cell from the text of a TOML file; `source` is its name in messages.

    `faults` takes errors of single entries, which are then left out; None raises the first one, as `load_cell` does.
    """
    place, data = Place(source), _toml(source, text)
    if data and data.keys().isdisjoint(CellFile.__struct_fields__):
        raise CellError(f"{source} is not a cell: it has none of the entries {', '.join(CellFile.__struct_fields__)}")
    if (form := data.get("format", FORMAT)) != FORMAT:
        raise place.fail("format", f"is {form!r}; this version reads {FORMAT}")
    file = CellFile(robots=[])
    with _noted(faults):
        file = place.read(CellFile, data | {"grippers": {}, "robots": [], "obstacles": []})
    grippers: dict[str, Gripper] = {}
    for name, values in place.inside("grippers").read(dict[str, Any], data.get("grippers", {})).items():
        if faults is not None:
            grippers[name] = Gripper(name, "suction", (), np.eye(4), 0.0)
        with _noted(faults):
            grippers[name] = _gripper(name, values, place.inside(f"grippers.{name}"))
    robots, obstacles = [], []
    entries, others = (place.inside(key).read(list[Any], data.get(key, [])) for key in ("robots", "obstacles"))
    for number, values in enumerate(entries):
        with _noted(faults):
            robots.append(_robot(values, place.inside(f"robots[{number}]"), grippers, folder, faults))
    if not robots and entries:
        raise CellError(f"{source}: none of its robots can be read")
    if not robots:
        raise CellError(f"{source}: robots is missing; write each robot as [[robots]]")
    names = [robot.name for robot in robots]
    for name in names:
        if names.count(name) > 1:
            raise CellError(f"{source}: two robots are called {name!r}; give every robot its own name")
    for number, values in enumerate(others):
        with _noted(faults):
            at = place.inside(f"obstacles[{number}]")
            entry = at.read(ObstacleEntry, values)
            obstacles.append(Obstacle(entry.name, tuple(_shapes(entry, at))))
    if file.floor is True:
        raise place.fail("floor", "is true; give its height in metres, or false")
    structure = file.structure
    x, y, z = structure.position or (0.0, 0.0, 0.0)
    yaw = float(np.radians(structure.yaw))
    cell = Cell(
        name=file.name or Path(source).stem,
        robots=tuple(robots),
        obstacles=tuple(obstacles),
        floor=None if file.floor is False else file.floor,
        placement=Placement(position=(x, y, z), yaw=yaw, scale=structure.scale, density=structure.density),
        margins=file.margins,
        speed=file.speed,
    )
    idle = sorted(set(grippers) - {robot.gripper.name for robot in robots})
    if idle:
        warnings.warn(f"{source}: no robot has the gripper {', '.join(idle)}", CellWarning, stacklevel=3)
    return cell


def _toml(source: str, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise CellError(f"{source} is nested too deeply; write it with tables") from None
    except ValueError as error:  # of its syntax, or a number with thousands of digits
        raise CellError(f"cell file {source} is not valid TOML: {' '.join(str(error).split())}") from error


def _gripper(name: str, values: Any, place: Place) -> Gripper:
    entry = place.read(GripperEntry, values)
    pieces = [
        piece
        for number, shape in enumerate(entry.shapes)
        for piece in _shapes(shape, place.inside(f"shapes[{number}]"))
    ]
    return Gripper(
        name=name,
        kind="suction" if isinstance(entry, SuctionEntry) else "jaw",
        pieces=tuple(pieces),
        tool=pose_of(entry.tool, place.inside("tool")),
        payload=entry.payload,
        mass=entry.mass,
        cup=entry.cup if isinstance(entry, SuctionEntry) else 0.0,
        opening=entry.opening if isinstance(entry, JawEntry) else 0.0,
        depth=entry.depth if isinstance(entry, JawEntry) else 0.0,
        force=np.inf if entry.force is None else entry.force,
        moment=np.inf if entry.moment is None else entry.moment,
        center_of_mass=None if entry.center_of_mass is None else np.array(entry.center_of_mass),
        inertia=None if entry.inertia is None else _inertia(entry.inertia, place),
    )


def _inertia(given: list[float], place: Place) -> Array:
    """Return the inertia of a gripper about its centre of mass, shape (3, 3); CellError for one that no body has."""
    if len(given) not in (3, 6):
        raise place.fail("inertia", f"has {len(given)} numbers; give 3 or 6")
    xx, yy, zz, xy, xz, yz = [*given, 0.0, 0.0, 0.0][:6]
    made = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(made)
    if not (moments[0] >= 0 and moments[2] <= moments[0] + moments[1] + 1e-12):
        raise place.fail(
            "inertia",
            f"is {given}, which no body has; give Ixx, Iyy, Izz, and if needed Ixy, Ixz, Iyz, in kg m2 about the "
            "centre of mass",
        )
    return made


def _shapes(entry: ShapeEntry, place: Place) -> list[Array]:
    """Return the shapes of the box and the cylinder of an entry."""
    found, at = [], pose_of(entry, place)
    if entry.box is not None:
        low, high = np.array(entry.box.low), np.array(entry.box.high)
        if not (low < high).all():
            raise place.fail("box.high", f"is {entry.box.high}; every coordinate must be above that of low")
        try:
            found.append(apply(at, block(low, high)))
        except InputError as error:
            raise place.fail("box:", str(error)) from error
    if entry.cylinder is not None:
        low, high = entry.cylinder.low, entry.cylinder.high
        if not low < high:
            raise place.fail("cylinder.high", f"is {high:g}; it must be above low, {low:g}")
        found.append(apply(at, cylinder(entry.cylinder.radius, low, high)))
    if not found:
        raise place.fail("box", "is missing; give a box or a cylinder")
    return found


def _robot(
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
    gripper, frames = grippers[entry.gripper], np.array(places).reshape(-1, 4, 4)
    return CellRobot(entry.name, model, base, gripper, home, frames, entry.maker, signals)


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
