"""Plans that continue from where the arms are: assembly and disassembly, with parts held in place and carried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, StabilityOracle, Task, plan_robots
from falsework.assembly import HELD
from falsework.errors import InputError, PlanError, StateError
from falsework.robots import Cell, RobotPlan, interruption, schedule_plan
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.exports.commands import Grip, events_of
from falsework.robots.plans.loads import load_of, loads_at
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_from_dict,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.robot_plan_model import robot_plan_schema
from falsework.search.plans.plan_check import validate_plan
from falsework.viewer.arms import Arms
from tests.robots.plans.orders import APART


@pytest.fixture(scope="module")
def building(robot_plan: RobotPlan) -> RobotPlan:
    """The plan of the column in the order of assembly."""
    return robot_plan.reverse()


@pytest.fixture(scope="module")
def go_on(column: Assembly, cell: Cell, oracle: StabilityOracle) -> Callable[..., RobotPlan]:
    """`go_on(state, configurations, held, gripped)`: a plan that builds the rest."""

    def plan(state: np.ndarray, *now: Any, **more: Any) -> RobotPlan:
        task = Task.from_rules(column.boundary, 2, target=state, identity=column.identity)
        given = dict(zip(("configurations", "held", "gripped"), now, strict=False))
        found = plan_robots(column, cell, task=task, oracle=oracle, **given, **more)
        assert found.value is not None, found.explanation
        return found.value

    return plan


def inserting(plan: RobotPlan) -> list[int]:
    """The steps that insert a part."""
    return np.flatnonzero(plan.actions >= len(plan.plan.boundary)).tolist()


def carrying(plan: RobotPlan, step: int) -> tuple[list[np.ndarray], list[int | None], list[np.ndarray | None]]:
    """Configurations, parts and grips while the robot of an insertion rests between its first two motions."""
    robot, load = plan.steps[step].robot, load_of(plan, step, 0)
    assert load is not None
    values, held = list(plan.keyframes[step].configurations), list(plan.keyframes[step].held)
    values[robot], held[robot] = plan.steps[step].trajectories[0].positions[-1], load.part
    gripped: list[np.ndarray | None] = [None] * len(values)
    gripped[robot] = load.grip
    return values, held, gripped


def check(plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    """Check motions and states, as written to a file and read again."""
    data = robot_plan_to_dict(plan)
    jsonschema.Draft202012Validator(robot_plan_schema()).validate(data)
    plan = robot_plan_from_dict(data)
    report = check_robot_plan(plan, column, cell)
    assert report.good, report.problems
    assert validate_plan(plan.plan, column).good
    turned = check_robot_plan(plan.reverse(), column, cell)
    assert turned.good, turned.problems


def test_assembly_goes_on_from_every_keyframe(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    """With arms that stand anywhere or hold parts in place; those that hold keep their grips until they release."""
    for row, frame in enumerate(building.keyframes[:-1]):
        rest = go_on(building.states[row], frame.configurations, frame.held)
        assert rest.direction is Direction.ASSEMBLY
        np.testing.assert_array_equal(rest.states[0], building.states[row])
        np.testing.assert_array_equal(rest.states[-1], building.states[-1])
        assert rest.keyframes[0].held == frame.held
        np.testing.assert_array_equal(rest.keyframes[0].configurations, frame.configurations)
        check(rest, column, cell)


def test_arms_that_do_nothing_next_go_out_of_the_way(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    """An arm with its gripper still at the part that it has released leaves it on a line, then goes on."""
    step = next(k for k in range(1, len(building)) if building.grip(k) == "open")
    robot, frame = building.steps[step].robot, building.keyframes[step]
    held = tuple(None if k == robot else part for k, part in enumerate(frame.held))
    rest = go_on(building.states[step + 1], frame.configurations, held)
    transit = next(k for k, entry in enumerate(rest.steps) if entry.robot == robot)
    assert rest.steps[transit].transit
    assert rest.does(transit) == "go to another place"
    line = rest.steps[transit].trajectories[0]
    assert (line.kind, line.part, line.touches) == ("line", None, int(building.actions[step]))
    assert int(rest.actions[transit]) == -1
    assert rest.grip(transit) is None
    assert list(events_of(rest, transit)) == list(rest.steps[transit].trajectories)
    check(rest, column, cell)


def test_a_carried_part_is_inserted_first(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    for step in inserting(building):
        values, held, gripped = carrying(building, step)
        robot, part = building.steps[step].robot, int(building.actions[step]) % column.part_count
        rest = go_on(building.states[step], values, held, gripped)
        assert rest.keyframes[0].load(robot) == part
        first = next(k for k, entry in enumerate(rest.steps) if entry.robot == robot)
        assert rest.does(first) == f"insert {column.names[part]}"
        assert all(not isinstance(event, Grip) for event in events_of(rest, first))  # it is in the gripper already
        assert [(k, load.part) for k, load in loads_at(rest, 0).items()] == [(robot, part)]
        check(rest, column, cell)


def test_a_carried_part_that_cannot_be_next_is_brought_back(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    """The upper cube of the column has nothing to stand on yet, and falls off a robot's arm when that lets go."""
    step = next(k for k in inserting(building) if building.actions[k] % column.part_count == 1)
    values, held, gripped = carrying(building, step)
    robot = building.steps[step].robot
    held = [part if k == robot else None for k, part in enumerate(held)]
    values = [value if k == robot else home for k, (value, home) in enumerate(zip(values, cell.homes, strict=True))]
    empty = building.states[0]
    rest = plan_robots(
        column,
        cell,
        task=Task.from_rules(column.boundary, 2, start=building.states[inserting(building)[0] + 2], target=empty),
        configurations=values,
        held=held,
        gripped=gripped,
    ).value  # the complete structure is the first cube: the carried one is not in it
    assert rest is not None
    alone = rest.reverse()
    back = next(k for k, entry in enumerate(rest.steps) if entry.robot == robot)
    assert rest.does(back) == f"carry {column.names[1]}"
    assert [event.close for event in events_of(rest, back) if isinstance(event, Grip)] == [False]
    assert [event.close for event in events_of(alone, len(rest) - 1 - back) if isinstance(event, Grip)] == [True]
    check(rest, column, cell)


def test_disassembly_delivers_a_carried_part_first(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, oracle: StabilityOracle, tmp_path: Path
) -> None:
    step = inserting(robot_plan)[0]
    robot, part = robot_plan.steps[step].robot, int(robot_plan.actions[step]) % column.part_count
    values, held = list(robot_plan.keyframes[step].configurations), list(robot_plan.keyframes[step].held)
    grip, held[robot] = values[robot], part
    values[robot] = robot_plan.steps[step].trajectories[-1].positions[0]
    gripped = [grip if k == robot else None for k in range(2)]
    task = Task.from_rules(column.boundary, 2, start=robot_plan.states[step + 1], identity=column.identity)
    given: dict[str, Any] = {"configurations": values, "held": held, "gripped": gripped}
    rest = plan_robots(column, cell, task=task, oracle=oracle, settings=APART, **given).value
    assert rest is not None
    assert rest.steps[0].transit
    assert rest.does(0) == f"carry {column.names[part]}"
    assert [event.close for event in events_of(rest, 0) if isinstance(event, Grip)] == [False]
    check(rest, column, cell)
    save_robot_plan(rest, tmp_path / "rest.json")
    shown = Arms(load_robot_plan(tmp_path / "rest.json"), cell, Direction.DISASSEMBLY)
    count = len(rest.plan)
    assert [load.part for load in shown.at(count).carried] == [part]
    assert [load.part for load in shown.at(count - 1e-3).carried] == [part]
    assert shown.at(count - 0.5).carried == ()


def test_arms_that_move_at_the_same_time(
    building: RobotPlan, column: Assembly, cell: Cell, oracle: StabilityOracle, tmp_path: Path
) -> None:
    """Another arm keeps clear of a part that waits in a gripper, whatever the delays."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    from falsework.robots import simulate
    from falsework.robots.exports.mcap_bag import write_bag

    step = inserting(building)[0]
    values, held, gripped = carrying(building, step)
    task = Task.from_rules(column.boundary, 2, target=building.states[step], identity=column.identity)
    now: dict[str, Any] = {"configurations": values, "held": held, "gripped": gripped}
    rest = plan_robots(column, cell, task=task, oracle=oracle, concurrent=True, **now).value
    assert rest is not None
    assert rest.schedule is not None
    check(rest, column, cell)
    assert simulate(rest, runs=50).good
    robot = building.steps[step].robot
    shown = Arms(rest, cell, Direction.ASSEMBLY)
    assert robot in [load.robot for load in shown.at_time(0.0).carried]
    pytest.importorskip("mcap", reason="bags need mcap; pip install 'falsework[schedule]'")
    pytest.importorskip("rosbags", reason="bags need rosbags; pip install 'falsework[schedule]'")
    legs = sum(len(entry.trajectories) for entry in rest.steps)
    assert write_bag(rest, tmp_path / "rest.mcap") == 2 * legs + 2 * len(inserting(rest))


def test_from_wherever_a_schedule_is_interrupted(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    """Arms finish the motions that they have begun; what they hold and carry then is what they begin with."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    plan = schedule_plan(building, column, cell)
    for share in (0.15, 0.4, 0.65, 0.8):
        now = interruption(plan, share * plan.makespan)
        rest = go_on(now.state, now.configurations, now.held, now.gripped)
        again = interruption(rest, -1.0)
        np.testing.assert_array_equal(again.state, now.state)
        assert again.held == now.held
        np.testing.assert_array_equal(again.configurations, now.configurations)
        assert [grip is None for grip in again.gripped] == [grip is None for grip in now.gripped]
        check(rest, column, cell)
    end = interruption(plan, plan.makespan)
    np.testing.assert_array_equal(end.state, plan.states[-1])
    assert set(end.held) == set(end.gripped) == {None}


def test_plans_that_do_not_say_what_is_carried(
    building: RobotPlan, go_on: Callable[..., RobotPlan], column: Assembly, cell: Cell
) -> None:
    step = inserting(building)[0]
    values, held, gripped = carrying(building, step)
    part = held[building.steps[step].robot]
    rest = go_on(building.states[step], values, held, gripped)
    silent = replace(rest, keyframes=(replace(rest.keyframes[0], carried=(part, part)), *rest.keyframes[1:]))
    with pytest.raises(PlanError, match="comes to carry another part"):
        robot_plan_from_dict(robot_plan_to_dict(silent))
    assert not check_robot_plan(silent, column, cell).good
    data = robot_plan_to_dict(rest)
    data["steps"][0]["transit"] = "yes"
    with pytest.raises(PlanError, match="transit is 'yes'; give true or false"):
        robot_plan_from_dict(data)
    frame = building.keyframes[step]
    free = go_on(building.states[step], [value + 0.1 for value in cell.homes], frame.held)
    steps = list(free.steps)
    move = next(k for k, entry in enumerate(steps) if entry.transit)
    steps[move] = replace(steps[move], gripped=cell.homes[0])
    with pytest.raises(PlanError, match="carries one part with a grip, or none without"):
        robot_plan_from_dict(robot_plan_to_dict(replace(free, steps=tuple(steps))))


def test_where_the_arms_cannot_be(building: RobotPlan, column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    step = inserting(building)[0]
    values, held, gripped = carrying(building, step)
    robot = building.steps[step].robot
    task = Task.from_rules(column.boundary, 2, target=building.states[step], identity=column.identity)

    def go(*now: Any) -> None:
        given = dict(zip(("configurations", "held", "gripped"), now, strict=False))
        plan_robots(column, cell, task=task, oracle=oracle, **given)

    with pytest.raises(InputError, match="which is not in place; give the joint values"):
        go(values, held)
    with pytest.raises(InputError, match=r"m away from part .*, which it should hold"):
        go(values, held, [cell.homes[k] if k == robot else None for k in range(2)])
    with pytest.raises(InputError, match="carries no part, so it has no grip"):
        go(values, held, [gripped[robot]] * 2)
    with pytest.raises(InputError, match=r"grip of arm . has shape"):
        go(values, held, [[0.0] if k == robot else None for k in range(2)])
    ends = np.array(building.states[-1])
    ends[1] = HELD
    with pytest.raises(StateError, match="part block-1 is held in the state in which the assembly ends"):
        plan_robots(column, cell, task=Task.from_rules(column.boundary, 2, start=ends, identity=column.identity))
    with pytest.raises(StateError, match="two robots hold one part"):
        go(values, [held[robot]] * 2, [gripped[robot]] * 2)
    with pytest.raises(InputError, match="outside its limits"):
        go([np.full(6, 9.0), cell.homes[1]])
