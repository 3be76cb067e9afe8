"""Random ways inside a graph: every one is a task, and begins with an action that leads to its target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, Direction, StateGraph  # noqa: E402  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import Environment  # noqa: E402  # noqa: E402
from falsework.learn.data.goal_pairs import PairSource  # noqa: E402
from falsework.learn.data.random_walks import RandomWalkGoals, WalkReach  # noqa: E402
from falsework.search.problem.hashing import StateIndex  # noqa: E402

CPU = torch.device("cpu")


def drawn(ways: RandomWalkGoals, count: int, seed: int = 0) -> tuple[Any, Any, Any]:
    return ways.draw(count, torch.Generator().manual_seed(seed))


def test_the_action_leads_to_the_target_inside_the_graph(bottle_graph: StateGraph) -> None:
    """As the table of what leads where says that `PairSource` makes."""
    graph = bottle_graph
    states, targets, valid = drawn(RandomWalkGoals(graph, device=CPU), 500)
    assert (valid.sum(dim=1) == 1).all()
    ends = graph.index.find(targets.numpy())
    leads = PairSource(graph).leads_to(ends)
    edges = dict(zip(zip(graph.source, graph.action, strict=True), graph.target, strict=True))
    starts, actions = graph.index.find(states.numpy()), valid.numpy().argmax(axis=1)
    after = np.array([edges[edge] for edge in zip(starts, actions, strict=True)])
    column = np.arange(len(ends))
    assert (leads[after, column // 64] >> (column % 64).astype(np.uint64) & np.uint64(1)).all()


def test_actions_are_legal_for_their_task(bottle: Assembly, bottle_graph: StateGraph) -> None:
    environment = Environment(bottle, 2, device="cpu")
    states, targets, valid = drawn(RandomWalkGoals(bottle_graph, device=environment.device), 2000)
    assert (environment.rules.moves(states, targets) | ~valid).all()
    assert environment.rules.contains(states, targets).all()
    assert (environment.rules.steps_left(states, targets) > 0).all()


def steps_of(graph: StateGraph, count: int) -> tuple[Any, Any, Any]:
    """Rows of starts and of targets, and steps from one to the other, of some ways."""
    states, targets, _ = drawn(RandomWalkGoals(graph, device=CPU), count)
    starts, ends = graph.index.find(states.numpy()), graph.index.find(targets.numpy())
    return starts, ends, graph.level[ends] - graph.level[starts]


@pytest.mark.parametrize("direction", [Direction.DISASSEMBLY, Direction.ASSEMBLY])
def test_ways_are_long_whichever_way_was_searched(
    bottle: Assembly, searched_graph: Callable[..., StateGraph], direction: Direction
) -> None:
    """Walks against the grain of a search end after a few steps, and most ways would have one or two."""
    graph = searched_graph(bottle, 12, direction)
    _, _, steps = steps_of(graph, 20_000)
    even = np.arange(1, graph.task.steps)  # a way from a level drawn evenly to a level drawn evenly beyond it
    weights = 1.0 / even[:, None] * (even[None] <= even[:, None])
    share_long = (weights.sum(axis=0) / len(even))[even > graph.task.steps / 3].sum()
    assert (steps > graph.task.steps / 3).mean() > 0.8 * share_long
    assert steps.max() >= graph.task.steps - 1


def test_every_state_that_is_on_a_way_is_met(bottle_graph: StateGraph) -> None:
    graph = bottle_graph
    ways = RandomWalkGoals(graph, device=CPU)
    assert ways.ends == len(graph)
    starts, ends, steps = steps_of(graph, 100 * len(graph))
    assert (steps > 0).all()
    assert len(np.unique(np.concatenate([starts, ends]))) == len(graph)


def test_walks_go_as_far_as_walks_one_by_one(bottle_graph: StateGraph) -> None:
    """Mean and longest walk on from each state, against a walk through dictionaries."""
    graph = bottle_graph
    after: dict[int, list[int]] = {}
    for source, target in zip(graph.source.tolist(), graph.target.tolist(), strict=True):
        after.setdefault(source, []).append(target)
    mean, longest = {}, {}
    for row in reversed(range(len(graph))):
        there = after.get(row, [])
        mean[row] = 1.0 + sum(mean[one] for one in there) / len(there) if there else 0.0
        longest[row] = 1 + max(longest[one] for one in there) if there else 0
    levels = graph.edges_by_level()[::-1]
    reach = WalkReach.over(levels, graph.source, graph.target, np.ones(len(graph), dtype=bool))
    np.testing.assert_allclose(reach.mean, [mean[row] for row in range(len(graph))], rtol=1e-12)
    assert reach.longest.tolist() == [longest[row] for row in range(len(graph))]
    assert reach.meets.tolist() == [row in after for row in range(len(graph))]


def test_forbidden_states_are_neither_start_nor_target(bottle_graph: StateGraph) -> None:
    """Ways lead through them all the same, so that few ways are lost."""
    graph = bottle_graph
    rng = np.random.default_rng(2)
    held_out = graph.states[rng.permutation(len(graph))[: len(graph) // 2]]
    states, targets, valid = drawn(RandomWalkGoals(graph, device=CPU, held_out=held_out), 2000)
    assert len(states) == len(targets) == len(valid) == 2000
    index = StateIndex(held_out)
    assert (index.find(states.numpy()) < 0).all()
    assert (index.find(targets.numpy()) < 0).all()
    with pytest.raises(InputError, match="no path connects two states of this graph"):
        RandomWalkGoals(graph, device=CPU, held_out=graph.states)


def test_same_seed_same_ways(bottle_graph: StateGraph) -> None:
    ways = RandomWalkGoals(bottle_graph, device=CPU)
    one, two, other = drawn(ways, 100), drawn(ways, 100), drawn(ways, 100, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))
    assert not torch.equal(one[0], other[0])
