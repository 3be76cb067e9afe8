"""Temporal plan graphs: times, delays, cycles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework.errors import InputError, PlanError
from falsework.robots import Precedence
from falsework.robots.plans.temporal_graph import MotionNode, TemporalPlanGraph

NODES = (MotionNode(0, 0, 0, 2.0), MotionNode(1, 1, 0, 3.0), MotionNode(0, 2, 0, 1.0))
EDGES = (Precedence(0, 2.0, 2, "arm"), Precedence(0, 0.5, 1, "volume"), Precedence(1, 1.0, 2, "state"))


@pytest.fixture
def graph() -> TemporalPlanGraph:
    return TemporalPlanGraph(NODES, EDGES, 2, 3.0)


def test_times_follow_from_the_precedences(graph: TemporalPlanGraph) -> None:
    assert graph.starts().tolist() == [0.0, 0.5, 2.0]
    assert graph.makespan == 3.5
    assert graph.sequential == 6.0
    # The second motion delays the third only once it takes so long that its first second ends after the first motion.
    assert graph.starts([1.0, 2.0, 1.0]).tolist() == [0.0, 0.5, 2.5]


def test_the_gap_is_the_share_above_the_lower_bound(graph: TemporalPlanGraph) -> None:
    assert replace(graph, lower_bound=0.8 * graph.makespan).gap == pytest.approx(0.2)
    assert replace(graph, lower_bound=graph.makespan).gap == 0.0
    assert TemporalPlanGraph((), (), 2, 0.0).gap == 0.0


def test_an_arm_that_is_late_makes_nothing_earlier(graph: TemporalPlanGraph) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        stretch = 1 + rng.random(3)
        assert (graph.starts(stretch) >= graph.starts()).all()


def test_reversed_graphs_keep_every_order(graph: TemporalPlanGraph) -> None:
    back = graph.reverse()
    assert [node.seconds for node in back.nodes] == [1.0, 3.0, 2.0]
    assert back.makespan == 6.0  # what overlapped by a part of a motion waits for all of it


def test_only_the_work_of_an_arm_bounds_both_directions() -> None:
    """The end of one motion is in the way of the other: that costs its arm a wait in one direction only."""
    nodes = (MotionNode(0, 0, 0, 4.0), MotionNode(1, 1, 0, 3.0))
    there = TemporalPlanGraph(nodes, (Precedence(0, 3.5, 1, "volume"),), 2, 6.5)
    back = TemporalPlanGraph(there.reverse().nodes, (Precedence(0, 0.5, 1, "volume"),), 2, 4.5)
    assert there.makespan == 6.5
    assert there.reverse().lower_bound <= back.makespan == 4.5
    assert there.reverse().lower_bound == 4.0
    assert TemporalPlanGraph((), (), 2, 0.0).reverse().lower_bound == 0.0


@pytest.mark.parametrize("stretch", [[0.5, 1, 1], [np.nan, 1, 1], [np.inf, 1, 1], [1, 1]])
def test_delays_that_are_none(graph: TemporalPlanGraph, stretch: list[float]) -> None:
    with pytest.raises(InputError, match="finite and not negative"):
        graph.starts(stretch)


@pytest.mark.parametrize(
    ("edge", "message"),
    [
        (Precedence(2, 0.0, 0, "volume"), "in a cycle"),
        (Precedence(0, 5.0, 1, "volume"), "into a motion that is shorter"),
        (Precedence(0, 0.0, 9, "volume"), "names motion 9"),
    ],
)
def test_graphs_that_are_none(edge: Precedence, message: str) -> None:
    with pytest.raises(PlanError, match=message):
        TemporalPlanGraph(NODES, (*EDGES, edge), 2, 0.0)
