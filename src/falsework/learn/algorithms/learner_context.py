"""Inputs from which a learner of a training run is made."""

from __future__ import annotations

from dataclasses import dataclass, field

from falsework.learn.algorithms.reward import Reward, environment_reward
from falsework.learn.algorithms.start_states import StartSampler
from falsework.learn.config.ppo import PpoPhase
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.networks.policy import Policy
from falsework.utils.distributed import ProcessGroup


@dataclass(frozen=True, eq=False)
class LearnerContext:
    """Environment, policy, start states and settings of the phase in which a learner works."""

    environment: Environment
    """Rules and verdicts."""
    policy: Policy
    """Trained in place, from the weights that it has."""
    starts: StartSampler
    """Chooses start states; none of them is held out."""
    phase: PpoPhase
    """Settings of the phase, resolved (`PpoPhase.resolved`)."""
    solved: SolvableStates = None  # type: ignore[assignment]
    """States known to be solvable, which grow by successes, and those that are held out: no loss may be taken at
    these. By default none."""
    reward: Reward = environment_reward
    """Of each action."""
    begin: float = 0.0
    """Progress of the whole training at which the phase begins."""
    seed: int = 0
    """Of starts, rollouts and batches."""
    precision: str = "float32"
    """Of the network, `float32` or `bfloat16`."""
    compiled: bool = False
    """Whether to compile the network for its updates."""
    shards: ProcessGroup = field(default_factory=ProcessGroup)
    """Processes, each with its own rollouts, that average their gradients."""

    def __post_init__(self) -> None:
        if self.solved is None:
            object.__setattr__(self, "solved", SolvableStates(self.environment.rules))
