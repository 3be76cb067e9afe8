"""Cell files in TOML, built in or user defined. Lengths in metres, angles in degrees, masses in kilograms."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
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
    ShapeEntry,
    SuctionEntry,
    pose_of,
)
from falsework.robots.cells.cell_robot import read_robot
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.cells.validate import check_cell
from falsework.robots.model.cell import Cell, Gripper, Obstacle, Placement
from falsework.robots.model.shapes import Array, block, cylinder
from falsework.utils.files.input_file import read_text

AnyCell = Cell | str | Path
"""Cell as it is, or what `load_cell` takes."""


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
            robots.append(read_robot(values, place.inside(f"robots[{number}]"), grippers, folder, faults))
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
