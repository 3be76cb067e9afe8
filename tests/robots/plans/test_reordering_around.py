"""Reordering around steps that stay with their arms: hand-overs, and parts put down on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework import Assembly, Direction, Task, plan_robots
from falsework.assembly import HELD, INSTALLED
from falsework.robots import Cell, HybridSettings, KeyframeGraph, RobotPlan, schedule_plan, simulate
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.interleaving.orders import grippers_allow
from falsework.robots.interleaving.reordering import follow, lies_free, reorder, views
from falsework.robots.keyframes.keyframes import Edge, Node
from falsework.robots.keyframes.trajectory_assembly import make_robot_plan
from falsework.robots.motion.collision_world import CollisionQuery
from falsework.robots.planning import hybrid_search
from falsework.robots.plans.timeline import event_times
from tests.robots.plans.beam_in_turn import bridge_with
from tests.robots.plans.roofed_slab import slab, tabled


@dataclass(frozen=True)
class Planned:
    """Plans of one structure, and what the search for orders was given."""

    assembly: Assembly
    cell: Cell
    as_found: RobotPlan
    """In the order that was found for one arm at a time."""
    better: RobotPlan
    graph: KeyframeGraph
    root: Node
    chain: list[Edge]


@pytest.fixture(scope="module", params=["bridge", "slab"])
def planned(request: pytest.FixtureRequest, cell_of: Callable[..., Cell]) -> Planned:
    """A beam that is handed over among blocks that either arm may take at any time; a slab put down beside tiles."""
    if request.param == "bridge":
        assembly, cell = bridge_with(spares=1), cell_of(2, 1.5)
    else:
        assembly, cell = slab(tiles=2), tabled(cell_of(2))
    task = Task.from_rules(assembly.boundary, 2, identity=assembly.identity, allow_regrasp=True)
    given: list[Any] = []
    as_found: list[RobotPlan] = []

    def ordered(graph, oracle, root, chain, timed, **more):
        given[:] = [graph, root, list(chain)]
        plan = make_robot_plan(assembly, cell, task, oracle, root, chain, timed=dict(timed))
        as_found[:] = [schedule_plan(plan, assembly, cell)]
        return reorder(graph, oracle, root, chain, timed, **more)

    settings = HybridSettings(Direction.DISASSEMBLY, attempts=4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hybrid_search, "reorder", ordered)
        better = plan_robots(assembly, cell, task=task, settings=settings, concurrent=True).value
    assert better is not None
    return Planned(assembly, cell, as_found[0], better, *given)


def fixed(plan: RobotPlan) -> list[tuple[int, str]]:
    """Robots and words of the steps that stay with their arms, in order."""
    steps = enumerate(plan.steps)
    return [(s.robot, plan.does(k)) for k, s in steps if s.hands_over is not None or s.put_down is not None]


def test_the_steps_around_get_a_shorter_order(planned: Planned) -> None:
    better, as_found = planned.better, planned.as_found
    assert better.makespan < 0.9 * as_found.makespan
    assert fixed(better) == fixed(as_found) != []
    assert sorted(better.plan.actions) == sorted(as_found.plan.actions)
    assert list(better.plan.actions) != list(as_found.plan.actions)
    halves = [k for k, step in enumerate(better.steps) if step.hands_over is not None]
    assert [leave - take for take, leave in zip(halves[::2], halves[1::2], strict=True)] == [1] * (len(halves) // 2)


def test_all_proofs_hold_in_the_new_order(planned: Planned) -> None:
    """The independent check, the order of events under all delays, and delayed runs, forwards and in reverse."""
    for plan in (planned.better, schedule_plan(planned.better.reverse(), planned.assembly, planned.cell)):
        report = check_robot_plan(plan, planned.assembly, planned.cell)
        assert report.good, [str(problem) for problem in report.problems]
        assert plan.schedule is not None
        assert (np.diff(event_times(plan, plan.schedule)) >= 0).all()
        assert simulate(plan, runs=100).good


def test_motions_are_proven_in_the_scenes_that_they_were_planned_in(planned: Planned) -> None:
    """In the old order the queries of every free motion are those of the planner: lying parts are where they lie."""
    node = planned.root
    for edge in planned.chain:
        for segment, view in zip(edge.segments, views(planned.graph, node, edge), strict=True):
            if segment.kind == "free":
                assert segment.view is not None
                assert_equal_arrays(view, segment.view)
        assert lies_free(planned.graph, node, edge)
        node = edge.node


def assert_equal_arrays(one: CollisionQuery, other: CollisionQuery) -> None:
    """Assert that two queries are about the same moving bodies and the same obstacles."""
    for mine, its in zip(one.arrays[1:4], other.arrays[1:4], strict=True):
        for a, b in zip(mine, its, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("planned", ["slab"], indirect=True)
def test_a_part_is_not_put_down_where_something_stands(planned: Planned) -> None:
    number, edge = next((k, edge) for k, edge in enumerate(planned.chain) if edge.put_down is not None)
    node = planned.chain[number - 1].node
    in_place = replace(edge, put_down=np.eye(4))
    assert not lies_free(planned.graph, node, in_place)
    chain = [*planned.chain[:number], in_place, *planned.chain[number + 1 :]]
    assert follow(planned.graph, planned.root, chain, {}) == number


def test_grippers_hold_one_part_and_hand_it_over_at_once() -> None:
    """Two arms, of which the first holds part 0; which steps may come next, before, within and after a hand-over."""
    state = np.array([HELD, INSTALLED, INSTALLED], dtype=np.uint8)
    begin = Node(state, (np.zeros(1), np.zeros(1)), (0, None))

    def allowed(node: Node) -> set[tuple[str, int, int]]:
        edges = {
            (kind, part, robot): Edge(part + 3 * (kind == "remove"), robot, (), node, kind == "hand over")
            for kind in ("hold or release", "remove", "hand over")
            for part in (0, 1)
            for robot in (0, 1)
        }
        return {name for name, edge in edges.items() if grippers_allow(node, edge)}

    assert allowed(begin) == {
        ("hold or release", 0, 0),
        ("remove", 0, 0),
        ("hold or release", 1, 1),
        ("hand over", 0, 1),
    }
    within = begin.after(0, 1, np.ones(1))
    assert within.held == (0, 0)
    assert allowed(within) == {("hand over", 0, 0)}
    after = within.after(0, 0, np.full(1, 2.0))
    assert after.held == (None, 0)
    assert allowed(after) == {
        ("hold or release", 0, 1),
        ("remove", 0, 1),
        ("hold or release", 1, 0),
        ("hand over", 0, 0),
    }
