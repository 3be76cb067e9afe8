"""Labels that say which parts could be removed: dense supervision beside the rewards of whole rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from falsework.assembly.state import HELD, REMOVED
from falsework.geometry.arrays import Rows
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.env.environment import Environment
from falsework.learn.networks.policy import masked_log_probabilities

_LEAST = 1e-4
"""Least probability of all other actions, for a finite logarithm."""


@dataclass(frozen=True, eq=False)
class Removals(Rows):
    """For each transition a part of a random legal action, and whether the structure stands without that part.

    A policy has a logit for the removal of each part, and only those of held parts count for its actions. Where the
    part could be held, the logit of its removal learns the label: two actions later it decides whether the robot is
    free again. Where the part is held and the structure would fall, its removal becomes less probable.
    """

    part: torch.Tensor
    """Shape (transitions,)."""
    stable: torch.Tensor
    """`float32`, shape (transitions,)."""
    held: torch.Tensor
    """Whether the part is held already, `bool`, shape (transitions,)."""

    @classmethod
    def draw(cls, environment: Environment, transitions: Transitions, generator: torch.Generator) -> Removals:
        """Draw a part for each transition, and ask for its verdict."""
        states, parts = transitions.states, environment.part_count
        part = torch.multinomial(transitions.mask.float(), 1, generator=generator) % parts
        stable = environment.stable(states.scatter(1, part, REMOVED), states).float()
        return cls(part[:, 0], stable, (states.gather(1, part) == HELD)[:, 0])

    def loss(self, logits: torch.Tensor, mask: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """Return the mean loss.

        Args:
            logits: of the policy, shape (transitions, 2 parts).
            mask: legal actions, shape (transitions, 2 parts).
            weight: of each, 0 for padding, shape (transitions,).
        """
        action = logits.shape[1] // 2 + self.part[:, None]
        label = binary_cross_entropy_with_logits(logits.gather(1, action)[:, 0], self.stable, reduction="none")
        # The logarithm of an illegal action is minus infinity, which would make NaN.
        legal = masked_log_probabilities(logits, mask).masked_fill(~mask, 0.0)
        others = -torch.expm1(legal.gather(1, action)[:, 0]).clamp(max=-_LEAST)
        falls = -(1.0 - self.stable) * torch.where(self.held, others, 1.0).log()
        return (torch.where(self.held, falls, label) * weight).sum() / weight.count_nonzero().clamp(min=1)
