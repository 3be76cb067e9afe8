"""Inputs from which a learner of a training run is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falsework.learn.algorithms.reward import Reward
from falsework.learn.algorithms.start_states import StartSampler
from falsework.learn.config.ppo import PpoPhase
from falsework.learn.data.random_walks import GoalSampler
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
    """Trained in place."""
    starts: StartSampler
    """Chooses start states; none of them is held out."""
    phase: PpoPhase
    """Settings of the phase, resolved."""
    solved: SolvableStates
    """States known to be solvable, and those that are held out: no loss may be taken at these."""
    tasks: GoalSampler | None
    """With goals: draws states with targets and valid actions."""
    reward: Reward
    """Of each action."""
    begin: float
    """Progress of the whole training at which the phase begins."""
    seed: int
    """Of starts, rollouts and batches."""
    precision: str
    """Of the network, `float32` or `bfloat16`."""
    compiled: bool
    """Whether to compile the network."""
    shards: ProcessGroup
    """Processes that train together."""
    folder: Path | None
    """Of the run; for the batch of a step that is not finite."""

    @property
    def options(self) -> dict[str, Any]:
        """The keyword arguments of `PPO`, the reward among them."""
        names = ("solved", "tasks", "begin", "seed", "precision", "compiled", "shards", "folder", "reward")
        return {name: getattr(self, name) for name in names}
