"""Parts that no two arms can hold at the same time: excluded states, and searches that respect them."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, Task, plan_robots
from falsework.assembly import HELD, REMOVED, complete_state
from falsework.robots import Cell, KeyframeGraph
from falsework.robots.kernels.coordination import conflicts
from falsework.robots.keyframes.joint_holds import HoldingOracle, JointHolds
from falsework.robots.motion.collision_world import Contact, Scene
from falsework.robots.planning.solvability import SolvabilityCheck
from tests.robots.plans.orders import APART


@pytest.fixture
def graph(column: Assembly, cell: Cell) -> KeyframeGraph:
    return KeyframeGraph(column, cell)


def held(assembly: Assembly, *parts: int) -> np.ndarray:
    """The complete structure with some parts held."""
    state = complete_state(assembly.boundary)
    state[list(parts)] = HELD
    return state


def test_grips_that_go_together_are_those_of_the_collision_world(
    graph: KeyframeGraph, column: Assembly, cell: Cell
) -> None:
    state = held(column, 1, 2)
    mine, theirs = graph.grips(0, 1, state)[::40], graph.grips(1, 2, state)[::40]
    assert mine
    assert theirs
    one, other = graph.joint.swept(mine), graph.joint.swept(theirs)
    apart = ~conflicts((one, one), (other, other), cell.margins.line)
    clear = np.where(apart.any(axis=1), apart.argmax(axis=1), -1)
    table = graph.joint.clear(mine, theirs)
    assert table.shape == (len(mine), len(theirs))
    np.testing.assert_array_equal(np.where(table.any(axis=1), table.argmax(axis=1), -1), clear)
    values = np.array([grip.configuration for grip in theirs])
    for grip, found in zip(mine, clear.tolist(), strict=True):
        scene = Scene((grip.configuration, cell.homes[1]), state != REMOVED, (None, None))
        contact = Contact(gripper=frozenset({2}))
        hits = graph.world.view(scene, 1, contact=contact, margin=cell.margins.line).hits(values)
        assert found == next(iter(np.flatnonzero(hits < 0)), -1)


def test_parts_that_two_arms_can_hold_are_not_ruled_out(graph: KeyframeGraph, column: Assembly) -> None:
    state = held(column, 1)
    assert not graph.joint.learn((2, 1), state)
    assert graph.joint.excluded == 0
    assert graph.joint.possible(held(column, 1, 2)[None]).all()


def test_what_one_arm_cannot_hold_alone_is_ruled_out_where_more_stands(
    column: Assembly, cell_of: Callable[..., Cell]
) -> None:
    joint = KeyframeGraph(column, cell_of(1)).joint
    fewer = held(column, 1, 2)
    fewer[0] = REMOVED
    assert joint.learn((1, 2), fewer)
    assert not joint.learn((2, 1), held(column, 1))  # follows from that
    assert joint.excluded == 1
    states = np.array([fewer, held(column, 1, 2), held(column, 1), held(column, 0, 2)])
    np.testing.assert_array_equal(joint.possible(states), [False, False, True, True])


def test_three_parts_that_only_two_arms_reach(column: Assembly, cell: Cell) -> None:
    joint = KeyframeGraph(column, cell).joint
    state = held(column, 0, 1, 2)
    assert not joint.learn((1, 2), state)
    assert joint.learn((2, 0, 1), state)
    np.testing.assert_array_equal(joint.possible(np.array([state, held(column, 1, 2)])), [False, True])
    joint.forget()
    assert joint.possible(state[None]).all()


def test_grasps_with_which_a_part_cannot_leave_do_not_count(column: Assembly, cell: Cell) -> None:
    grips = KeyframeGraph(column, cell).grasp_configurations
    state = held(column, 1, 2)
    assert not JointHolds(grips, lambda *_: True).learn((1, 2), state)
    assert JointHolds(grips, lambda grip, part, _: part != 2).learn((1, 2), state)
    only = JointHolds(grips, lambda grip, part, _: grip.robot == part - 1)
    assert not only.learn((1, 2), state)
    assert JointHolds(grips, lambda grip, *_: grip.robot == 0).learn((1, 2), state)


def test_grasps_that_no_arm_can_approach_do_not_count(
    column: Assembly, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = held(column, 1, 2)
    for blocked in (False, True):
        graph = KeyframeGraph(column, cell)
        if blocked:
            monkeypatch.setattr(graph.reaching, "retreat", lambda *given: None if given[2] == 2 else given[4][None])
        for allow_regrasp in (False, True):
            graph.allow_regrasp = allow_regrasp
            graph.joint.forget()
            assert graph.joint.learn((1, 2), state) == blocked


def test_arms_with_which_dead_ends_repeat_are_not_tried_again(column: Assembly, cell: Cell) -> None:
    graph = KeyframeGraph(column, cell)
    root = graph.start(held(column), cell.homes, (None, None))
    robot = next(graph.edges(root, 1)).robot
    for edge in itertools.islice((edge for edge in graph.edges(root, 1) if edge.robot == robot), 2):
        graph.dead.add(edge.node)
        assert edge.node in graph.dead
    assert graph.dead.repeated(root, 1, robot)
    assert robot not in {edge.robot for edge in graph.edges(root, 1)}
    graph.allow_regrasp = True
    assert robot in {edge.robot for edge in graph.edges(root, 1)}
    graph.dead.clear()
    assert not graph.dead.repeated(root, 1, robot)


def test_states_are_compared_where_rivals_meet(column: Assembly, cell_of: Callable[..., Cell]) -> None:
    joint = KeyframeGraph(column, cell_of(1)).joint
    states = np.array([held(column, 1), held(column, 1, 2)])
    assert not joint.learn_from(states)  # nothing has failed yet
    fewer = held(column, 1)
    joint.learn((0, 1), fewer)
    assert not joint.learn_from(states)
    joint.learn((1, 2), fewer)
    assert not joint.possible(states[1:]).any()


def test_the_oracle_leaves_open_what_no_arms_can_hold(column: Assembly, graph: KeyframeGraph) -> None:
    oracle = StabilityOracle(column)
    graph.joint.exclude((1, 2), held(column))
    holding = HoldingOracle(oracle, graph.joint)
    states = np.array([held(column, 1), held(column, 1, 2)])
    np.testing.assert_array_equal(oracle.verdicts(states).stable, [True, True])
    np.testing.assert_array_equal(holding.verdicts(states).stable, [True, False])
    assert holding.verdicts(states, near=states).undecided.tolist() == [False, True]


def test_plans_keep_to_it(column: Assembly, cell: Cell, graph: KeyframeGraph) -> None:
    least = np.where(column.boundary, HELD, REMOVED).astype(np.uint8)
    least[[1, 2]] = HELD
    graph.joint.exclude((1, 2), least)
    plan = plan_robots(column, cell, graph=graph, settings=APART).value
    assert plan is not None
    assert not ((plan.plan.states[:, 1] == HELD) & (plan.plan.states[:, 2] == HELD)).any()


def test_a_way_around_is_found_from_midway(column: Assembly, graph: KeyframeGraph) -> None:
    task = Task.from_rules(column.boundary, 2, clearance=column.clearance, identity=column.identity)
    solvability = SolvabilityCheck(column, task, StabilityOracle(column), joint=graph.joint)
    result = solvability.prepare()
    assert result.found
    state = held(column, 2)
    least = np.where(column.boundary, HELD, REMOVED).astype(np.uint8)
    least[[1, 2]] = HELD
    graph.joint.exclude((1, 2), least)
    assert solvability.reroute(state)
    assert solvability.stays(state)
    assert solvability.reroute(held(column))
    assert not solvability.solvable(state, 1)
    assert not solvability.stays(held(column, 1, 2))
