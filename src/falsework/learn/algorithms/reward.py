"""Rewards of reinforcement learning: that of the environment, or a function of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from falsework.errors import InputError
from falsework.learn.env.rollout import Move
from falsework.utils.quantity import format_quantity

Reward = Callable[[Move], torch.Tensor]
"""Reward of one action of every rollout that goes on, shape (going,).

The rewards that follow a state, discounted, add up to between -1 and 1, since that is what values estimate.
"""

_TOLERANCE = 1e-3
"""By which sums of rewards may be outside of [-1, 1], for their rounding."""


def environment_reward(move: Move) -> torch.Tensor:
    """Return +1 where the target is reached, -1 where a rollout fails, else 0."""
    return move.step.reward


def rewards_of(moves: Sequence[Move], reward: Reward) -> list[torch.Tensor]:
    """Evaluate a reward for every move of a batch of rollouts.

    Raises:
        InputError: it gives something else than one finite number for each action.
    """
    found = []
    for move in moves:
        one = reward(move)
        shape = tuple(one.shape) if isinstance(one, torch.Tensor) else type(one).__name__
        if shape != move.value.shape:
            raise InputError(f"the reward gives {shape} for {len(move.value)} actions; return a number for each")
        found.append(one.detach().to(move.value))
    if found and not bool(torch.cat(found).isfinite().all()):
        raise InputError("the reward gives numbers that are not finite; return finite ones")
    return found


def returns_of(moves: Sequence[Move], rewards: Sequence[torch.Tensor], rollouts: int, discount: float) -> torch.Tensor:
    """Add up the rewards of each rollout.

    Args:
        moves: of the rollouts.
        rewards: of each move.
        rollouts: their number.
        discount: worth of a reward one step later.

    Returns:
        Shape (rollouts,); 0 for a rollout without a move.

    Raises:
        InputError: rewards that follow a state add up to more than values can be.
    """
    total = torch.zeros(rollouts, device=moves[0].value.device)
    largest = total.new_zeros(())
    for move, reward in zip(reversed(moves), reversed(rewards), strict=True):
        following = reward + discount * total[move.rows]
        total[move.rows] = following
        largest = torch.maximum(largest, following.abs().max())
    if float(largest) > 1.0 + _TOLERANCE:
        raise InputError(
            f"the rewards that follow a state add up to {format_quantity(float(largest), 'factor')} in size; "
            f"scale the reward, so that their "
            "sum is between -1 and 1, as values are"
        )
    return total
