"""A small cell with two arms around a few boxes, and one robot plan for it that all tests share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly, Direction, StabilityOracle, plan_robots
from falsework.assembly.library.blocks import box, gather
from falsework.robots import Cell, CellRobot, Gripper, HybridSettings, RobotPlan
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.shapes import cylinder, pose
from falsework.robots.planning.hybrid_result import HybridResult
from tests.robots.plans.orders import APART
from tests.robots.plans.sunk_cubes import under_a_bar

SIZE = 0.2


def boxes(*lows: tuple[float, float, float]) -> Assembly:
    """Cubes of 0.2 m on a fixed slab."""
    solids = [box("block", low, np.asarray(low) + SIZE) for low in lows]
    solids.append(box("ground", (-0.6, -0.6, -0.05), (0.6, 0.6, 0.0), fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="boxes")


def make_cell(bases: int = 2, distance: float = 1.15, payload: float = 10.0) -> Cell:
    """Arms in a circle that look at the middle, each with two places to put parts."""
    model = builtin_robot("irb2600-12/1.65")
    tool = np.eye(4)
    tool[2, 3] = 0.18
    gripper = Gripper(
        "cup", "suction", (cylinder(0.045, 0.0, 0.1), cylinder(0.02, 0.1, 0.178)), tool, payload, mass=1.0, cup=0.02
    )
    robots = []
    for number in range(bases):
        angle = np.pi + 2 * np.pi * number / bases
        base = pose((distance * np.cos(angle), distance * np.sin(angle), 0.0), angle + np.pi)
        places = []
        for side in (-0.95, 0.95):
            place = np.diag([1.0, -1.0, -1.0, 1.0])
            place[:3, 3] = (base @ np.array([0.15, side, 0.55, 1.0]))[:3]
            places.append(place)
        robots.append(CellRobot(f"arm {number + 1}", model, base, gripper, model.home, np.array(places)))
    return Cell("test cell", tuple(robots))


@pytest.fixture(scope="session")
def make_boxes() -> Callable[..., Assembly]:
    """`make_boxes(low, low, ...)`: cubes of 0.2 m on a fixed slab."""
    return boxes


@pytest.fixture(scope="session")
def cell_of() -> Callable[..., Cell]:
    """`cell_of(bases, distance, payload)`."""
    return make_cell


@pytest.fixture(scope="session")
def column() -> Assembly:
    """Two cubes on top of each other and one beside them."""
    return boxes((-0.1, -0.1, 0.0), (-0.1, -0.1, 0.2), (0.1, -0.1, 0.0))


@pytest.fixture(scope="session")
def cell() -> Cell:
    """Two arms."""
    return make_cell()


@pytest.fixture(scope="session")
def roofed() -> Cell:
    """Two arms, and a bar above the gripper of one that holds the near one of the sunk cubes by its side."""
    return under_a_bar(make_cell())


@pytest.fixture(scope="session")
def planned_in_turn() -> Callable[[Assembly, Cell], RobotPlan]:
    """`planned_in_turn(assembly, cell)`: a plan that lets all arms work, one after the other."""

    def plan(assembly: Assembly, cell: Cell) -> RobotPlan:
        found = plan_robots(assembly, cell, settings=HybridSettings(Direction.DISASSEMBLY), concurrent=True).value
        assert found is not None
        return replace(found, schedule=None)

    return plan


@pytest.fixture(scope="session")
def oracle(column: Assembly) -> StabilityOracle:
    """Stability of the column."""
    return StabilityOracle(column)


@pytest.fixture(scope="session")
def result(column: Assembly, cell: Cell, oracle: StabilityOracle) -> HybridResult:
    """Search for a plan that takes the column apart."""
    return plan_robots(column, cell, oracle=oracle, settings=APART)


@pytest.fixture(scope="session")
def robot_plan(result: HybridResult) -> RobotPlan:
    """That plan."""
    assert result.value is not None
    return result.value


@pytest.fixture(scope="session")
def row(make_boxes: Callable[..., Assembly]) -> Assembly:
    """Four cubes, two on each side."""
    return make_boxes((-0.45, -0.1, 0.0), (-0.2, -0.1, 0.0), (0.05, -0.1, 0.0), (0.3, -0.1, 0.0))


@pytest.fixture(scope="session")
def wide(cell_of: Callable[..., Cell]) -> Cell:
    """Two arms at its ends."""
    return cell_of(2, 1.3)
