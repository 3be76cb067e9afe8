"""A beam that two arms must hold in turn, since each reaches one of the two blocks below it only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, StabilityOracle, Task, plan_robots
from falsework.assembly import HELD, REMOVED, complete_state
from falsework.robots import Cell, HybridSettings, KeyframeGraph, RobotPlan, nodes_of
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import event_times
from falsework.search.plans.plan_check import validate_plan
from tests.robots.plans.beam_in_turn import BEAM, LEFT, RIGHT, bridge_with


@pytest.fixture(scope="module")
def bridge() -> Assembly:
    """The beam and its blocks alone."""
    return bridge_with()


@pytest.fixture(scope="module")
def apart(cell_of: Callable[..., Cell]) -> Cell:
    """Two arms, of which each reaches the beam and the block on its own side."""
    return cell_of(2, 1.5)


def planned(assembly: Assembly, cell: Cell, *, allow_regrasp: bool) -> HybridResult:
    task = Task.from_rules(assembly.boundary, 2, identity=assembly.identity, allow_regrasp=allow_regrasp)
    return plan_robots(assembly, cell, task=task, settings=HybridSettings(Direction.DISASSEMBLY, attempts=4))


@pytest.fixture(scope="module")
def plan(bridge: Assembly, apart: Cell) -> RobotPlan:
    """A plan in which one arm hands the beam to the other."""
    found = planned(bridge, apart, allow_regrasp=True).value
    assert found is not None
    return found


@pytest.fixture(scope="module")
def timed(bridge: Assembly, apart: Cell) -> RobotPlan:
    """The same for arms that move at the same time."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

    task = Task.from_rules(bridge.boundary, 2, identity=bridge.identity, allow_regrasp=True)
    settings = HybridSettings(Direction.DISASSEMBLY, attempts=4)
    found = plan_robots(bridge, apart, task=task, settings=settings, concurrent=True).value
    assert found is not None
    assert halves(found)
    return found


def halves(plan: RobotPlan) -> list[int]:
    """The steps of hand-overs."""
    return [index for index, step in enumerate(plan.steps) if step.hands_over is not None]


def test_without_a_hand_over_there_is_no_plan(bridge: Assembly, apart: Cell) -> None:
    """Each block needs the arm of its side, and while one leaves the beam must be held: by the other arm."""
    assert planned(bridge, apart, allow_regrasp=False).value is None
    graph, oracle, complete = KeyframeGraph(bridge, apart), StabilityOracle(bridge), complete_state(bridge.boundary)
    for gone in ((), (LEFT,), (RIGHT,)):
        state = complete.copy()
        state[list(gone)] = REMOVED
        assert not len(graph.exits.free(BEAM, state))
        for arm, far in ((0, RIGHT), (1, LEFT)):
            assert far in gone or not graph.grips(arm, far, state)
        if gone:
            (other,) = {LEFT, RIGHT} - set(gone)
            for held in ([], [other]):
                state[held] = HELD
                assert not oracle.verdicts(state[None]).stable[0]
            state[other], state[BEAM] = complete[other], HELD
            assert oracle.verdicts(state[None]).stable[0]


def test_one_arm_hands_the_beam_to_the_other(plan: RobotPlan, bridge: Assembly, apart: Cell) -> None:
    take, leave = halves(plan)
    assert leave == take + 1
    giver, taker = plan.steps[leave].robot, plan.steps[take].robot
    assert giver != taker
    assert [frame.held[giver] for frame in plan.keyframes[take : take + 3]] == [BEAM, BEAM, None]
    assert [frame.held[taker] for frame in plan.keyframes[take : take + 3]] == [None, BEAM, BEAM]
    assert (plan.states[take] == plan.states[take + 2]).all()
    assert [plan.grip(take), plan.grip(leave)] == ["close", "open"]
    assert plan.does(take) == f"take beam-0 over from {apart.robots[giver].name}"
    assert plan.does(leave) == f"leave beam-0 to {apart.robots[taker].name}"
    assert len(plan) == len(plan.plan) + 2
    report = check_robot_plan(plan, bridge, apart)
    assert report.good, [str(problem) for problem in report.problems]
    assert validate_plan(plan.plan, bridge).good


def test_no_delay_changes_the_order(timed: RobotPlan, bridge: Assembly, apart: Cell) -> None:
    from falsework.robots import schedule_plan, simulate

    for one in (timed, timed.reverse(), schedule_plan(timed.reverse(), bridge, apart)):
        graph = one.schedule
        assert graph is not None
        assert (np.diff(event_times(one, graph)) >= 0).all()
        report = check_robot_plan(one, bridge, apart)
        assert report.good, [str(problem) for problem in report.problems]
        assert simulate(one, runs=100).good
        events = nodes_of(one)[1]
        for take, leave in pairwise(halves(one)):
            before, after = events[take].node, events[leave].node
            kept = tuple(edge for edge in graph.edges if (edge.before, edge.after) != (before, after))
            assert len(kept) < len(graph.edges)
            loose = replace(one, schedule=TemporalPlanGraph(graph.nodes, kept, graph.robots, 0.0))
            report = check_robot_plan(loose, bridge, apart)
            assert any("does not wait for the state" in problem.what for problem in report.problems)
