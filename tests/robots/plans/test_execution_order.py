"""The order in which a robot plan is executed: assembly by default, and the one whose makespan is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework import Assembly, Direction, StabilityOracle, plan_robots
from falsework.assembly import complete_state, empty_state
from falsework.errors import InputError
from falsework.robots import Cell, HybridSettings, RobotPlan, schedule_plan
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.plans.timeline import event_times, schedule_of


@pytest.fixture(scope="module")
def together(row: Assembly, wide: Cell) -> dict[Direction, RobotPlan]:
    """Plans with the same search, for both orders."""
    made = {
        direction: plan_robots(row, wide, settings=HybridSettings(direction, seed=1), concurrent=True).value
        for direction in Direction
    }
    return {direction: plan for direction, plan in made.items() if plan is not None}


def test_by_default_it_assembles(column: Assembly, cell: Cell, oracle: StabilityOracle, robot_plan: RobotPlan) -> None:
    """The motions are those of the disassembly, backwards in time; the steps have the numbers of the plan."""
    plan = plan_robots(column, cell, oracle=oracle).value
    assert plan is not None
    assert plan.direction is Direction.ASSEMBLY
    np.testing.assert_array_equal(plan.states[0], empty_state(column.boundary))
    np.testing.assert_array_equal(plan.states[-1], complete_state(column.boundary))
    assert [plan.number(step) for step in range(len(plan))] == [1, 2, 3, 4, 5, 6]
    assert [plan.does(step) for step in range(len(plan))] == [step.words for step in plan.plan]
    apart = plan.reverse()
    assert [apart.number(step) for step in range(len(plan))] == [6, 5, 4, 3, 2, 1]
    assert [apart.does(step) for step in range(len(plan))] == [
        step.words for step in plan.plan.in_order(Direction.DISASSEMBLY)
    ]
    np.testing.assert_array_equal(apart.actions, robot_plan.actions)
    np.testing.assert_array_equal(apart.states, robot_plan.states)
    assert apart.seconds == pytest.approx(robot_plan.seconds)
    assert apart.plan is plan.plan


@pytest.mark.parametrize("direction", list(Direction))
def test_the_makespan_is_that_of_the_execution(
    together: dict[Direction, RobotPlan], row: Assembly, wide: Cell, direction: Direction
) -> None:
    plan = together[direction]
    graph = schedule_of(plan)
    assert plan.direction is direction
    assert plan.schedule is graph
    events = event_times(plan, graph)
    assert (np.diff(events) >= 0).all()
    assert events[-1] <= plan.makespan
    first = empty_state if direction is Direction.ASSEMBLY else complete_state
    np.testing.assert_array_equal(plan.states[0], first(row.boundary))
    assert check_robot_plan(plan, row, wide).good
    # Scheduled again as it is executed, nothing is gained.
    assert schedule_plan(replace(plan, schedule=None), row, wide).makespan == pytest.approx(plan.makespan, abs=1e-3)


def test_the_makespan_of_the_assembly_is_made_short(
    together: dict[Direction, RobotPlan], row: Assembly, wide: Cell
) -> None:
    """It is no longer than where a plan made for disassembly is turned, and scheduled again."""
    turned = schedule_plan(together[Direction.DISASSEMBLY].reverse(), row, wide)
    assert together[Direction.ASSEMBLY].makespan <= turned.makespan + 1e-3


def test_there_are_two_orders() -> None:
    assert HybridSettings("disassembly").direction is Direction.DISASSEMBLY  # type: ignore[arg-type]
    with pytest.raises(InputError, match="direction is 'sideways'; it must be assembly or disassembly"):
        HybridSettings("sideways")  # type: ignore[arg-type]
