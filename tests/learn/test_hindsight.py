"""Failed rollouts, seen as successes at what they passed, and policies that are not told the target."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework.assembly import Assembly  # noqa: E402
from falsework.learn.algorithms.hindsight import OneState, relabel  # noqa: E402
from falsework.learn.data.goal_pairs import sample_pairs  # noqa: E402
from falsework.learn.env.environment import Environment  # noqa: E402
from falsework.learn.env.rollout import roll_out  # noqa: E402
from falsework.search import Direction, StateGraph, Task  # noqa: E402
from falsework.stability.reference.clarabel import ExactSolver  # noqa: E402


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
    rollouts = roll_out(environment, policy, starts, greedy=False, generator=environment.generator(0))
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
    from falsework.learn.env.rollout import Rollouts

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


def test_a_policy_of_one_state_is_not_told_the_target(bottle: Assembly, bottle_graph: StateGraph) -> None:
    environment = Environment(bottle, 2, device="cpu")
    seen = []

    def policy(states, targets=None):
        seen.append(targets)
        return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))

    pairs = sample_pairs(bottle_graph, 50, np.random.default_rng(0))
    states, targets, _ = pairs.tensors(environment.device)
    rollouts = roll_out(environment, OneState(policy), states, targets)
    assert all(one is None for one in seen)
    kept = targets == 1
    assert (rollouts.last[kept] == 1).all()
