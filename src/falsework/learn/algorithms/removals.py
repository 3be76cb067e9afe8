"""Labels that say which parts could be removed: dense supervision beside the rewards of whole rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from falsework.assembly.state import REMOVED
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.env.environment import Environment


@dataclass(frozen=True, eq=False)
class Removals:
    """For each transition a part that the rules let a robot hold, and whether the structure stands without the part.

    Two moves later that decides whether the robot is free again. A policy has a logit for the removal of each part, and
    only those of held parts count for its actions: the logit of a part that is not held learns the label.
    """

    part: torch.Tensor
    """Shape (transitions,)."""
    stable: torch.Tensor
    """`float32`, shape (transitions,)."""
    weight: torch.Tensor
    """0 where no part can be held, else 1; `float32`, shape (transitions,)."""

    @classmethod
    def draw(cls, environment: Environment, transitions: Transitions, generator: torch.Generator) -> Removals:
        """Draw a part for each transition, and ask for its verdict."""
        holds = transitions.mask[:, : environment.part_count]
        rows = holds.any(dim=1).nonzero()[:, 0]
        part = torch.zeros(len(holds), dtype=torch.int64, device=holds.device)
        stable, weight = (torch.zeros(len(holds), device=holds.device) for _ in range(2))
        if len(rows):
            part[rows] = torch.multinomial(holds[rows].float(), 1, generator=generator)[:, 0]
            before = transitions.states[rows]
            after = before.scatter(1, part[rows, None], REMOVED)
            stable[rows], weight[rows] = environment.stable(after, before).float(), 1.0
        return cls(part, stable, weight)

    def take(self, rows: torch.Tensor) -> Removals:
        """Select some of the transitions."""
        return Removals(self.part[rows], self.stable[rows], self.weight[rows])

    def loss(self, logits: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """Return the mean cross entropy.

        Args:
            logits: of the policy, shape (transitions, 2 parts).
            weight: of each, 0 for padding, shape (transitions,).
        """
        chosen = logits.gather(1, logits.shape[1] // 2 + self.part[:, None])[:, 0]
        each = binary_cross_entropy_with_logits(chosen, self.stable, reduction="none")
        weight = weight * self.weight
        return (each * weight).sum() / weight.sum().clamp(min=1.0)
