"""A slab under a roof, which arms can grip by its edges only, and tables above which it fits only lying flat."""

from __future__ import annotations

from dataclasses import replace

from falsework import Assembly, Task
from falsework.assembly.library.blocks import box, gather
from falsework.robots import Cell, Obstacle
from falsework.robots.model.shapes import block

SLAB = 0


def slab(tiles: int = 0) -> Assembly:
    """A slab of 0.3 m by 0.3 m by 0.1 m on a plinth, 0.02 m below a roof, and tiles stacked beside it."""
    solids = [box("slab", (-0.15, -0.15, 0.3), (0.15, 0.15, 0.4))]
    solids += [box("tile", (0.25, -0.1, 0.1 * k), (0.45, 0.1, 0.1 * (k + 1))) for k in range(tiles)]
    for name, low, high in (
        ("plinth", (-0.1, -0.1, 0.0), (0.1, 0.1, 0.3)),
        ("roof", (-0.2, -0.2, 0.42), (0.2, 0.2, 0.45)),
        ("pad", (0.2, -0.15, -0.05), (0.5, 0.15, 0.0)),
    ):
        solids.append(box(name, low, high, fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="slab")


def tabled(cell: Cell) -> Cell:
    """The cell with a table 0.18 m below each drop-off pose: the slab does not fit if it hangs by an edge."""
    places = [place[:3, 3] for robot in cell.robots for place in robot.places]
    tops = [block((x - 0.3, y - 0.3, z - 0.2), (x + 0.3, y + 0.3, z - 0.18)) for x, y, z in places]
    return replace(cell, obstacles=(Obstacle("tables", tuple(tops)),))


def make_task(assembly: Assembly, cell: Cell, *, allow_regrasp: bool) -> Task:
    """The task to take everything away."""
    return Task.from_rules(assembly.boundary, cell.robot_count, identity=assembly.identity, allow_regrasp=allow_regrasp)
