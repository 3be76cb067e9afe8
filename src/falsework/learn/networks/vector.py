"""Networks over the state as a plain vector, which identify every part by its number and do not transfer.

A policy for one structure need not know why a part is where it is; it can learn from millions of rollouts which actions
end well. These networks cost a handful of matrix products a state, and so see an order of magnitude more rollouts in
the same time than networks that attend to geometry.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from falsework.assembly.model import Assembly
from falsework.learn.config.policy import EXPANSION, PolicySettings
from falsework.learn.networks.policy import Policy, small_head


class VectorPolicy(Policy):
    """Base of these networks: features of a state, and the heads."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the heads."""
        super().__init__(assembly, settings)
        self.action_head = small_head(self.settings.channels, 2 * self.part_count)
        self.value_head = small_head(self.settings.channels, 1)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`."""
        x = self.features(self.classes(states, targets).flatten(1).to(self.action_head.weight.dtype))
        return self.action_head(x).float(), torch.tanh(self.value_head(x).float()).squeeze(-1)

    def features(self, x: Tensor) -> Tensor:
        """Map state vectors, shape (batch, parts times kinds), to features, shape (batch, channels)."""
        raise NotImplementedError


class MlpPolicy(VectorPolicy):
    """Multilayer perceptron, the paper's baseline: by default three layers of 64 tanh units."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the layers for the parts of an assembly."""
        super().__init__(assembly, settings)
        channels = self.settings.channels
        widths = [self.part_count * self.kinds_of_part, *[channels] * (self.settings.layers - 1)]
        self.trunk = nn.Sequential(*(layer for width in widths for layer in (nn.Linear(width, channels), nn.Tanh())))

    def features(self, x: Tensor) -> Tensor:
        """See `VectorPolicy`."""
        return self.trunk(x)


class ResidualMlpPolicy(VectorPolicy):
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

    def features(self, x: Tensor) -> Tensor:
        """See `VectorPolicy`."""
        x = self.state_in(x)
        for layer in self.layers:
            x = x + layer(x)
        return self.norm(x)
