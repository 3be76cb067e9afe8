"""A slab under a roof, which an arm can grip by its edges only, and a table above which it fits only lying flat."""

from __future__ import annotations

from dataclasses import replace

from falsework.assembly.library.blocks import box, gather
from falsework.assembly.model import Assembly
from falsework.robots.model.cell import Cell, Obstacle
from falsework.robots.model.shapes import block
from falsework.robots.planning.hybrid_planner import plan_robots
from falsework.robots.planning.hybrid_result import HybridResult, HybridSettings
from falsework.search import Task

SLAB = 0


def slab() -> Assembly:
    """A slab of 0.3 m by 0.3 m by 0.1 m on a plinth, 0.02 m below a roof."""
    solids = [box("slab", (-0.15, -0.15, 0.3), (0.15, 0.15, 0.4))]
    for name, low, high in (
        ("plinth", (-0.1, -0.1, 0.0), (0.1, 0.1, 0.3)),
        ("roof", (-0.2, -0.2, 0.42), (0.2, 0.2, 0.45)),
    ):
        solids.append(box(name, low, high, fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="slab")


def tabled(cell: Cell) -> Cell:
    """The cell with a table below each drop-off pose, 0.18 m below the tool."""
    tables = []
    for robot in cell.robots:
        for x, y, z in robot.places[:, :3, 3]:
            tables.append(block((x - 0.3, y - 0.3, z - 0.2), (x + 0.3, y + 0.3, z - 0.18)))
    return replace(cell, obstacles=(Obstacle("tables", tuple(tables)),))


def planned(assembly: Assembly, cell: Cell, *, support: bool) -> HybridResult:
    """Search for a plan that takes the slab away."""
    task = Task.create(assembly.boundary, cell.robot_count, identity=assembly.identity, support=support)
    return plan_robots(assembly, cell, task=task, settings=HybridSettings(attempts=3))
