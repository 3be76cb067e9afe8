"""Settings of imitation; read without torch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from falsework.errors import InputError


@dataclass(frozen=True)
class ImitationPhase:
    """Imitation of the actions that are known to be valid; a size of 0 depends on the device."""

    algorithm: Literal["imitation"] = "imitation"
    until: float = 1.0
    """Share of the training time, searches not counted, at which the phase ends at the latest."""
    steps: int = 0
    """Steps of the optimizer after which the phase ends; 0: no such limit."""
    batch: int = 0
    """States per step, over all processes; 0: 1,024 on a GPU, 128 on a CPU."""
    learning_rate: float = 0.0
    """Largest learning rate of AdamW; 0: 1e-3 on a GPU, 2e-3 on a CPU."""
    warm_up: int = 100
    """Steps over which the learning rate rises."""
    decay: float = 0.5
    """Share of the training at the end of which the learning rate falls along half a cosine."""

    def __post_init__(self) -> None:
        if not 0 <= self.until <= 1 or not 0 <= self.decay <= 1:
            raise InputError("until and decay of imitation are shares; give numbers between 0 and 1")
        if min(self.steps, self.batch, self.warm_up) < 0 or not self.learning_rate >= 0:
            raise InputError("sizes and learning rate of imitation are not negative; 0 stands for the default")

    def resolved(self, device: str) -> ImitationPhase:
        """Replace every 0 by the default for a kind of device, `cpu` or `cuda`."""
        gpu = device == "cuda"
        return replace(
            self,
            batch=self.batch or (1024 if gpu else 128),
            learning_rate=self.learning_rate or (1e-3 if gpu else 2e-3),
        )
