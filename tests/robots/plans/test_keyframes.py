"""The keyframe graph: invariants of its nodes and edges, and that nothing is computed twice."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from falsework import Assembly
from falsework.assembly import complete_state
from falsework.robots import Cell, KeyframeGraph
from falsework.robots.grasping.exit_ways import ExitWays
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Placement


@pytest.fixture(scope="module")
def graph(column: Assembly, cell: Cell) -> KeyframeGraph:
    return KeyframeGraph(column, cell)


def test_two_robots_never_hold_one_part_nor_meet(graph: KeyframeGraph, column: Assembly, cell: Cell) -> None:
    """Grasps have several branches, and two arms that hold neighbours keep apart."""
    root, branches = graph.start(complete_state(column.boundary), cell.homes, (None, None)), 0
    for first in itertools.islice(graph.edges(root, 1), 4):
        branches += len(graph.grips(first.robot, 1, root.state)) > 8
        for second in itertools.islice(graph.edges(first.node, 2), 3):
            assert {first.robot, second.robot} == {0, 1}
            assert {*second.node.held} == {1, 2}
            assert graph.collision(second.node, 0) is None
            grips = graph.grips(second.robot, 2, first.node.state)
            tool = tool_pose(cell.robots[second.robot], second.node.configurations[second.robot])
            assert any(np.allclose(tool, grip.grasp.tool, atol=1e-5) for grip in grips)
    assert branches


def test_an_edge_moves_one_robot_from_where_it_stands(graph: KeyframeGraph, column: Assembly, cell: Cell) -> None:
    root = graph.start(complete_state(column.boundary), cell.homes, (None, None))
    hold = next(graph.edges(root, 1))
    assert hold.node.state[1] == 2
    assert hold.node.held[hold.robot] == 1
    np.testing.assert_allclose(hold.segments[0].path[0], root.configurations[hold.robot])
    np.testing.assert_allclose(hold.segments[0].path[-1], hold.segments[1].path[0], atol=1e-12)
    np.testing.assert_allclose(hold.segments[1].path[-1], hold.node.configurations[hold.robot])
    other = 1 - hold.robot
    np.testing.assert_array_equal(hold.node.configurations[other], root.configurations[other])
    remove = next(graph.edges(hold.node, column.part_count + 1))
    assert remove.robot == hold.robot
    assert remove.node.state[1] == 0
    assert remove.node.held == (None, None)
    assert all(segment.part == 1 for segment in remove.segments)
    # The part leaves straight, and ends where the robot puts parts.
    tools = tool_pose(cell.robots[remove.robot], remove.segments[0].path)
    ways = tools[1:, :3, 3] - tools[0, :3, 3]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(ways @ ways[-1], 1.0, atol=1e-4)
    end = tool_pose(cell.robots[remove.robot], remove.node.configurations[remove.robot])
    places = cell.robots[remove.robot].places[:, :3, 3]
    assert np.abs(places - end[:3, 3]).max(axis=1).min() < 1e-5


def test_what_was_computed_is_kept(graph: KeyframeGraph, column: Assembly, cell: Cell) -> None:
    root = graph.start(complete_state(column.boundary), cell.homes, (None, None))
    first = next(graph.edges(root, 2))
    computed, views = graph.cache.motions, graph.cache.views
    again = next(graph.edges(root, 2))
    assert (graph.cache.motions, graph.cache.views) == (computed, views)
    assert graph.cache.motions_kept > 0
    for one, other in zip(first.segments, again.segments, strict=True):
        np.testing.assert_array_equal(one.path, other.path)


def test_a_part_under_another_cannot_leave(graph: KeyframeGraph, column: Assembly) -> None:
    state = complete_state(column.boundary)
    assert graph.blocked_by(1, state) == 0
    later, ways = graph.exits.free_later(0, state)
    assert len(ways)
    assert later[0] == 1


def test_exits_agree_with_the_clearance_table(column: Assembly) -> None:
    """A fan of directions finds a way out only where the table finds one."""
    exits = ExitWays(column, Placement())
    rng = np.random.default_rng(0)
    free = ~column.boundary
    for _ in range(30):
        state = np.where(free, rng.integers(0, 2, column.part_count), 2).astype(np.uint8)
        clear = column.clearance.can_leave(state[None])[0]
        for part in np.flatnonzero(free):
            ways = np.array([move.direction for (move,) in exits.free(int(part), state)]).reshape(-1, 3)
            assert len(ways) == 0 or clear[part]
            assert (ways[:, 2] >= -1e-6).all()
            assert (np.diff(ways[:, 2]) <= 1e-8).all()
    top = exits.free(1, complete_state(column.boundary))
    np.testing.assert_allclose(top[0][0].direction, (0, 0, 1), atol=1e-9)


def test_too_heavy_and_out_of_reach_are_reasons(column: Assembly, cell_of: Callable[..., Cell]) -> None:
    state = complete_state(column.boundary)
    weak = KeyframeGraph(column, cell_of(1, 1.15, payload=0.5))
    assert weak.grips(0, 1, state) == []
    assert not weak.reachable(1)
    assert any("weighs 2 kg" in reason.what for reason in weak.reasons.counts if reason.part == 1)
    far = KeyframeGraph(column, cell_of(1, 4.0))
    assert far.grips(0, 1, state) == []
    assert [reason.what for reason in far.reasons.counts if reason.part == 1] == ["out of reach"]
