"""Two cubes and two arms, the first of which holds a cube by its side, from which the cube cannot leave."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from falsework import Assembly, Direction, StabilityOracle, Task, plan_robots
from falsework.assembly import HELD, complete_state
from falsework.assembly.library.blocks import box, gather
from falsework.robots import Cell, HybridSettings, KeyframeGraph, Obstacle
from falsework.robots.model.shapes import block
from falsework.robots.planning.hybrid_result import HybridResult

NEAR, FAR = 0, 1
"""The cube that the first arm holds by its side, and another on the far side."""


def cubes(post: float = -0.05) -> Assembly:
    """Two cubes of 0.2 m; one stands on a fixed post between low rims, so that it can leave upwards only."""
    solids = [box("near", (-0.1, -0.1, 0.01), (0.1, 0.1, 0.2)), box("far", (0.25, -0.1, 0.0), (0.45, 0.1, 0.2))]
    for name, low, high in (
        ("post", (post, -0.1, 0.0), (0.1, 0.1, 0.01)),
        ("west", (-0.15, -0.1, 0.0), (-0.11, 0.1, 0.03)),
        ("east", (0.11, -0.1, 0.0), (0.15, 0.1, 0.03)),
        ("south", (-0.1, -0.15, 0.0), (0.1, -0.11, 0.03)),
        ("north", (-0.1, 0.11, 0.0), (0.1, 0.15, 0.03)),
        ("ground", (-0.6, -0.6, -0.05), (0.6, 0.6, 0.0)),
    ):
        solids.append(box(name, low, high, fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="sunk")


def under_a_bar(cell: Cell) -> Cell:
    """The cell with a bar above the gripper of an arm that holds the near cube by its side."""
    return replace(cell, obstacles=(Obstacle("bar", (block((-0.22, -0.4, 0.17), (-0.13, 0.4, 0.19)),)),))


def begin(assembly: Assembly, cell: Cell) -> dict[str, Any]:
    """State, joint values and holds with which a plan begins, and an oracle."""
    graph, state = KeyframeGraph(assembly, cell), complete_state(assembly.boundary)
    grips = [grip for grip in graph.grips(0, NEAR, state) if grip.grasp.approach[0] > 0.99]
    nearest = min(grips, key=lambda grip: np.abs(grip.configuration - cell.homes[0]).max())
    state[NEAR] = HELD
    return {
        "start": state,
        "configurations": (nearest.configuration, *cell.homes[1:]),
        "held": (NEAR, *(None for _ in cell.homes[1:])),
        "oracle": StabilityOracle(assembly),
    }


def make_task(assembly: Assembly, begun: dict[str, Any], *, allow_regrasp: bool) -> Task:
    """The task that begins there."""
    return Task.from_rules(
        assembly.boundary, 2, start=begun["start"], identity=assembly.identity, allow_regrasp=allow_regrasp
    )


def planned(assembly: Assembly, cell: Cell, begun: dict[str, Any], *, allow_regrasp: bool) -> HybridResult:
    """Search for a plan from there on."""
    given = {key: value for key, value in begun.items() if key != "start"}
    task = make_task(assembly, begun, allow_regrasp=allow_regrasp)
    return plan_robots(assembly, cell, task=task, settings=HybridSettings(Direction.DISASSEMBLY, attempts=4), **given)
