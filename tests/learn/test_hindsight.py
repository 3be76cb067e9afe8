"""Pairs of start and target: every one is a task that the rules accept, and the actions given lead to its target."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework.assembly import Assembly, load_structure  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn.data import task_for  # noqa: E402
from falsework.learn.environment import Environment  # noqa: E402
from falsework.learn.hindsight import (  # noqa: E402
    OneState,
    Pairs,
    PairSource,
    TargetDataSettings,
    relabel,
    sample_pairs,
    target_dataset,
)
from falsework.search import BeamSearch, BeamSettings, Direction, StateGraph, Task  # noqa: E402
from falsework.search.hashing import StateIndex  # noqa: E402
from falsework.stability import Stability  # noqa: E402
from falsework.stability.exact import ExactSolver  # noqa: E402


@pytest.fixture(scope="module")
def bottle() -> Assembly:
    return load_structure("bottle")


@pytest.fixture(scope="module")
def graph(bottle: Assembly) -> StateGraph:
    task = task_for(bottle)
    search = BeamSearch(task, Stability(bottle), BeamSettings(width=12, direction=Direction.DISASSEMBLY))
    search.run()
    return StateGraph.build(task, search.states())


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


def test_valid_actions_are_all_that_lead_to_the_target_inside_the_graph(graph: StateGraph) -> None:
    pairs = sample_pairs(graph, 60, np.random.default_rng(0))
    assert len(pairs) == 60
    for state, target, valid in zip(pairs.states, pairs.targets, pairs.valid, strict=True):
        row, end = (int(graph.index.find(one[None])[0]) for one in (state, target))
        assert row != end
        expected = {action for action, after in successors(graph, row).items() if end in reachable(graph, after)}
        assert set(np.flatnonzero(valid).tolist()) == expected
        assert expected


def test_valid_actions_are_legal_for_their_task(bottle: Assembly, graph: StateGraph) -> None:
    """Also with the rule that the last free robot is not spent on a part that stays held."""
    pairs = sample_pairs(graph, 3000, np.random.default_rng(1))
    for state, target, valid in zip(pairs.states[:300], pairs.targets[:300], pairs.valid[:300], strict=True):
        task = Task.create(bottle.boundary, 2, start=state, target=target)
        assert task.moves(state[None], Direction.DISASSEMBLY)[0][valid].all()
    environment = Environment(bottle, 2, device="cpu")
    states, targets, valid = pairs.tensors(environment.device)
    assert (environment.rules.mask(states, targets) | ~valid).all()
    assert environment.rules.contains(states, targets).all()
    assert environment.stable(states).all()


def test_forbidden_states_are_in_no_pair(graph: StateGraph) -> None:
    rng = np.random.default_rng(2)
    forbidden = graph.states[rng.permutation(len(graph))[: len(graph) // 2]]
    pairs = PairSource(graph, forbidden=forbidden).draw(2000, rng)
    index = StateIndex(np.unique(forbidden, axis=0))
    assert len(pairs) == 2000
    assert (index.find(pairs.states) < 0).all()
    assert (index.find(pairs.targets) < 0).all()
    with pytest.raises(InputError, match="no way leads between two states of this graph"):
        PairSource(graph, forbidden=graph.states)


def test_same_seed_same_pairs(graph: StateGraph) -> None:
    one, two = (sample_pairs(graph, 100, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.states, two.states)
    assert np.array_equal(one.targets, two.targets)


def replay(bottle: Assembly, exact: ExactSolver, states, targets, actions) -> None:
    """Each sample is a legal first step of its task, and leads to a stable state."""
    for state, target, action in zip(states.numpy(), targets.numpy(), actions.tolist(), strict=True):
        task = Task.create(bottle.boundary, 2, start=state, target=target)
        assert task.moves(state[None], Direction.DISASSEMBLY)[0, action]
        after = task.follow(state[None], np.array([action]), Direction.DISASSEMBLY)
        assert task.contains(after).all()
        assert exact.check(np.concatenate([state[None], after, target[None]])).stable.all()


def test_failed_rollouts_are_ways_to_what_they_passed(bottle: Assembly) -> None:
    """Relabelled, they are samples of tasks that exist, proven stable by the exact solver."""
    environment = Environment(bottle, 2, device="cpu")

    def policy(states, targets=None):
        return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))

    starts = environment.rules.complete(80)
    rollouts = environment.rollout(policy, starts, greedy=False, generator=environment.generator(0))
    failed = ~rollouts.success
    assert failed.any()
    states, targets, actions = relabel(rollouts, 60, environment.generator(1))
    assert len(states) == 60
    replay(bottle, ExactSolver(bottle), states, targets, actions)
    # With these targets, the very same actions end in success, by the environment's own rules.
    good = failed & (rollouts.length - rollouts.unstable.long() > 0)
    row = int(good.nonzero()[0, 0])
    last = int(rollouts.length[row] - rollouts.unstable[row].long())
    target = rollouts.states[last, row][None]
    state = rollouts.states[0, row][None]
    for step in range(last):
        done = environment.step(state, rollouts.actions[step, row][None].long(), target, check=True)
        state = done.states
        assert done.success.item() == (step == last - 1)
        assert done.reward.item() == float(step == last - 1)


def test_relabelling_draws_pairs_of_steps_evenly() -> None:
    from falsework.learn.rollout import Rollouts

    states = torch.arange(4, dtype=torch.uint8)[:, None, None].expand(4, 3, 1)
    actions = torch.arange(3, dtype=torch.int16)[:, None].expand(3, 3)
    length = torch.tensor([3, 1, 3])
    rollouts = Rollouts(states, actions, length, torch.tensor([False, False, True]), torch.tensor([False, True, False]))
    begin, end, action = relabel(rollouts, 30_000, torch.Generator().manual_seed(0))
    assert torch.equal(begin[:, 0].long(), action)
    share = torch.bincount(begin[:, 0].long() * 4 + end[:, 0].long(), minlength=16).view(4, 4) / 30_000
    assert torch.allclose(share.triu(1)[:3, 1:][torch.ones(3, 3).triu().bool()], torch.full((6,), 1 / 6), atol=0.01)
    assert share.tril().sum() == 0
    nothing = relabel(
        Rollouts(states, actions, torch.tensor([1, 1, 1]), length > 5, length > 0), 10, torch.Generator().manual_seed(0)
    )
    assert [len(column) for column in nothing] == [0, 0, 0]


def test_a_policy_of_one_state_is_not_told_the_target(bottle: Assembly, graph: StateGraph) -> None:
    environment = Environment(bottle, 2, device="cpu")
    seen = []

    def policy(states, targets=None):
        seen.append(targets)
        return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))

    pairs = sample_pairs(graph, 50, np.random.default_rng(0))
    states, targets, _ = pairs.tensors(environment.device)
    rollouts = environment.rollout(OneState(policy), states, targets)
    assert all(one is None for one in seen)
    kept = targets == 1
    assert (rollouts.last[kept] == 1).all()


def test_data_set_of_table_four_keeps_its_sets_apart(bottle: Assembly) -> None:
    settings = TargetDataSettings(train_width=4, test_width=12, widths=(20,), pairs=500, test_pairs=100)
    data = target_dataset(bottle, task_for(bottle), settings, device="cpu")
    assert len(data.train) == len(data.more) == 500
    assert 0 < len(data.test) <= 100
    seen = StateIndex(data.graph.states)
    for states in (data.test.states, data.test.targets):
        assert (seen.find(states) < 0).all()
    for states in (data.train.states, data.train.targets):
        assert (seen.find(states) >= 0).all()
    kept = StateIndex(data.test_states)
    for states in (data.more.states, data.more.targets, data.train.states):
        assert (kept.find(states) < 0).all()
    again = target_dataset(bottle, task_for(bottle), settings, device="cpu")
    assert np.array_equal(again.test.targets, data.test.targets)
    assert isinstance(data.more, Pairs)


def test_bad_input_is_one_clear_line() -> None:
    tiny = load_structure("stack:blocks=2")
    with pytest.raises(InputError, match="finds no pair of states of stack:blocks=2 that one of width 64 has not seen"):
        target_dataset(tiny, task_for(tiny, 1), device="cpu")
    with pytest.raises(InputError, match="a search of width 0 finds nothing"):
        TargetDataSettings(train_width=0)
    with pytest.raises(InputError, match="pairs and test_pairs are counts"):
        TargetDataSettings(pairs=0)
    with pytest.raises(InputError, match="a seed is not negative"):
        TargetDataSettings(seed=-1)
