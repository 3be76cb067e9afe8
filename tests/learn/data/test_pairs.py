"""Pairs of start and target: every one is a task that the rules accept, and the actions given lead to its target."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, Direction, StateGraph, Task  # noqa: E402
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


def test_valid_actions_are_all_that_lead_to_the_target_inside_the_graph(bottle_graph: StateGraph) -> None:
    pairs = PairSource(bottle_graph).draw(60, np.random.default_rng(0))
    assert len(pairs) == 60
    for state, target, valid in zip(pairs.states, pairs.targets, pairs.valid, strict=True):
        row, end = (int(bottle_graph.index.find(one[None])[0]) for one in (state, target))
        assert row != end
        expected = {
            action for action, after in successors(bottle_graph, row).items() if end in reachable(bottle_graph, after)
        }
        assert set(np.flatnonzero(valid).tolist()) == expected
        assert expected


def test_valid_actions_are_legal_for_their_task(bottle: Assembly, bottle_graph: StateGraph) -> None:
    """Also with the rule that the last free robot is not spent on a part that stays held."""
    pairs = PairSource(bottle_graph).draw(3000, np.random.default_rng(1))
    for state, target, valid in zip(pairs.states[:300], pairs.targets[:300], pairs.valid[:300], strict=True):
        task = Task.from_rules(bottle.boundary, 2, start=state, target=target)
        assert task.moves(state[None], Direction.DISASSEMBLY)[0][valid].all()
    environment = Environment(bottle, 2, device="cpu")
    states, targets, valid = pairs.tensors(environment.device)
    assert (environment.rules.moves(states, targets) | ~valid).all()
    assert environment.rules.contains(states, targets).all()
    assert environment.stable(states).all()


def test_forbidden_states_are_in_no_pair(bottle_graph: StateGraph) -> None:
    rng = np.random.default_rng(2)
    held_out = bottle_graph.states[rng.permutation(len(bottle_graph))[: len(bottle_graph) // 2]]
    pairs = PairSource(bottle_graph, held_out=held_out).draw(2000, rng)
    index = StateIndex(np.unique(held_out, axis=0))
    assert len(pairs) == 2000
    assert (index.find(pairs.states) < 0).all()
    assert (index.find(pairs.targets) < 0).all()
    with pytest.raises(InputError, match="no path connects two states of this graph"):
        PairSource(bottle_graph, held_out=bottle_graph.states)


def test_same_seed_same_pairs(bottle_graph: StateGraph) -> None:
    one, two = (PairSource(bottle_graph).draw(100, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.states, two.states)
    assert np.array_equal(one.targets, two.targets)
