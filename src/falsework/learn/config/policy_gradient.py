"""Choices of the refinement by rollouts; read without torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

from falsework.errors import InputError


@dataclass(frozen=True)
class RefineSettings:
    """How a policy that sometimes succeeds is made one that nearly always does; a size of 0 depends on the device."""

    rollouts: int = 0
    """Rollouts between two sets of updates, over all processes; 0: 16,384 on a GPU, 512 on a processor, and on a GPU
    three times as many with targets, whose ways are shorter: a set of rollouts takes as long as its longest."""
    batch: int = 0
    """Actions a step of the optimizer, over all processes; 0: 8,192 on a GPU, 512 on a processor."""
    learning_rate: float = 0.0
    """Largest step of AdamW; 0: 3e-4 on a GPU, 5e-4 on a processor."""
    least_learning_rate: float = 0.1
    """What it falls to at the end, as a share of the largest."""
    weight_decay: float = 0.01
    """Of AdamW."""
    clip_ratio: float = 0.2
    """How far the probability of an action may move before it counts no longer (PPO)."""
    trace: float = 0.95
    """Lambda of the generalised advantage. There is no discount: success late is as good as success early."""
    entropy: float = 0.003
    """Weight of the entropy."""
    value: float = 0.5
    """Weight of the error of the estimated success."""
    imitation: float = 0.1
    """Weight of the imitation of states known to be solvable, or of ways to targets, which keeps what was learned."""
    imitation_share: float = 0.25
    """States imitated a step, as a share of the batch."""
    from_data: float = 0.5
    """Share of the rollouts that start where searches found states."""
    from_failures: float = 0.25
    """Share that starts where a rollout failed lately; the others start anywhere that is known to be solvable."""
    from_hindsight: float = 0.25
    """With targets: share that starts at a state of an earlier rollout and has a later one of it as its target."""
    average: float = 0.995
    """Decay of the moving average of the weights that is evaluated and saved."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    most_solved: int = 20_000_000
    """States known to be solvable beyond which no more are kept."""

    def __post_init__(self) -> None:
        if min(self.rollouts, self.batch) < 0 or self.learning_rate < 0:
            raise InputError("sizes and learning rate of the refinement are not negative; 0 stands for the default")
        shares = (self.from_data, self.from_failures, self.from_hindsight)
        if min(shares) < 0 or max(self.from_data, self.from_hindsight) + self.from_failures > 1:
            raise InputError("the shares of start states are not negative, and no more than 1 together")
        if not (0 <= self.trace <= 1 and 0 < self.clip_ratio < 1):
            raise InputError("trace must be between 0 and 1, and the clip ratio strictly so")

    def resolved(self, device: str, *, two_states: bool = False) -> RefineSettings:
        """The same with every 0 replaced by the default for a kind of device, `cpu` or `cuda`."""
        gpu = device == "cuda"
        return replace(
            self,
            rollouts=self.rollouts or ((49_152 if two_states else 16_384) if gpu else 512),
            batch=self.batch or (8_192 if gpu else 512),
            learning_rate=self.learning_rate or (3e-4 if gpu else 5e-4),
        )
