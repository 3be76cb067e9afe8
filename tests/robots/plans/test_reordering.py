"""Reordering: other orders of the steps of a plan, and other arms, for robots that move at the same time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework import Assembly, StabilityOracle
from falsework.assembly import complete_state
from falsework.robots import Cell, KeyframeGraph, RobotPlan, Trajectory, schedule_plan
from falsework.robots.interleaving.reordering import follow, reorder, views
from falsework.robots.interleaving.search import OrderSearch
from falsework.robots.interleaving.work import Work
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment
from falsework.robots.keyframes.trajectory_assembly import make_robot_plan
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.planning.initial_keyframe import task_in_cell
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.robots.schedule.conflicts import Itineraries, choices, fixed_precedences
from falsework.robots.schedule.solver import solve


class Case:
    """Cubes that one of two arms takes, from the left to the right."""

    def __init__(self, assembly: Assembly, cell: Cell) -> None:
        """Plan the motions."""
        self.assembly, self.cell, self.oracle = assembly, cell, StabilityOracle(assembly)
        self.graph = KeyframeGraph(assembly, cell)
        self.task = task_in_cell(assembly, cell, None, self.graph.exits, self.oracle)
        self.legal = SolvabilityCheck(assembly, self.task, self.oracle).legal
        self.root = self.graph.start(complete_state(assembly.boundary), cell.homes, (None, None))
        self.chain: list[Edge] = []
        self.timed: dict[PathSegment, Trajectory | None] = {}
        for part in np.flatnonzero(~assembly.boundary).tolist():
            for action in (part, part + assembly.part_count):
                edges = self.graph.holds(self.node, part, 0) if action == part else self.graph.edges(self.node, action)
                self.chain.append(next(edges))

    @property
    def node(self) -> Node:
        """The last keyframe."""
        return self.chain[-1].node if self.chain else self.root

    def search(self, *, builds: bool = False) -> OrderSearch:
        """Return a search for a better order, in which the structure is taken apart or built."""
        given = {"legal": self.legal, "stop": lambda: False, "builds": builds}
        return OrderSearch(Work(self.graph, dict(self.timed)), self.oracle, self.root, self.chain, **given)

    def reordered(self, stop: bool = False) -> list[Edge]:
        """Return the edges in a better order."""
        return reorder(self.graph, self.oracle, self.root, self.chain, self.timed, legal=self.legal, stop=lambda: stop)

    def plan(self, chain: list[Edge]) -> RobotPlan:
        """Return the plan of some edges, with a schedule."""
        plan = make_robot_plan(self.assembly, self.cell, self.task, self.oracle, self.root, chain, forces=False)
        return schedule_plan(plan, self.assembly, self.cell)


@pytest.fixture(scope="module")
def case(make_boxes: Callable[..., Assembly], cell_of: Callable[..., Cell]) -> Case:
    """Four cubes in a row between two arms."""
    row = make_boxes((-0.45, -0.1, 0.0), (-0.2, -0.1, 0.0), (0.05, -0.1, 0.0), (0.3, -0.1, 0.0))
    return Case(row, cell_of(2, 1.3))


def test_another_arm_takes_some_parts(case: Case) -> None:
    before, chain = case.plan(case.chain), case.reordered()
    after = case.plan(chain)
    assert {edge.robot for edge in case.chain} == {0}
    assert {edge.robot for edge in chain} == {0, 1}
    assert sorted(edge.action for edge in chain) == sorted(edge.action for edge in case.chain)
    assert after.makespan < 0.8 * before.makespan


def test_an_arm_takes_a_part_of_another_one_that_holds_something(case: Case) -> None:
    search = case.search()
    holding, unit = search.best[1], search.units[-1]
    assert holding.node.held == (search.units[0].part, None)
    assert search.next.step(holding, 0, unit, 0) is None
    step = search.next.step(holding, 1, unit, 0)
    assert step is not None
    assert (step.unit.robot, step.unit.part) == (1, unit.part)


@pytest.mark.parametrize("builds", [False, True])
def test_the_end_of_an_order_is_that_of_a_schedule(case: Case, builds: bool) -> None:
    """As the plan is executed, with the earlier of two motions in conflict first in the order of disassembly."""
    search = case.search(builds=builds)
    planned = search.best[-1]
    assert planned.end == pytest.approx(sum(sum(unit.seconds) for unit in search.units))  # one arm never waits
    search.run()
    assert search.changed
    assert search.best[-1].end < planned.end
    ends = [max(partial.free) for partial in search.best]
    assert all(early <= late for early, late in pairwise(ends))
    chain = follow(case.graph, case.root, [step.edge for step in search.best[-1].steps], {})
    assert not isinstance(chain, int)
    plan = case.plan(chain)
    rows = Itineraries(plan.reverse() if builds else plan, CollisionWorld(case.cell, case.graph.parts))
    fixed, found = fixed_precedences(rows), choices(rows)
    ordered = [replace(choice, orders=_only(choice.orders, choice.planned)) for choice in found]
    assert solve(rows.nodes, fixed, ordered, 2).makespan == pytest.approx(search.best[-1].end, abs=0.02)
    # The solver may choose either of them to go first, so its schedule is no longer.
    assert solve(rows.nodes, fixed, found, 2).makespan <= search.best[-1].end + 1e-3


def _only(orders: tuple, planned: int) -> tuple:
    """Return the ways to decide a conflict without the one that is not planned."""
    return tuple(way if k == planned else None for k, way in enumerate(orders))


def test_the_same_plan_leads_to_the_same_order(case: Case) -> None:
    one, other = case.reordered(), case.reordered()
    assert [(edge.action, edge.robot) for edge in one] == [(edge.action, edge.robot) for edge in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.node.configurations, b.node.configurations)


def test_motions_get_the_scene_of_their_new_place(case: Case) -> None:
    """They are shortened in it afterwards; lines are not, since they keep to an exit direction."""
    node = case.root
    for edge in case.reordered():
        for segment, view in zip(edge.segments, views(case.graph, node, edge), strict=True):
            assert segment.view is (None if segment.kind == "line" else view)
        node = edge.node


def test_without_time_the_plan_stays(case: Case) -> None:
    search = case.search()
    search.stop = lambda: True
    search.run()
    assert [edge.action for edge in case.reordered(stop=True)] == [step.edge.action for step in search.best[-1].steps]


def test_a_window_without_a_better_order_is_not_searched_again(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    search, searched = case.search(), []
    completed = search.completed
    monkeypatch.setattr(search, "completed", lambda *window: searched.append(window[:2]) or completed(*window))
    search.run()
    best = search.order
    searched.clear()
    assert not search.improve(0, 3)
    assert not search.improve(0, 3)
    assert searched == [(0, 3)]
    search.refuse(0)  # that step is excluded, so the same window may lead elsewhere
    search.take(best)
    search.improve(0, 3)
    assert len(searched) > 1


def test_steps_whose_motions_fail_are_not_taken_there_again(case: Case) -> None:
    search = case.search()
    search.run()
    index = next(k for k, step in enumerate(search.best[-1].steps) if step.unit.robot == 1)
    step, state = search.best[-1].steps[index], search.best[index].node.state
    search.refuse(index)
    assert not search.changed
    search.run()
    again = zip(search.best, search.best[-1].steps, strict=False)
    assert not any(taken.unit is step.unit and (at.node.state == state).all() for at, taken in again)


def test_a_search_that_goes_on_never_ends_with_a_worse_order(case: Case) -> None:
    search = case.search()
    search.run(0)
    first = search.cost
    assert sorted(step.action for step in search.best[-1].steps) == sorted(edge.action for edge in case.chain)
    search.run(1)
    assert search.cost <= first


def test_an_order_that_may_be_worse_is_a_new_one(case: Case) -> None:
    search = case.search()
    orders = [search.best[-1]]
    while len(orders) < 20 and search.improve(0, 8, worse=1.0):
        orders.append(search.best[-1])
    assert len(orders) > 1
    assert len({tuple((step.action, step.unit.robot) for step in order.steps) for order in orders}) == len(orders)


def test_a_fallen_replay_excludes_its_history_alone(case: Case) -> None:
    search = case.search()
    order = search.best[-1]
    last = tuple(step.edge.action for step in order.steps[-3:])
    assert search.allows(order)
    search.fallen.add(last[::-1])
    assert search.allows(order)
    search.fallen.add(last)
    assert not search.allows(order)


def test_parts_below_others_stay_until_these_have_left(
    make_boxes: Callable[..., Assembly], cell_of: Callable[..., Cell]
) -> None:
    stacks = make_boxes((-0.3, -0.1, 0.2), (0.1, -0.1, 0.2), (-0.3, -0.1, 0.0), (0.1, -0.1, 0.0))
    case = Case(stacks, cell_of(2, 1.3))
    chain = case.reordered()
    free = np.flatnonzero(~stacks.boundary)
    states = np.array([edge.node.state for edge in chain])
    assert case.oracle.verdicts(states).stable.all()
    for top, bottom in ((free[0], free[2]), (free[1], free[3])):
        order = [edge.action for edge in chain]
        assert order.index(top + stacks.part_count) < order.index(bottom + stacks.part_count)
