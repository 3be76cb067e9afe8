"""Cell files in TOML, built in or user defined. Lengths in metres, angles in degrees, masses in kilograms."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import CellError, DependencyError, InputError
from falsework.robots.cells.cell_robot import read_pose, read_robot
from falsework.robots.cells.urdf_review import CellWarning
from falsework.robots.cells.validate import check_cell
from falsework.robots.model.cell import Cell, Gripper, Margins, Obstacle, Placement
from falsework.robots.model.shapes import block, cylinder, move
from falsework.utils.toml_table import Table, read_text

Array = NDArray[np.float64]

AnyCell = Cell | str | Path
"""Cell as it is, or what `load_cell` takes."""

FORMAT = "falsework.cell/1"


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
    """Read as much of a cell as can be read, to show it while it is still wrong.

    A robot, gripper or obstacle with a fault is left out; a home with a fault is that of the arm.

    Args:
        name: as for `load_cell`.

    Returns:
        The cell, None if it has no robot that can be read, and the faults, each one line.

    Raises:
        DependencyError: as `load_cell`.
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
    if path.suffix == ".toml" or path.is_file():
        return read_text(path), str(path), path.parent
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


def parse_cell(text: str, source: str, folder: Path, *, faults: list[str] | None = None) -> Cell:
    """Return a cell from the text of a TOML file.

    Args:
        text: TOML.
        source: name of the text in messages.
        folder: folder that relative paths start from.
        faults: takes errors of single entries, which are then left out; None raises the first one.

    Raises:
        CellError: as `load_cell`.
    """
    file = Table.parse(source, text)
    form = file.text("format", FORMAT)
    if form != FORMAT:
        raise file.fail("format", f"is {form!r}; this version reads {FORMAT}")
    grippers_table = file.table("grippers")
    grippers: dict[str, Gripper] = {}
    for name in grippers_table.names():
        if faults is not None:
            grippers[name] = Gripper(name, "suction", (), np.eye(4), 0.0)
        with _noted(faults):
            grippers[name] = _gripper(name, grippers_table.table(name))
    robots, entries = [], file.tables("robots")
    for entry in entries:
        with _noted(faults):
            robots.append(read_robot(entry, grippers, folder, faults))
    if not robots and entries:
        raise CellError(f"{source}: none of its robots can be read")
    if not robots:
        raise CellError(f"{source}: robots is missing; write each robot as [[robots]]")
    names = [robot.name for robot in robots]
    for name in names:
        if names.count(name) > 1:
            raise CellError(f"{source}: two robots are called {name!r}; give every robot its own name")
    obstacles: list[Obstacle] = []
    for entry in file.tables("obstacles"):
        with _noted(faults):
            obstacles.append(_obstacle(entry))
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
        obstacles=tuple(obstacles),
        floor=floor,
        placement=placement,
        margins=kept,
        speed=file.number("speed", 1.0, low=0.001, high=1.0),
    )
    with _noted(faults):
        for table in (structure, margins, file):
            table.done()
    idle = sorted(set(grippers) - {robot.gripper.name for robot in robots})
    if idle:
        warnings.warn(f"{source}: no robot has the gripper {', '.join(idle)}", CellWarning, stacklevel=3)
    return cell


def _gripper(name: str, table: Table) -> Gripper:
    kind = table.text("kind")
    if kind not in ("suction", "jaw"):
        raise table.fail("kind", f"is {kind!r}; give suction or jaw")
    pieces = tuple(piece for entry in table.tables("shapes") for piece in _shapes(entry))
    if not pieces:
        raise table.fail("shapes", "is missing; give at least one box or cylinder, for collision checks")
    tool = read_pose(table.table("tool"))
    center = table.numbers("center_of_mass", 3) if table.has("center_of_mass") else None
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
        center_of_mass=center,
        inertia=_inertia(table) if table.has("inertia") else None,
    )
    table.done()
    return made


def _inertia(table: Table) -> Array:
    """Return the inertia of a gripper about its centre of mass, shape (3, 3).

    Raises:
        CellError: other than three or six numbers, or moments of inertia that no body has.
    """
    given = table.take("inertia")
    xx, yy, zz, xy, xz, yz = [
        *table.numbers("inertia", 6 if isinstance(given, list) and len(given) == 6 else 3),
        0,
        0,
        0,
    ][:6]
    made = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(made)
    if not (moments[0] >= 0 and moments[2] <= moments[0] + moments[1] + 1e-12):
        raise table.fail(
            "inertia",
            f"is {given}, which no body has; give Ixx, Iyy, Izz, and if needed Ixy, Ixz, Iyz, in kg m2 about the "
            "centre of mass",
        )
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
    at = read_pose(table)
    if table.has("box"):
        shape = table.table("box")
        low, high = shape.numbers("low", 3), shape.numbers("high", 3)
        if not (low < high).all():
            raise shape.fail("high", f"is {high.tolist()}; every coordinate must be above that of low")
        try:
            found.append(move(at, block(low, high)))
        except InputError as error:
            raise CellError(f"{shape.source}: {shape.where}: {error}") from error
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
