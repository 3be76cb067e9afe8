"""Diverse plans: distances between plans, and selection of the most different ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, States
from falsework.errors import InputError
from falsework.search.problem.hashing import chunks
from falsework.search.problem.result import Route, Stop
from falsework.search.problem.state_graph import StateGraph

_WEIGHT_CHANGES = 12
"""Changes of weights for each choice."""


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Routes of one task and the distances between them."""

    routes: tuple[Route, ...]
    order_distance: NDArray[np.float64]
    """Kendall distance of the orders of removal: share of pairs of parts that leave in another order, (k, k)."""
    state_distance: NDArray[np.float64]
    """Jaccard distance of the sets of states on the paths: 1 - common / all, (k, k)."""

    @classmethod
    def from_routes(cls, routes: Sequence[Route]) -> Alternatives:
        """Measure given routes of one task against each other."""
        order = np.zeros((len(routes), len(routes)))
        states = np.zeros_like(order)
        for i, a in enumerate(routes):
            for j, b in enumerate(routes[:i]):
                order[i, j] = order[j, i] = order_distance(a, b)
                states[i, j] = states[j, i] = state_distance(a, b)
        return cls(tuple(routes), order, states)

    def keep(self, rows: Sequence[int]) -> Alternatives:
        """Return some of the routes."""
        chosen = np.ix_(rows, rows)
        return Alternatives(
            tuple(self.routes[k] for k in rows), self.order_distance[chosen], self.state_distance[chosen]
        )

    @property
    def distance(self) -> NDArray[np.float64]:
        """Mean of both distances, between 0 (the same plan) and 1, shape (k, k)."""
        return (self.order_distance + self.state_distance) / 2

    @property
    def least_distance(self) -> float:
        """Distance between the two plans that differ least; 1 for a single plan."""
        others = ~np.eye(len(self.routes), dtype=bool)
        return float(self.distance[others].min()) if others.any() else 1.0


def order_distance(a: Route, b: Route) -> float:
    """Return the Kendall distance: share of pairs of removed parts in another order, between 0 and 1."""
    rank_a, rank_b = a.removal_rank(), b.removal_rank()
    removed = np.flatnonzero((rank_a >= 0) & (rank_b >= 0))
    pairs = len(removed) * (len(removed) - 1) // 2
    if pairs == 0:
        return 0.0
    first, second = np.triu_indices(len(removed), 1)
    order_a, order_b = (np.sign(rank[removed][first] - rank[removed][second]) for rank in (rank_a, rank_b))
    return float((order_a != order_b).sum() / pairs)


def state_distance(a: Route, b: Route) -> float:
    """Return the Jaccard distance of the sets of states of the routes, between 0 and 1."""
    one, two = ({state.tobytes() for state in route.states} for route in (a, b))
    return 1.0 - len(one & two) / len(one | two)


def choose_alternatives(
    graph: StateGraph,
    count: int,
    *,
    given: Sequence[Route] = (),
    seed: int = 0,
    stop: Stop | None = None,
) -> Alternatives:
    """Choose routes of a state graph so that the two most similar ones differ as much as possible.

    Both distances to a given route are sums over the edges of another (a removal of `j` inverts as many pairs as parts
    are still present that the given route removes before `j`), so the route that is farthest from several given ones,
    by a weighted sum, is found exactly by dynamic programming over the levels of the graph. The weights are raised
    on the nearest of the given routes in turn (multiplicative weights), which aims at the least distance instead of
    the sum. Routes are added this way one by one, and then each is chosen anew against the rest until nothing improves.

    Args:
        graph: where the routes run.
        count: number of routes to choose.
        given: routes of the task to begin with; a random one if there is none.
        seed: breaks ties.
        stop: called before every choice; true returns the routes chosen so far.

    Returns:
        At most `count` different routes; fewer if no more were found, none if the graph has none.

    Raises:
        InputError: `count` below one.
    """
    if count < 1:
        raise InputError(f"{count} alternatives is not a number of plans; ask for at least 1")
    rng = np.random.default_rng(seed)
    routes = list({route.states.tobytes(): route for route in given}.values())[:count]
    if not routes:
        random = graph.sample_route(rng)
        if random is None:
            return Alternatives.from_routes([])
        routes = [random]
    chooser = _Farthest(graph, rng)
    stop = stop or (lambda: False)
    while len(routes) < min(count, graph.count_routes()) and not stop():
        route = chooser.from_all(routes)
        if route is None:
            break
        routes.append(route)
    best = Alternatives.from_routes(routes)
    improved = len(routes) > 1
    while improved:
        improved = False
        for place in range(len(routes)):
            if stop():
                return best
            others = routes[:place] + routes[place + 1 :]
            route = chooser.from_all(others)
            if route is None:
                continue
            trial = Alternatives.from_routes([*routes[:place], route, *routes[place + 1 :]])
            if _spread(trial) > _spread(best):
                routes[place], best, improved = route, trial, True
    return best


def _spread(alternatives: Alternatives) -> tuple[float, float]:
    """Return the least distance, and the sum of all as a tie-break; rounded, so that improvement terminates."""
    return round(alternatives.least_distance, 6), round(float(alternatives.distance.sum()), 6)


def _pairs_changed(rank: NDArray[np.int64], states: States) -> int:
    """Return how many pairs leave in another order than their ranks say, by a step between two states.

    These are pairs of parts that leave with it, and of one that does and one that stays longer.

    Args:
        rank: of each part, -1 if it stays, shape (parts,).
        states: before and after, shape (2, parts).
    """
    before, after = ((state != REMOVED) & (rank >= 0) for state in states)
    leaving, staying = rank[before & ~after], rank[after]
    inside = (leaving[:, None] != leaving).sum() // 2
    return int(inside + (staying[:, None] <= leaving).sum())


class _Farthest:
    """Solver for the route of a graph that is farthest from given ones."""

    def __init__(self, graph: StateGraph, rng: np.random.Generator) -> None:
        useful = graph.solvable[graph.target] & graph.reachable[graph.source]
        self._graph = graph
        self._levels = [np.arange(edges.start, edges.stop)[useful[edges]] for edges in graph.edges_by_level()]
        self._rng = rng
        self._gains: dict[bytes, NDArray[np.float32]] = {}

    def from_all(self, routes: Sequence[Route]) -> Route | None:
        """Return the route farthest from the nearest of `routes`, or None where every route tried is one of them."""
        gains = np.stack([self._gain(route) for route in routes]).astype(np.float64)
        weight = np.full(len(routes), 1.0 / len(routes))
        best, best_distance = None, 0.0
        for _ in range(_WEIGHT_CHANGES):
            route = self._best_route(weight @ gains)
            distance = np.array([(order_distance(route, r) + state_distance(route, r)) / 2 for r in routes])
            if distance.min() > best_distance:
                best, best_distance = route, float(distance.min())
            if len(routes) == 1 and best is not None:
                break
            weight *= np.exp(-4.0 * (distance - distance.min()))
            weight /= weight.sum()
        return best or self._random_other(routes)

    def _random_other(self, routes: Sequence[Route]) -> Route | None:
        """Return any other route; needed only in graphs so small that the farthest ones are taken."""
        known = {route.states.tobytes() for route in routes}
        for _ in range(len(self._graph)):
            route = self._graph.sample_route(self._rng)
            if route is not None and route.states.tobytes() not in known:
                return route
        return None

    def _gain(self, route: Route) -> NDArray[np.float32]:
        """Return the contribution of each edge to the distance from `route`, shape (edges,)."""
        key = route.states.tobytes()
        if key in self._gains:
            return self._gains[key]
        graph, parts = self._graph, self._graph.task.part_count
        rank = route.removal_rank()
        removed = int((rank >= 0).sum())
        gain = np.zeros(len(graph.source), dtype=np.float32)
        if removed > 1:
            removals = np.flatnonzero(graph.action >= parts)
            for piece in chunks(len(removals)):
                edges = removals[piece]
                part = graph.action[edges] - parts
                present = (graph.states[graph.source[edges]] != REMOVED) & (rank >= 0)
                gain[edges] = (present & (rank < rank[part][:, None])).sum(axis=1)
            for edge in removals[graph.level[graph.target[removals]] > graph.level[graph.source[removals]] + 1]:
                gain[edge] = _pairs_changed(rank, graph.states[[graph.source[edge], graph.target[edge]]])
            gain /= removed * (removed - 1) / 2
        gain -= self._on_route(route.states)[graph.target] / len(route.states)
        self._gains[key] = gain
        return gain

    def _on_route(self, states: States) -> NDArray[np.bool_]:
        marked = np.zeros(len(self._graph), dtype=bool)
        found = self._graph.index.find(states)
        marked[found[found >= 0]] = True
        return marked

    def _best_route(self, gain: NDArray[np.float64]) -> Route:
        graph = self._graph
        # Noise far below the smallest real difference picks among equals.
        gain = gain + 1e-9 * self._rng.random(len(gain))
        value = np.zeros(len(graph))
        choice = np.full(len(graph), -1, dtype=np.int64)
        for edges in reversed(self._levels):
            total = gain[edges] + value[graph.target[edges]]
            order = np.lexsort((total, graph.source[edges]))
            source = graph.source[edges][order]
            last = np.flatnonzero(np.append(source[1:] != source[:-1], True)) if len(source) else order
            value[source[last]] = total[order[last]]
            choice[source[last]] = edges[order[last]]
        row = int(graph.index.find(graph.task.start[None])[0])
        rows, actions = [row], []
        while (edge := choice[row]) >= 0:
            actions.append(graph.action[edge])
            row = int(graph.target[edge])
            rows.append(row)
        return Route(graph.states[rows], np.array(actions, dtype=np.int64))
