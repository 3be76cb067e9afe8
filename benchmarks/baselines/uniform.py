"""Uniform policy: the baseline that draws among the legal actions with equal probabilities."""

from __future__ import annotations

import torch


class UniformPolicy:
    """A policy that knows nothing: equal logits for all actions, value zero.

    Roll it out with `greedy=False`; what it reaches is what a policy has to be compared with.
    """

    def __call__(
        self, states: torch.Tensor, targets: torch.Tensor | None = None, /
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits, shape (batch, 2 parts), and values, shape (batch,), all zero."""
        logits = torch.zeros((len(states), 2 * states.shape[1]), device=states.device)
        return logits, logits[:, 0]
