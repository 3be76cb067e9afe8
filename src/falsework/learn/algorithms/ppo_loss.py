"""Loss of proximal policy optimisation (Schulman et al. 2017): clipped surrogate, value error, entropy."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.networks.policy import masked_log_probabilities

_CLIP_RATIO = 0.2
"""Distance of the ratio of new to old probability from 1 beyond which nothing more is gained."""
_VALUE_WEIGHT = 0.5
"""Weight of the error of the value head."""
_PROBABILITY_RANGE = 0.4999
"""Half the range of estimated probabilities: never 0 nor 1, whose logarithm would be infinite."""


@dataclass(frozen=True, eq=False)
class Loss:
    """Loss of a batch and its terms."""

    total: torch.Tensor
    surrogate: torch.Tensor
    """Of each transition, shape (batch,)."""
    statistics: torch.Tensor
    """Surrogate loss, value error, entropy, divergence, share of clipped ratios; means, shape (5,)."""


def ppo_loss(
    logits: torch.Tensor,
    value: torch.Tensor,
    batch: Transitions,
    *,
    weight: torch.Tensor,
    entropy_weight: torch.Tensor,
) -> Loss:
    """Compute the clipped surrogate loss, the error of the value, and the entropy.

    Args:
        logits: shape (batch, 2 parts).
        value: shape (batch,).
        batch: transitions.
        weight: of each in the loss; 0 for padding. Shape (batch,).
        entropy_weight: of each, shape (batch,).
    """
    log_probability = masked_log_probabilities(logits, batch.mask)
    taken = log_probability.gather(1, batch.actions[:, None])[:, 0]
    logarithm = taken - batch.log_probability
    ratio = logarithm.exp()
    low, high = 1.0 - _CLIP_RATIO, 1.0 + _CLIP_RATIO
    surrogate = -torch.min(ratio * batch.advantage, ratio.clamp(low, high) * batch.advantage)
    # The return in [-1, 1] is read as twice a probability less one: with the rewards of the environment it is that of
    # success. The cross entropy is written out: torch's own aborts at values that are no numbers, which the guard of
    # the optimizer is to report.
    chance, true = 0.5 + _PROBABILITY_RANGE * value, 0.5 + 0.5 * batch.returns
    error = -(true * chance.log() + (1 - true) * (1 - chance).log())
    # An illegal action has probability zero and adds nothing; its logarithm is minus infinity and would make NaN.
    finite = log_probability.masked_fill(~batch.mask, 0.0)
    entropy = -(finite.exp() * batch.mask * finite).sum(dim=1)
    count = weight.count_nonzero().clamp(min=1)
    each = surrogate + _VALUE_WEIGHT * error - entropy_weight * entropy
    with torch.no_grad():
        clipped = ((ratio - 1).abs() > _CLIP_RATIO).float()
        # http://joschu.net/blog/kl-approx.html: never negative, and of small variance.
        divergence = (ratio - 1) - logarithm
        columns = torch.stack([surrogate, error, entropy, divergence, clipped])
        statistics = torch.where(weight > 0, columns, 0.0).sum(dim=1) / count
    return Loss((each * weight).sum() / count, surrogate.detach(), statistics)
