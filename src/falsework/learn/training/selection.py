"""Choice of the weights of a run by validation, and of the moment to stop."""

from __future__ import annotations

from typing import Any

import torch

from falsework.learn.networks.policy import Policy
from falsework.learn.training.evaluate import Success
from falsework.utils.tensors import below


class BestWeights:
    """Weights with the highest success on the validation set; of equal ones the latest.

    Policies can get worse on unseen states while they still get better on those that they are trained on. The test set
    has no part in the choice.
    """

    def __init__(self, patience: float) -> None:
        """Begin without weights.

        Args:
            patience: share of the run without a rise of validation after which it is over; 0: never.
        """
        self.success = Success(0, 0)
        """On the validation set."""
        self.step = -1
        """Optimizer steps after which the weights were taken; -1 before the first."""
        self._patience = patience
        self._risen = 0.0
        self._weights: dict[str, torch.Tensor] = {}

    def consider(self, policy: Policy, success: Success, step: int, progress: float, *, waiting: bool = False) -> None:
        """Keep the weights of a policy if they are as good as the best so far.

        Without validation states the latest weights are kept.

        Args:
            policy: with the weights to be evaluated.
            success: on the validation set.
            step: optimizer steps so far.
            progress: share of the run that is done.
            waiting: the patience begins later.
        """
        if waiting or success.succeeded > self.success.succeeded:
            self.wait(progress)
        if self._weights and success.states and success.succeeded < self.success.succeeded:
            return
        self.success, self.step = success, step
        self._weights = {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}

    def wait(self, progress: float) -> None:
        """Begin the patience anew: another phase trains, which may lose at first what the one before has learned."""
        self._risen = progress

    def over(self, progress: float) -> bool:
        """Return whether validation has not risen for so long that training ends; never before it is above zero."""
        return self.success.succeeded > 0 and 0 < self._patience < progress - self._risen

    def write(self, policy: Policy) -> None:
        """Write the best weights into a policy of the same kind; nothing if there are none yet."""
        if self._weights:
            policy.load_state_dict(self._weights)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the weights for a checkpoint."""
        return self._weights

    def state_dict(self) -> dict[str, Any]:
        """Return the rest of the state for a checkpoint."""
        return {
            "step": self.step,
            "risen": self._risen,
            "states": self.success.states,
            "succeeded": self.success.succeeded,
        }

    def load(self, tensors: dict[str, torch.Tensor], state: dict[str, Any], device: torch.device) -> None:
        """Restore both, the tensors with the prefix `best.`."""
        self._weights = {name: tensor.to(device) for name, tensor in below("best.", tensors).items()}
        self.step, self._risen = state["step"], state["risen"]
        self.success = Success(state["states"], state["succeeded"])
