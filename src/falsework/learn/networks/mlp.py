"""Multilayer perceptron over the state as a plain vector, the paper's baseline."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from falsework.assembly.model import Assembly
from falsework.learn.config.policy import PolicySettings
from falsework.learn.networks.policy import Policy


class MlpPolicy(Policy):
    """Multilayer perceptron without geometry, by default three layers of 64 tanh units."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Make the layers for the parts of an assembly."""
        super().__init__(assembly, settings)
        width = self.part_count * self.kinds_of_part
        layers: list[nn.Module] = []
        for _ in range(self.settings.layers):
            layers += [nn.Linear(width, self.settings.channels), nn.Tanh()]
            width = self.settings.channels
        self.trunk = nn.Sequential(*layers)
        self.action_head = nn.Linear(width, 2 * self.part_count)
        self.value_head = nn.Linear(width, 1)
        for head in (self.action_head, self.value_head):
            nn.init.normal_(head.weight, std=0.01)
            nn.init.zeros_(head.bias)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Policy`."""
        x = self.trunk(self.classes(states, targets).flatten(1).to(self.action_head.weight.dtype))
        return self.action_head(x).float(), torch.tanh(self.value_head(x).float()).squeeze(-1)
