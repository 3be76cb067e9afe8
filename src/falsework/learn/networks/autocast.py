"""Autocast wrapper of a policy: bfloat16 for the network alone, float32 for all else."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch


class Network(torch.nn.Module):
    """A policy evaluated in the precision chosen for its device: the only place where precision is lowered.

    The setting is passed to the calls of the network alone. No global setting is changed, since the solver's iterations
    do not converge in less than float32.
    """

    def __init__(self, policy: torch.nn.Module, precision: str = "float32", *, compiled: bool = False) -> None:
        """Wrap a policy, whose weights stay its own.

        Args:
            precision: `float32` or `bfloat16`.
            compiled: compile it for the batches of training, which all have one size.
        """
        super().__init__()
        self.policy = policy
        self.goal_conditioned = bool(getattr(policy, "goal_conditioned", False))
        self._half = precision == "bfloat16"
        call: Any = torch.compile(policy) if compiled else policy
        # Hidden from torch in a tuple: the compiled module has no second set of weights.
        self._call = (call,)

    def forward(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Policy`; both results in float32. A policy without goals is not told of targets."""
        targets = targets if self.goal_conditioned else None
        with torch.autocast(states.device.type, torch.bfloat16) if self._half else nullcontext():
            logits, value = self._call[0](states, targets)
        return logits.float(), value.float()
