"""Hindsight relabelling, and policies that ignore goals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, Direction, StateGraph, Task  # noqa: E402
from falsework.learn import (  # noqa: E402
    Environment,
    collect_transitions,
    roll_out,
)
from falsework.learn.algorithms.hindsight import relabel  # noqa: E402
from falsework.learn.algorithms.rollout_storage import Transitions  # noqa: E402
from falsework.learn.data.goal_pairs import PairSource  # noqa: E402
from falsework.learn.data.solvable_states import SolvableStates  # noqa: E402
from falsework.learn.networks.autocast import Network  # noqa: E402
from falsework.stability import ExactSolver  # noqa: E402


def replay(bottle: Assembly, exact: ExactSolver, states, targets, played: Transitions) -> None:
    """An action that was taken in the state is a legal first step of each task, and leads to a stable state."""
    for state, target in zip(states.numpy(), targets.numpy(), strict=True):
        task = Task.from_rules(bottle.boundary, 2, start=state, target=target)
        taken = played.actions[(played.states == torch.from_numpy(state)).all(dim=1)].numpy()
        legal = taken[task.moves(state[None], Direction.DISASSEMBLY)[0, taken]]
        assert len(legal)
        after = task.follow(state[None], legal[:1], Direction.DISASSEMBLY)
        assert task.contains(after).all()
        assert exact.check(np.concatenate([state[None], after, target[None]])).stable.all()


def test_relabelled_rollouts_are_paths_to_visited_states(bottle: Assembly) -> None:
    """They are samples of tasks that exist, proven stable by the exact solver, and the rollout itself reaches them."""
    environment = Environment(bottle, 2, device="cpu")

    def policy(states, targets=None):
        return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))

    starts = environment.rules.complete(80)
    options = {"discount": 1.0, "gae_lambda": 0.9}
    played = collect_transitions(environment, policy, starts, None, environment.generator(0), **options)
    assert not played.success.all()
    solved = SolvableStates(environment.rules)
    states, goals = relabel(played, 60, solved, environment.generator(1))
    assert 40 < len(states) <= 60
    replay(bottle, ExactSolver(bottle), states, goals, played)
    # With these goals, the very same actions end in success, by the environment's own rules.
    rows = (played.rollout == int(played.rollout.bincount().argmax())).nonzero()[:, 0]
    state, goal = played.states[rows[:1]], played.states[rows[-1:]]
    for place, row in enumerate(rows[:-1]):
        done = environment.step(state, played.actions[row][None], goal)
        state = done.states
        assert done.success.item() == (place == len(rows) - 2)
        assert done.reward.item() == float(place == len(rows) - 2)
    # What is held out becomes neither state nor goal.
    assert solved.is_held_out(states).sum() == 0
    solved.hold_out(played.states.unique(dim=0)[::2])
    states, goals = relabel(played, 600, solved, environment.generator(1))
    assert len(states)
    assert not (solved.is_held_out(states) | solved.is_held_out(goals)).any()
    assert len(relabel(played.take(rows[:0]), 10, solved, environment.generator(1))[0]) == 0


def test_pairs_of_one_rollout_are_drawn_evenly(bottle: Assembly) -> None:
    """First a transition among all, then another of the same rollout: a rollout of three and one of two."""
    solved = SolvableStates(Environment(bottle, 2, device="cpu").rules)
    rollout = torch.tensor([0, 1, 0, 1, 0])
    number = torch.arange(5)
    states = torch.zeros((5, bottle.part_count), dtype=torch.uint8)
    states[:, 0], states[:, 1] = number // 3, number % 3
    zero, mask = torch.zeros(5), torch.ones((5, 2 * bottle.part_count), dtype=torch.bool)
    played = Transitions(states, None, number, mask, zero, zero, zero, rollout, torch.tensor([True, False]), zero)
    begin, end = relabel(played, 60_000, solved, torch.Generator().manual_seed(0))
    first, last = (3 * one[:, 0].long() + one[:, 1].long() for one in (begin, end))
    share = torch.bincount(first * 5 + last, minlength=25).view(5, 5) / len(first)
    expected = torch.zeros(5, 5)
    expected[0, 2] = expected[0, 4] = expected[2, 4] = 3 / 5 * 2 / 9
    expected[1, 3] = 2 / 5 * 2 / 4
    assert torch.allclose(share, expected / expected.sum(), atol=0.01)


def test_a_goal_blind_policy_ignores_the_target(bottle: Assembly, bottle_graph: StateGraph) -> None:
    environment = Environment(bottle, 2, device="cpu")
    seen = []

    class Blind(torch.nn.Module):
        def forward(self, states: torch.Tensor, targets: Any = None) -> tuple[torch.Tensor, torch.Tensor]:
            seen.append(targets)
            return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))

    pairs = PairSource(bottle_graph).draw(np.random.default_rng(0), 50)
    states, targets = pairs.tensors(environment.device)
    rollouts = roll_out(environment, Network(Blind()), states, targets)
    assert all(one is None for one in seen)
    kept = targets == 1
    assert (rollouts.last[kept] == 1).all()
