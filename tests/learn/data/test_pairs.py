"""Pairs of start and target: every one is a task that the rules accept, and a path leads to its target."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, StateGraph  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import Environment  # noqa: E402
from falsework.learn.data.goal_pairs import PairSource  # noqa: E402
from falsework.search.problem.hashing import StateIndex  # noqa: E402


def successors(graph: StateGraph, row: int) -> dict[int, int]:
    edges = np.flatnonzero(graph.source == row)
    return {int(graph.action[edge]): int(graph.target[edge]) for edge in edges}


def reachable(graph: StateGraph, row: int) -> set[int]:
    found, todo = {row}, [row]
    while todo:
        for after in successors(graph, todo.pop()).values():
            if after not in found:
                found.add(after)
                todo.append(after)
    return found


def test_a_path_of_the_graph_leads_from_each_start_to_its_target(bottle_graph: StateGraph) -> None:
    pairs = PairSource(bottle_graph).draw(np.random.default_rng(0), 60)
    assert len(pairs) == 60
    for state, target in zip(pairs.states, pairs.targets, strict=True):
        row, end = (int(bottle_graph.index.find(one[None])[0]) for one in (state, target))
        assert row != end
        assert end in reachable(bottle_graph, row)


def test_every_state_with_a_start_is_a_target_once(bottle_graph: StateGraph) -> None:
    source = PairSource(bottle_graph)
    pairs = source.draw(np.random.default_rng(3))
    assert len(pairs) == len(source.ends) == len(np.unique(pairs.targets, axis=0))


def test_pairs_are_tasks_of_the_rules(bottle: Assembly, bottle_graph: StateGraph) -> None:
    """Also with the rule that the last free robot is not spent on a part that stays held."""
    environment = Environment(bottle, 2, device="cpu")
    states, targets = PairSource(bottle_graph).draw(np.random.default_rng(1)).tensors(environment.device)
    assert environment.rules.moves(states, targets).any(dim=1).all()
    assert environment.rules.contains(states, targets).all()
    assert environment.stable(states).all()


def test_forbidden_states_are_in_no_pair(bottle_graph: StateGraph) -> None:
    rng = np.random.default_rng(2)
    held_out = bottle_graph.states[rng.permutation(len(bottle_graph))[: len(bottle_graph) // 2]]
    pairs = PairSource(bottle_graph, held_out=held_out).draw(rng)
    index = StateIndex(np.unique(held_out, axis=0))
    assert len(pairs) > 100
    assert (index.find(pairs.states) < 0).all()
    assert (index.find(pairs.targets) < 0).all()
    with pytest.raises(InputError, match="no path connects two states of this graph"):
        PairSource(bottle_graph, held_out=bottle_graph.states)


def test_same_seed_same_pairs(bottle_graph: StateGraph) -> None:
    one, two = (PairSource(bottle_graph).draw(np.random.default_rng(5), 100) for _ in range(2))
    assert np.array_equal(one.states, two.states)
    assert np.array_equal(one.targets, two.targets)
