"""Random ways inside a graph: every one is a task, and begins with an action that leads to its target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework.assembly import Assembly  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn.environment import Environment  # noqa: E402
from falsework.learn.pairs import PairSource  # noqa: E402
from falsework.learn.ways import Ways  # noqa: E402
from falsework.search import StateGraph  # noqa: E402
from falsework.search.hashing import StateIndex  # noqa: E402

CPU = torch.device("cpu")


def drawn(ways: Ways, count: int, seed: int = 0) -> tuple[Any, Any, Any]:
    return ways.draw(count, torch.Generator().manual_seed(seed))


def test_the_action_leads_to_the_target_inside_the_graph(bottle_graph: StateGraph) -> None:
    """As the table of what leads where says that `PairSource` makes."""
    graph = bottle_graph
    states, targets, valid = drawn(Ways(graph, device=CPU), 500)
    assert (valid.sum(dim=1) == 1).all()
    source = PairSource(graph)
    ends = graph.index.find(targets.numpy())
    leads = source._leads_to(ends)
    after = source._after[graph.index.find(states.numpy()), valid.numpy().argmax(axis=1)]
    column = np.arange(len(ends))
    assert (leads[after, column // 64] >> (column % 64).astype(np.uint64) & np.uint64(1)).all()


def test_actions_are_legal_for_their_task(bottle: Assembly, bottle_graph: StateGraph) -> None:
    environment = Environment(bottle, 2, device="cpu")
    states, targets, valid = drawn(Ways(bottle_graph, device=environment.device), 2000)
    assert (environment.rules.mask(states, targets) | ~valid).all()
    assert environment.rules.contains(states, targets).all()
    assert (environment.rules.steps_left(states, targets) > 0).all()


def test_targets_are_drawn_evenly_and_so_are_steps(bottle_graph: StateGraph) -> None:
    """Every state but the first is a target; a way has any number of steps up to those from the first state."""
    graph = bottle_graph
    ways = Ways(graph, device=CPU)
    assert ways.targets == len(graph) - 1
    states, targets, _ = drawn(ways, 200 * len(graph))
    rows = graph.index.find(targets.numpy())
    counts = np.bincount(rows, minlength=len(graph))
    mean = len(rows) / ways.targets
    assert counts[0] == 0
    assert np.abs(counts[1:] - mean).max() < 6 * np.sqrt(mean)
    far = graph.level[rows]
    steps = far - graph.level[graph.index.find(states.numpy())]
    depths, samples = np.unique(far, return_counts=True)
    many = depths[samples > 2000]
    assert len(many) > 5
    for depth in many:
        share = np.bincount(steps[far == depth], minlength=depth + 1)[1:] / (far == depth).sum()
        assert np.abs(share - 1 / depth).max() < 6 * np.sqrt(1 / depth / 2000)


def test_forbidden_states_are_neither_start_nor_target(bottle_graph: StateGraph) -> None:
    """Ways lead through them all the same, so that few ways are lost."""
    graph = bottle_graph
    rng = np.random.default_rng(2)
    forbidden = graph.states[rng.permutation(len(graph))[: len(graph) // 2]]
    states, targets, valid = drawn(Ways(graph, device=CPU, forbidden=forbidden), 2000)
    assert len(states) == len(targets) == len(valid) == 2000
    index = StateIndex(forbidden)
    assert (index.find(states.numpy()) < 0).all()
    assert (index.find(targets.numpy()) < 0).all()
    with pytest.raises(InputError, match="no way leads between two states of this graph"):
        Ways(graph, device=CPU, forbidden=graph.states)


def test_same_seed_same_ways(bottle_graph: StateGraph) -> None:
    ways = Ways(bottle_graph, device=CPU)
    one, two, other = drawn(ways, 100), drawn(ways, 100), drawn(ways, 100, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))
    assert not torch.equal(one[0], other[0])
