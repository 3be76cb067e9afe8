"""Generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

import torch

from falsework.utils.collectives import summed
from falsework.utils.distributed import ProcessGroup

_EPSILON = 1e-6
"""Added to the deviation of advantages, which may all be equal."""


def generalized_advantages(
    rows: list[torch.Tensor],
    values: list[torch.Tensor],
    rewards: list[torch.Tensor],
    rollouts: int,
    discount: float,
    gae_lambda: float,
) -> list[torch.Tensor]:
    """Compute the advantage of every action of rollouts that all end by themselves.

    Args:
        rows: for each step the rollouts that took part, shape (active,).
        values: for each step their estimated return before the action, shape (active,).
        rewards: for each step the reward of the action, shape (active,).
        discount: worth of a reward one step later.
        gae_lambda: 1 compares with the outcome, 0 with the next estimate.

    Returns:
        For each step, shape (active,).
    """
    following = torch.zeros(rollouts, device=rows[0].device if rows else None)
    sums = torch.zeros_like(following)
    found = []
    for active, value, reward in zip(reversed(rows), reversed(values), reversed(rewards), strict=True):
        error = reward + discount * following[active] - value
        advantage = error + discount * gae_lambda * sums[active]
        sums[active] = advantage
        following[active] = value
        found.append(advantage)
    return found[::-1]


def normalized(advantage: torch.Tensor, shards: ProcessGroup = ProcessGroup()) -> torch.Tensor:
    """Divide advantages by their deviation over all processes.

    Args:
        advantage: of this process, shape (actions,).
    """
    count, total = summed([float(len(advantage)), float(advantage.sum())], shards, advantage.device)
    mean = total / max(count, 1.0)
    (squares,) = summed([float((advantage - mean).square().sum())], shards, advantage.device)
    return advantage / ((squares / max(count, 1.0)) ** 0.5 + _EPSILON)


def explained_variance(advantage: torch.Tensor, returns: torch.Tensor, shards: ProcessGroup = ProcessGroup()) -> float:
    """Return the share of the variance of the returns that the value head explains; 0 where returns are all equal.

    Args:
        advantage: return less estimate of each action of this process, shape (actions,).
        returns: shape (actions,).
    """
    columns = [advantage.double(), returns.double()]
    sums = [value for column in columns for value in (float(column.sum()), float(column.square().sum()))]
    count, *moments = summed([float(len(advantage)), *sums], shards, advantage.device)
    left, whole = (
        square / max(count, 1.0) - (total / max(count, 1.0)) ** 2 for total, square in (moments[:2], moments[2:])
    )
    return 1.0 - left / whole if whole > _EPSILON else 0.0
