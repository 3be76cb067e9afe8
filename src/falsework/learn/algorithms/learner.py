"""Base of imitation and PPO: an optimizer, random numbers and their state in a checkpoint."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch

from falsework.learn.algorithms.policy_optimizer import PolicyOptimizer
from falsework.learn.networks.policy import Policy
from falsework.utils.distributed import ProcessGroup


class Learner(ABC):
    """Base of learners, which improve a policy a block of steps at a time."""

    def __init__(
        self, policy: Policy, generator: torch.Generator, seed: int, shards: ProcessGroup, **optimizer: Any
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            policy: trained in place.
            generator: of batches and rollouts, different in every process.
            shards: processes that average their gradients.
            optimizer: further options of `PolicyOptimizer`.
        """
        self.policy = policy
        self.listener: Callable[[dict[str, float]], None] = lambda numbers: None
        """Called with numbers to log, more often than blocks end where these take long."""
        self.generator, self.seed, self.shards = generator, seed, shards
        self.optimizer = PolicyOptimizer(policy, shards=shards, **optimizer)

    @property
    def steps(self) -> int:
        """Steps of the optimizer taken."""
        return self.optimizer.steps

    @property
    def widening(self) -> bool:
        """Whether tasks still get harder, so that success on all of them says little of what is learned."""
        return False

    @abstractmethod
    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """Take some steps of the optimizer.

        Args:
            progress: of the whole training, before and after.

        Returns:
            Numbers to log.

        Raises:
            TrainingError: a step was not finite.
        """

    def export_policy(self, policy: Policy) -> Policy:
        """Write the weights to be evaluated into another policy of the same kind, and return it."""
        self.optimizer.export_policy(policy)
        return policy.eval()

    def load_policy(self, policy: Policy) -> None:
        """Continue with the weights of another policy of the same kind, such as the result of the phase before."""
        self.optimizer.load_policy(policy)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that is the same in all processes."""
        return self.optimizer.state_dict()

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that belongs to this process."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """Restore both; `local` is None if the number of processes has changed."""
        self.optimizer.load_state_dict(tensors)
        if local is not None:
            self.generator.set_state(local["generator"].cpu())
        else:  # other processes than before draw other numbers
            self.generator.manual_seed((self.seed * 1009 + self.shards.rank) * 100_003 + self.steps)
