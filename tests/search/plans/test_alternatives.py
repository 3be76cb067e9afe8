"""Distances against SciPy, and the choice of different plans against all that there are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import kendalltau

from falsework import Direction, StateGraph, Task
from falsework.errors import InputError
from falsework.search import ExhaustiveSearch
from falsework.search.plans.alternatives import Alternatives, choose_alternatives, order_distance, state_distance
from falsework.search.problem.guide import NoveltyGuide
from falsework.search.problem.result import Route


def full_graph(rules: Any, seed: int, parts: int, robots: int = 2) -> StateGraph:
    oracle, _ = rules.random(seed, parts)
    return ExhaustiveSearch(Task.from_rules(rules.ground(parts), robots), oracle).run().graph


def all_routes(rules: Any, graph: StateGraph) -> list[Route]:
    states = {tuple(state) for state in graph.states.tolist()}

    class Known:
        def stands(self, state: tuple[int, ...]) -> bool:
            return state in states

    routes = rules.enumeration(graph.task, Known()).routes()
    return [Route.from_states(np.array(route, dtype=np.uint8)) for route in routes]


@pytest.mark.parametrize("seed", range(10))
def test_order_distance_is_kendalls(rules: Any, seed: int) -> None:
    graph = full_graph(rules, 4, 8)
    rng = np.random.default_rng(seed)
    a, b = graph.sample_route(rng), graph.sample_route(rng)
    assert a is not None
    assert b is not None
    tau = float(np.asarray(kendalltau(a.removal_rank()[1:], b.removal_rank()[1:]))[0])
    assert order_distance(a, b) == pytest.approx((1 - tau) / 2)
    sets = [{tuple(state) for state in route.states.tolist()} for route in (a, b)]
    assert state_distance(a, b) == pytest.approx(1 - len(sets[0] & sets[1]) / len(sets[0] | sets[1]))


def test_distances_are_distances(rules: Any) -> None:
    graph = full_graph(rules, 4, 7)
    rng = np.random.default_rng(0)
    routes = [route for route in (graph.sample_route(rng) for _ in range(12)) if route is not None]
    found = Alternatives.from_routes(routes)
    for matrix in (found.order_distance, found.state_distance, found.distance):
        assert np.array_equal(matrix, matrix.T)
        assert (np.diag(matrix) == 0).all()
        assert ((matrix >= 0) & (matrix <= 1)).all()
        # Triangle inequality, over all triples at once.
        assert (matrix[:, :, None] <= matrix[:, None, :] + matrix[None] + 1e-12).all()


def test_opposite_orders_are_at_distance_one(rules: Any) -> None:
    """Free blocks, one robot: the farthest plan from any plan is its reverse, order distance 1."""
    graph = ExhaustiveSearch(Task.from_rules(rules.ground(7), 1), rules.blocks(7)).run().graph
    chosen = choose_alternatives(graph, 2)
    first, second = chosen.routes
    assert np.array_equal(first.removal_rank()[1:], 5 - second.removal_rank()[1:])
    assert chosen.order_distance[0, 1] == 1.0


@pytest.mark.parametrize("seed", [4, 20, 35, 47, 48])
def test_the_farthest_route_is_found(rules: Any, seed: int) -> None:
    """The second of two is as far from the first as any plan of all."""
    graph = full_graph(rules, seed, 5)
    routes = all_routes(rules, graph)
    assert len(routes) > 1
    first = routes[seed % len(routes)]
    chosen = choose_alternatives(graph, 2, given=[first])
    assert len(chosen.routes) == 2
    farthest = max((order_distance(first, b) + state_distance(first, b)) / 2 for b in routes)
    assert chosen.least_distance >= farthest - 0.02
    assert {route.states.tobytes() for route in chosen.routes} <= {route.states.tobytes() for route in routes}
    a, b = chosen.routes
    assert chosen.least_distance == pytest.approx((order_distance(a, b) + state_distance(a, b)) / 2)


@pytest.mark.parametrize("seed", [1, 4, 6])
def test_better_than_luck(rules: Any, seed: int) -> None:
    """Four chosen plans are farther apart than the best of two hundred random fours."""
    graph = full_graph(rules, seed, 8)
    chosen = choose_alternatives(graph, 4)
    rng = np.random.default_rng(0)
    pool = [route for route in (graph.sample_route(rng) for _ in range(60)) if route is not None]
    measured = Alternatives.from_routes(pool).distance
    luck = 0.0
    for _ in range(200):
        rows = rng.choice(len(pool), 4, replace=False)
        some = measured[np.ix_(rows, rows)]
        luck = max(luck, some[~np.eye(4, dtype=bool)].min())
    assert len(chosen.routes) == 4
    assert chosen.least_distance > luck


def test_no_more_than_there_are(rules: Any) -> None:
    one = ExhaustiveSearch(Task.from_rules(rules.ground(5), 1), rules.tower(5)).run().graph
    assert len(choose_alternatives(one, 5).routes) == 1
    assert choose_alternatives(one, 5).least_distance == 1.0
    six = ExhaustiveSearch(Task.from_rules(rules.ground(4), 1), rules.blocks(4)).run().graph
    chosen = choose_alternatives(six, 10)
    assert len(chosen.routes) == 6
    assert len({route.states.tobytes() for route in chosen.routes}) == 6
    none = ExhaustiveSearch(Task.from_rules(rules.ground(6), 1), rules.arch(6)).run().graph
    assert choose_alternatives(none, 3).routes == ()
    with pytest.raises(InputError, match="at least 1"):
        choose_alternatives(six, 0)


def test_all_alternatives_are_routes_of_the_graph(rules: Any) -> None:
    graph = full_graph(rules, 4, 8)
    known = {route.states.tobytes() for route in all_routes(rules, graph)}
    assert all(route.states.tobytes() in known for route in choose_alternatives(graph, 5).routes)


def test_novelty_counts_inverted_pairs(rules: Any) -> None:
    """Summed over a whole plan, with each score times the parts present, it is the Kendall distance."""
    graph = full_graph(rules, 4, 8)
    rng = np.random.default_rng(3)
    a, b = graph.sample_route(rng), graph.sample_route(rng)
    assert a is not None
    assert b is not None
    guide = NoveltyGuide(None, [a], weight=1.0)
    everything = np.ones((len(b.actions), 16), dtype=bool)
    scores = guide(b.states[:-1], everything, Direction.DISASSEMBLY)[np.arange(len(b.actions)), b.actions]
    present = (b.states[:-1, 1:] != 0).sum(axis=1)
    removals = b.actions >= 8
    assert (scores[~removals] == 0).all()
    assert (scores * present)[removals].sum() == pytest.approx(order_distance(a, b) * 7 * 6 / 2)
