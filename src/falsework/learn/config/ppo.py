"""Choices of reinforcement learning and its curriculum; read without torch."""

from __future__ import annotations

from dataclasses import dataclass

from falsework.errors import InputError


@dataclass(frozen=True)
class CurriculumSettings:
    """From which states rollouts start, and how much they explore (paper, section 5.2)."""

    growing: bool = True
    """Begin with states close to the target and go back to the complete structure as the policy gets better; without,
    all states are drawn from the beginning."""
    pass_mark: float = 0.6
    """Share of the rollouts from the far end of what is drawn that must succeed before states farther away follow."""
    stages: int = 10
    """Stretches in which the way back to the complete structure is taken, if `growing`."""
    rank_power: float = 0.8
    """States are drawn with probability `rank ** -rank_power`, the one of highest surrogate loss first; 0 draws evenly.
    States never drawn go before all others."""
    correction: float = 0.1
    """Power with which samples are weighted against being drawn too often; grows to 1."""
    corrected_after: int = 500
    """Updates until it is 1."""
    entropy: float = 0.005
    """Weight of the entropy of the policy in the loss."""
    entropy_rise: float = 0.001
    """What is added to that for a state each time its rollout fails, until one succeeds."""
    entropy_most: float = 0.01
    """Where that ends."""

    def __post_init__(self) -> None:
        if not 0 < self.pass_mark <= 1:
            raise InputError(f"pass_mark is {self.pass_mark:g}; give a share above 0 and up to 1")
        if self.stages < 1 or self.corrected_after < 1:
            raise InputError("stages and corrected_after are counts; give at least 1")
        for name in ("rank_power", "correction", "entropy", "entropy_rise", "entropy_most"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} is {getattr(self, name):g}; give 0 or more")


@dataclass(frozen=True)
class PpoSettings:
    """Proximal policy optimisation (Schulman et al. 2017) with the paper's values where it gives one."""

    batch: int = 2048
    """State-action pairs in a step of the optimizer, over all processes."""
    epochs: int = 5
    """Times that each pair is learned from."""
    learning_rate: float = 2e-3
    """Step of Adam at the beginning."""
    milestones: tuple[int, ...] = (1000, 3000)
    """Updates after which the learning rate falls to a tenth."""
    betas: tuple[float, float] = (0.95, 0.999)
    """Moving averages of Adam."""
    discount: float = 0.95
    """What a reward a step later is worth."""
    trace: float = 0.95
    """Decay of advantages over steps, the lambda of generalised advantage estimation; 1 compares with what really
    followed."""
    clip: float = 0.2
    """How far the ratio of new to old probability may go from 1 before nothing more is gained."""
    value: float = 0.5
    """Weight of the squared error of the value."""
    gradient_norm: float = 1.0
    """Longest gradient; longer ones are cut to this."""
    hindsight: float = 0.0
    """With targets: weight of imitating failed rollouts, seen as successes at states that they passed. Pays where few
    pairs of start and target are known (0.03), and costs where thousands are (docs/decisions/0023)."""
    target_divergence: float = 0.0
    """Kullback-Leibler divergence from the old policy after which an update ends early; 0 for never."""
    curriculum: CurriculumSettings = CurriculumSettings()
    """Start states and exploration."""

    def __post_init__(self) -> None:
        if self.batch < 1 or self.epochs < 1:
            raise InputError("batch and epochs are counts; give at least 1")
        if not self.learning_rate > 0:
            raise InputError(f"learning_rate is {self.learning_rate:g}; give a number above zero")
        for name in ("discount", "trace"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is {getattr(self, name):g}; give a number between 0 and 1")
        if not self.hindsight >= 0 or not self.target_divergence >= 0:
            raise InputError("hindsight and target_divergence are 0 or more")
        if not self.clip > 0 or not self.gradient_norm > 0:
            raise InputError("clip and gradient_norm are above zero")
