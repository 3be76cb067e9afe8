"""Settings of proximal policy optimisation; read without torch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from falsework.errors import InputError

Starts = Literal["mixed", "curriculum", "complete"]


@dataclass(frozen=True)
class PpoPhase:
    """Proximal policy optimisation (Schulman et al. 2017); a size of 0 depends on the device.

    The defaults improve a policy that knows something, by imitation or from another run; `REINFORCEMENT` trains from
    scratch.
    """

    algorithm: Literal["ppo"] = "ppo"
    starts: Starts = "mixed"
    """Start states of rollouts. `mixed`: states that searches found, recent failures, and hindsight goals or any state
    known to be solvable; `curriculum`: the curriculum of the paper; `complete`: the complete structure alone."""
    rollouts: int = 0
    """Rollouts per collection, over all processes; 0: 4,096 on a GPU and 512 on a CPU."""
    batch: int = 0
    """Transitions per step of the optimizer, over all processes; 0: 4,096 on a GPU and 1,024 on a CPU."""
    epochs: int = 3
    """Passes over a collection."""
    learning_rate: float = 1e-3
    """Initial learning rate, which falls linearly to a tenth over the phase."""
    average: float = 0.99
    """Decay of the moving average of the weights that is evaluated and saved; 0: the weights themselves."""
    discount: float = 1.0
    """Worth of a reward one step later. By default success late is as good as success early."""
    gae_lambda: float = 0.95
    """Decay of generalised advantages over steps; 1 compares with the final outcome."""
    entropy: float = 0.003
    """Weight of the entropy of the policy; a curriculum has its own."""
    entropy_floor: float = 0.5
    """Mean entropy of the actions, in nat, below which that weight rises; the floor falls linearly to 0 over the phase,
    so that the policy explores first and decides at last. 0: none."""
    anywhere: float = 0.0
    """Of a curriculum: share of the rollouts that starts at any solvable state within its horizon, those
    that rollouts passed included."""
    explored: float = 0.0
    """Of a curriculum: share of the rollouts that starts at solvable states far from those of the
    searches, which moves in the direction of assembly find during the training."""
    imitation: float = 0.1
    """Weight of imitating states known to be solvable, which preserves what imitation learned. With goals nothing is
    imitated beside the rollouts: the network would memorise the paths between states of searches."""
    removals: float = 0.5
    """With goals: weight of learning which parts could be removed (`falsework.learn.algorithms.removals`), for one
    verdict more at each state."""

    def __post_init__(self) -> None:
        if self.starts not in get_args(Starts):
            raise InputError(f"unknown starts {self.starts!r}; choose {', '.join(get_args(Starts))}")
        if min(self.rollouts, self.batch) < 0 or not self.learning_rate >= 0:
            raise InputError("sizes and learning rate of PPO are not negative; a size of 0 stands for the default")
        if self.epochs < 1:
            raise InputError(f"epochs is {self.epochs}; give at least 1")
        for name in ("discount", "gae_lambda", "anywhere", "explored"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is {getattr(self, name):g}; give a number between 0 and 1")
        if self.anywhere + self.explored > 1:
            raise InputError(
                f"anywhere and explored are {self.anywhere:g} and {self.explored:g} of the rollouts; give shares with "
                "a sum of at most 1"
            )
        if not 0 <= self.average < 1:
            raise InputError(f"average is {self.average:g}; give 0 or more, and less than 1")
        for name in ("entropy", "entropy_floor", "imitation", "removals"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name} is {getattr(self, name):g}; give 0 or more")

    def resolved(self, device: str) -> PpoPhase:
        """Replace every 0 by the default for a kind of device, `cpu` or `cuda`."""
        rollouts, batch = (4_096, 4_096) if device == "cuda" else (512, 1_024)
        return replace(self, rollouts=self.rollouts or rollouts, batch=self.batch or batch)


REINFORCEMENT = PpoPhase(starts="curriculum", anywhere=0.25, explored=0.25, imitation=0.0)
"""Reinforcement learning from scratch: the curriculum of the paper (section 5.2), states that rollouts passed, and
states far from the data."""
