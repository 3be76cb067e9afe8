"""Cell files in TOML, built in or user defined. Lengths in metres, angles in degrees, masses in kilograms."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import CellError, InputError
from falsework.robots.cells.urdf import load_urdf
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.cells.validate import check_cell
from falsework.robots.model.builtin_robots import BUILTIN, builtin_robot
from falsework.robots.model.cell import Cell, CellRobot, Gripper, Margins, Obstacle, Placement
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import block, cylinder, move, pose
from falsework.utils.toml_table import Table, read_text

Array = NDArray[np.float64]

AnyCell = Cell | str | Path
"""Cell as it is, or what `load_cell` takes."""

FORMAT = "falsework.cell/1"
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
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        cell = parse_cell(read_text(path), str(path), path.parent)
    elif str(name) in builtin_cells():
        text = (files("falsework.robots.cells") / f"{name}.toml").read_text(encoding="utf-8")
        cell = parse_cell(text, f"{name}.toml", Path())
    else:
        known = ", ".join(builtin_cells())
        raise CellError(f"unknown cell {name}; give a TOML file, or one of the built-in cells {known}")
    if check:
        check_cell(cell)
    return cell


def as_cell(cell: AnyCell) -> Cell:
    """Return a cell that is given as it is, or read it by its name or file.

    Raises:
        InputError: something else.
        CellError: as `load_cell`.
    """
    if isinstance(cell, Cell):
        return cell
    if isinstance(cell, (str, Path)):
        return load_cell(cell)
    raise InputError(f"a cell is a Cell, a name or a file, not {type(cell).__name__}")


def parse_cell(text: str, source: str, folder: Path) -> Cell:
    """Return a cell from the text of a TOML file.

    Args:
        text: TOML.
        source: name of the text in messages.
        folder: folder that relative paths start from.

    Raises:
        CellError: as `load_cell`.
    """
    file = Table.parse(source, text)
    form = file.text("format", FORMAT)
    if form != FORMAT:
        raise file.fail("format", f"is {form!r}; this version reads {FORMAT}")
    grippers_table = file.table("grippers")
    grippers = {name: _gripper(name, grippers_table.table(name)) for name in grippers_table.names()}
    robots = [_robot(entry, grippers, folder) for entry in file.tables("robots")]
    if not robots:
        raise CellError(f"{source}: robots is missing; write each robot as [[robots]]")
    names = [robot.name for robot in robots]
    for name in names:
        if names.count(name) > 1:
            raise CellError(f"{source}: two robots are called {name!r}; give every robot its own name")
    obstacles = tuple(_obstacle(entry) for entry in file.tables("obstacles"))
    floor = None
    if not file.has("floor"):
        floor = 0.0
    elif file.take("floor") is not False:
        floor = file.number("floor")
    structure, margins = file.table("structure"), file.table("margins")
    x, y, z = structure.numbers("position", 3, (0, 0, 0)).tolist()
    placement = Placement(
        position=(x, y, z),
        yaw=float(np.radians(structure.number("yaw", 0.0))),
        scale=structure.number("scale", 1.0, low=1e-6),
        density=structure.number("density", low=1e-6) if structure.has("density") else None,
    )
    standard = Margins()
    kept = Margins(
        free=margins.number("free", standard.free, low=0.0005, high=1.0),
        line=margins.number("line", standard.line, low=0.0, high=1.0),
        approach=margins.number("approach", standard.approach, low=0.001, high=10.0),
    )
    cell = Cell(
        name=file.text("name", Path(source).stem),
        robots=tuple(robots),
        obstacles=obstacles,
        floor=floor,
        placement=placement,
        margins=kept,
        speed=file.number("speed", 1.0, low=0.001, high=1.0),
    )
    for table in (structure, margins, file):
        table.done()
    idle = sorted(set(grippers) - {robot.gripper.name for robot in robots})
    if idle:
        warnings.warn(f"{source}: no robot has the gripper {', '.join(idle)}", CellWarning, stacklevel=3)
    return cell


def _robot(table: Table, grippers: dict[str, Gripper], folder: Path) -> CellRobot:
    name = table.text("name")
    model = _model(table, folder)
    if table.has("acceleration"):
        given = table.numbers("acceleration", model.joints)
        if not (given > 0).all():
            raise table.fail("acceleration", f"is {given.tolist()}; give numbers above 0, in degrees (or m) per s2")
        model = replace(model, acceleration=given * _units(model))
    elif model.source != "built-in":
        warnings.warn(
            f"{table.source}: robot {name} has no acceleration, which a URDF does not state; its joints are taken to "
            f"reach full speed in {ACCELERATION_TIME:g} s",
            CellWarning,
            stacklevel=4,
        )
    wanted = table.text("gripper")
    if wanted not in grippers:
        known = ", ".join(grippers) or "none"
        raise table.fail("gripper", f"is {wanted!r}, which [grippers] does not have; there are: {known}")
    base = _pose(table.table("base"))
    home = _home(table, model)
    local = np.array([place.numbers("position", 3) for place in table.tables("places")]).reshape(-1, 3)
    for place in table.tables("places"):
        place.numbers("position", 3)
        place.done()
    places = [base @ _down(at, 2 * np.pi * turn / PLACE_TURNS) for at in local for turn in range(PLACE_TURNS)]
    table.done()
    return CellRobot(name, model, base, grippers[wanted], home, np.array(places).reshape(-1, 4, 4))


def _model(table: Table, folder: Path) -> RobotModel:
    """Return the arm of a robot entry."""
    name = table.text("model")
    base = table.text("base_link") if table.has("base_link") else None
    tip = table.text("tip_link") if table.has("tip_link") else None
    if name in BUILTIN:
        return _builtin(name)
    if not name.lower().endswith((".urdf", ".xml")):
        known = ", ".join(sorted(BUILTIN))
        raise table.fail("model", f"is {name!r}; give the path of a URDF file or one of {known}")
    try:
        return _from_file(str(folder / name), base, tip)
    except CellError as error:
        raise CellError(f"{table.source}: {table.name('model')}: {error}") from error


@lru_cache(maxsize=16)
def _builtin(name: str) -> RobotModel:
    return builtin_robot(name)


@lru_cache(maxsize=16)
def _from_file(path: str, base: str | None, tip: str | None) -> RobotModel:
    return load_urdf(path, base=base, tip=tip)


def _units(model: RobotModel) -> Array:
    """Return the factors from the units of a cell file to those of joints, shape (joints,)."""
    return np.where(model.prismatic, 1.0, np.pi / 180)


def _home(table: Table, model: RobotModel) -> Array:
    """Return the home joint values, given in degrees as a list or a table by joint; by default those of the model."""
    if not table.has("home"):
        return model.home
    given = table.take("home")
    units = _units(model)
    if isinstance(given, dict):
        values = np.array(model.home)
        for joint in given:
            if joint not in model.joint_names:
                known = ", ".join(model.joint_names)
                raise table.fail("home", f"names joint {joint!r}, which {model.name} does not have; it has {known}")
            number = table.table("home").number(joint)
            values[model.joint_names.index(joint)] = number * units[model.joint_names.index(joint)]
    else:
        values = table.numbers("home", model.joints) * units
    try:
        return model.check_configuration(values, "home")
    except InputError as error:
        raise table.fail("home", f"cannot be reached: {error}") from None


def _gripper(name: str, table: Table) -> Gripper:
    kind = table.text("kind")
    if kind not in ("suction", "jaw"):
        raise table.fail("kind", f"is {kind!r}; give suction or jaw")
    pieces = tuple(piece for entry in table.tables("shapes") for piece in _shapes(entry))
    if not pieces:
        raise table.fail("shapes", "is missing; give at least one box or cylinder, for collision checks")
    tool = _pose(table.table("tool"))
    made = Gripper(
        name=name,
        kind="suction" if kind == "suction" else "jaw",
        pieces=pieces,
        tool=tool,
        payload=table.number("payload", low=0.0),
        mass=table.number("mass", 0.0, low=0.0),
        cup=table.number("cup", low=1e-4) if kind == "suction" else 0.0,
        opening=table.number("opening", low=1e-4) if kind == "jaw" else 0.0,
        depth=table.number("depth", low=1e-4) if kind == "jaw" else 0.0,
        force=table.number("force", low=0.0) if table.has("force") else np.inf,
        moment=table.number("moment", low=0.0) if table.has("moment") else np.inf,
    )
    table.done()
    return made


def _obstacle(table: Table) -> Obstacle:
    name = table.text("name")
    made = Obstacle(name, tuple(_shapes(table)))
    if not made.pieces:
        raise table.fail("box", f"is missing; give obstacle {name!r} a box or a cylinder")
    table.done()
    return made


def _shapes(table: Table) -> list[Array]:
    """Return the shapes of the box and the cylinder of an entry."""
    found = []
    at = _pose(table)
    if table.has("box"):
        shape = table.table("box")
        low, high = shape.numbers("low", 3), shape.numbers("high", 3)
        if not (low < high).all():
            raise shape.fail("high", f"is {high.tolist()}; every coordinate must be above that of low")
        found.append(move(at, block(low, high)))
        shape.done()
    if table.has("cylinder"):
        shape = table.table("cylinder")
        low, high = shape.number("low"), shape.number("high")
        if not low < high:
            raise shape.fail("high", f"is {high:g}; it must be above low, {low:g}")
        found.append(move(at, cylinder(shape.number("radius", low=1e-4), low, high)))
        shape.done()
    if not table.where.startswith("obstacles"):
        table.done()
    return found


def _pose(table: Table) -> Array:
    """Return the pose of a position and rotation (roll, pitch, yaw about fixed axes, or yaw alone), degrees."""
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
