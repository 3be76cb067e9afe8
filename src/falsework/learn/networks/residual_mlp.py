"""Residual network over the state as a plain vector: no geometry, little cost, and therefore many rollouts per second.

A policy for one structure need not know why a part is where it is; it can learn from millions of rollouts which actions
end well. This network identifies every part by its number, costs a handful of matrix products a state, and so sees an
order of magnitude more rollouts in the same time than networks that attend to geometry. It does not transfer.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from falsework.assembly.model import Assembly
from falsework.learn.config.policy import EXPANSION, PolicySettings
from falsework.learn.networks.policy import Policy


class ResidualMlpPolicy(Policy):
    """Residual blocks of a norm and two matrices."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the layers for the parts of an assembly."""
        super().__init__(assembly, settings)
        channels, hidden = self.settings.channels, EXPANSION * self.settings.channels
        self.state_in = nn.Linear(self.part_count * self.kinds_of_part, channels)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(channels), nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels))
            for _ in range(self.settings.layers)
        )
        self.norm = nn.LayerNorm(channels)
        self.action_head = nn.Linear(channels, 2 * self.part_count)
        self.value_head = nn.Linear(channels, 1)
        for head in (self.action_head, self.value_head):
            nn.init.normal_(head.weight, std=0.01)
            nn.init.zeros_(head.bias)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`."""
        x = self.state_in(self.classes(states, targets).flatten(1).to(self.state_in.weight.dtype))
        for layer in self.layers:
            x = x + layer(x)
        x = self.norm(x)
        return self.action_head(x).float(), torch.tanh(self.value_head(x).float()).squeeze(-1)
