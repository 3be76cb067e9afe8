"""Structures that a cell scales, or gives another density: what is proven of them must hold for those in the cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, plan_robots
from falsework.assembly import Joints, Loads
from falsework.assembly.library.blocks import box, gather
from falsework.errors import CellError
from falsework.robots import Cell, Placement
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.cell_holds import CellScale, stability_in
from falsework.stability import HoldSettings
from falsework.stability.holds import HoldMode

LIGHT, HEAVY = 200.0, 2000.0


@pytest.fixture(scope="module")
def lever() -> Assembly:
    """A beam that reaches far beyond its post, with a heavy plate on the other end."""
    made = gather(
        [
            box("beam", (-0.3, -0.1, 0.1), (0.3, 0.1, 0.15)),
            box("plate", (-0.3, -0.1, 0.15), (-0.1, 0.1, 0.18)),
            box("post", (-0.3, -0.1, 0.0), (-0.05, 0.1, 0.1), fixed=True),
            box("ground", (-0.6, -0.6, -0.05), (0.6, 0.6, 0.0), fixed=True),
        ]
    )
    density = (LIGHT, HEAVY, LIGHT, LIGHT)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=density, name="lever")


def test_a_cell_that_makes_all_parts_of_one_material_is_refused(lever: Assembly, cell_of: Callable[..., Cell]) -> None:
    """The lever stands because its plate is heavy; of one material it falls."""
    state = np.array([[1, 1, 2, 2]])
    assert StabilityOracle(lever).verdicts(state).stable.all()
    assert not StabilityOracle(lever.replace(density=300.0)).verdicts(state).stable.any()
    cell = cell_of(payload=20.0)
    even = replace(cell, placement=Placement(density=300.0))
    message = "gives all parts of lever a density of 300 kg/m3, of which some have 200 and others 2000"
    with pytest.raises(CellError, match=message) as caught:
        plan_robots(lever, even)
    assert "\n" not in str(caught.value)
    plan = plan_robots(lever, cell).value
    assert plan is not None
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.check import check_robot_plan

    with pytest.raises(CellError, match=message):
        check_robot_plan(replace(plan, cell_identity=cell_identity(even)), lever, even)
    assert CellScale.from_cell(lever, replace(cell, placement=Placement(scale=0.5))).force == pytest.approx(0.125)


@pytest.mark.parametrize("placement", [Placement(scale=0.5), Placement(density=2 * LIGHT)], ids=["scale", "density"])
@pytest.mark.parametrize("what", ["loads", "joints with a strength"])
def test_a_cell_that_changes_weights_but_not_what_bears_them_is_refused(
    lever: Assembly, cell: Cell, what: str, placement: Placement
) -> None:
    wrench = np.zeros((4, 6))
    wrench[1, 2] = -10.0
    even = lever.replace(density=LIGHT)
    if what == "loads":
        given = even.replace(loads=Loads.from_arrays(4, wrench=wrench))
    else:
        given = even.replace(joints=Joints.from_uniform(even.contacts, tension=1e5))
    for kept in (Placement(), Placement((0.1, 0.0, 0.0), yaw=1.0, density=LIGHT)):
        assert CellScale.from_cell(given, replace(cell, placement=kept)) == CellScale(1.0, 1.0)
    with pytest.raises(CellError, match=f"changes the weights of lever, but its {what} stay as they are"):
        CellScale.from_cell(given, replace(cell, placement=placement))
    assert CellScale.from_cell(even, replace(cell, placement=placement)).force != 1.0


def test_the_ground_does_not_count(lever: Assembly, cell: Cell) -> None:
    """Its mass has no part in any force."""
    grounded = lever.replace(density=(LIGHT, LIGHT, 10.0, 8000.0))
    assert CellScale.from_cell(grounded, replace(cell, placement=Placement(density=400.0))).force == pytest.approx(2.0)


def test_robots_that_never_press_still_bear_no_more_than_their_grippers(column: Assembly, cell: Cell) -> None:
    weak = [replace(robot, gripper=replace(robot.gripper, force=60.0)) for robot in cell.robots]
    given = StabilitySettings(holds=HoldSettings(force=0.0))
    holds = stability_in(replace(cell, robots=tuple(weak)), column, given).holds
    assert holds.force == pytest.approx(60.0)
    assert holds.mode is HoldMode.LOCKED
