"""Transitions of a batch of rollouts, with their advantages and returns."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from falsework.learn.algorithms.advantages import generalized_advantages
from falsework.learn.algorithms.reward import Reward, environment_reward, returns_of, rewards_of
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import Move, PolicyFunction, play
from falsework.learn.networks.policy import masked_log_probabilities


@dataclass(frozen=True, eq=False)
class Transitions:
    """Actions of a batch of rollouts, one per row, in the order in which they were taken."""

    states: torch.Tensor
    """`uint8`, shape (actions, parts)."""
    targets: torch.Tensor | None
    """Shape (actions, parts)."""
    actions: torch.Tensor
    """Shape (actions,)."""
    mask: torch.Tensor
    """Legal actions, shape (actions, 2 parts)."""
    log_probability: torch.Tensor
    """Of the action when it was drawn, shape (actions,)."""
    advantage: torch.Tensor
    """Shape (actions,)."""
    returns: torch.Tensor
    """Estimated sum of the rewards to come, the target of the value head, in [-1, 1], shape (actions,)."""
    rollout: torch.Tensor
    """Rollout that the row belongs to, shape (actions,)."""
    success: torch.Tensor
    """Of every rollout, `bool`, shape (rollouts,)."""
    total: torch.Tensor
    """Sum of the rewards of every rollout, discounted, shape (rollouts,)."""

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def blank(cls, states: torch.Tensor, targets: torch.Tensor | None, success: torch.Tensor) -> Transitions:
        """Make transitions of some states without a legal action or reward; `success` is that of all rollouts."""
        zero = torch.zeros(len(states), device=states.device)
        mask = torch.zeros((len(states), 2 * states.shape[1]), dtype=torch.bool, device=states.device)
        return cls(states, targets, zero.long(), mask, zero, zero, zero, zero.long(), success, success * 0.0)

    def take(self, rows: torch.Tensor) -> Transitions:
        """Select some of the actions."""
        whole = {"success": self.success, "total": self.total}
        columns = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in whole}
        taken = {name: None if column is None else column[rows] for name, column in columns.items()}
        return Transitions(**taken, **whole)  # type: ignore[arg-type]


def collect_transitions(
    environment: Environment,
    policy: PolicyFunction,
    starts: torch.Tensor,
    targets: torch.Tensor | None,
    generator: torch.Generator,
    *,
    discount: float,
    gae_lambda: float,
    reward: Reward = environment_reward,
) -> Transitions:
    """Sample a rollout from each start, with its advantages and returns.

    Args:
        environment: rules and verdicts.
        policy: logits and values.
        starts: stable states, shape (rollouts, parts).
        targets: shape (rollouts, parts), or None.
        generator: source of randomness, on the device of the environment.
        discount: worth of a reward one step later.
        gae_lambda: of the advantages.
        reward: of each action.

    Raises:
        InputError: a reward that is not a finite number for each action, or too large.
    """
    success = environment.rules.reached(starts, targets)
    moves: list[Move] = []
    logs = []
    for move in play(environment, policy, starts, targets, greedy=False, generator=generator):
        logs.append(masked_log_probabilities(move.logits, move.mask).gather(1, move.actions[:, None])[:, 0])
        success.index_copy_(0, move.rows, move.step.success)
        moves.append(move)
    if not moves:
        return Transitions.blank(starts[:0], None if targets is None else targets[:0], success)
    rows = [move.rows for move in moves]
    values = [move.value for move in moves]
    rewards = rewards_of(moves, reward)
    total = returns_of(moves, rewards, len(starts), discount)
    advantage = torch.cat(generalized_advantages(rows, values, rewards, len(starts), discount, gae_lambda))
    returns = advantage + torch.cat(values)
    return Transitions(
        torch.cat([move.states for move in moves]),
        None if targets is None else torch.cat([move.targets for move in moves if move.targets is not None]),
        torch.cat([move.actions for move in moves]),
        torch.cat([move.mask for move in moves]),
        torch.cat(logs),
        advantage,
        returns.clamp(-1.0, 1.0),
        torch.cat(rows),
        success,
        total,
    )
