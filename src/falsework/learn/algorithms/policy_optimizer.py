"""AdamW with a moving average of the weights and a guard against steps that are not finite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from falsework.errors import TrainingError
from falsework.utils.collectives import average_gradients
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import below

_MAX_GRADIENT_NORM = 1.0
"""Norm to which larger gradients are clipped."""


class PolicyOptimizer:
    """Optimizer of a policy that all learners share: gradients averaged over processes, clipped, guarded."""

    def __init__(
        self,
        policy: torch.nn.Module,
        *,
        learning_rate: float,
        weight_decay: float = 0.0,
        only_matrices: bool = False,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
        shards: ProcessGroup = ProcessGroup(),
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            policy: trained in place.
            learning_rate: initial one.
            weight_decay: of AdamW.
            only_matrices: no decay of norms and biases.
            betas: decay of the moments.
            epsilon: added to the root of the second moment.
            shards: processes that average their gradients.
        """
        self.policy = policy
        self.steps = 0
        """Steps taken."""
        self._weights = [weight for weight in policy.parameters() if weight.requires_grad]
        self._average = [weight.detach().clone() for weight in self._weights]
        self._shards = shards
        decayed = [one for one in self._weights if one.dim() > 1 or not only_matrices]
        others = [one for one in self._weights if one.dim() <= 1 and only_matrices]
        groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._adam: Any = torch.optim.AdamW(groups, lr=learning_rate, betas=betas, eps=epsilon, fused=True)
        self._pending: tuple[torch.Tensor, torch.cuda.Event | None, int] | None = None
        """Whether the last step was finite, the event after which the host knows, and the number of the step."""

    def step(self, loss: torch.Tensor, *, learning_rate: float, average: float) -> torch.Tensor:
        """Take one step; one that is not finite changes no weight and is reported by the next step or by `check`.

        Args:
            loss: of this process, differentiable.
            learning_rate: of this step.
            average: decay of the moving average of the weights.

        Returns:
            Norm of the gradient before clipping, on the device.

        Raises:
            TrainingError: the step before this one was not finite.
        """
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        average_gradients(self._weights, self._shards)
        norm = torch.nn.utils.clip_grad_norm_(self._weights, _MAX_GRADIENT_NORM, foreach=True)
        for group in self._adam.param_groups:
            group["lr"] = learning_rate
        self._adam.found_inf = (~norm.isfinite()).float()  # the fused kernel then leaves the weights alone
        self._adam.step()
        self.steps += 1
        _blend(self._average, self._weights, 1.0 - average)
        self.check()
        finite, event = norm.detach().isfinite(), None
        if finite.is_cuda:  # looked at after the next step, so that the host does not wait for the device
            finite, event = finite.to("cpu", non_blocking=True), torch.cuda.Event()
            event.record()
        self._pending = finite, event, self.steps
        return norm.detach()

    def check(self) -> None:
        """Check the last step, for instance at the end of a block.

        Raises:
            TrainingError: it was not finite; of several processes all see the same norm, so all of them stop.
        """
        (finite, event, step), self._pending = self._pending or (True, None, 0), None
        if event is not None:
            event.synchronize()
        if not finite:
            raise TrainingError(
                f"the loss is not a finite number at step {step}; continue from the last checkpoint with a lower "
                "learning rate"
            )

    def export_policy(self, policy: torch.nn.Module) -> None:
        """Write the moving average of the weights, and all else that a policy remembers, into another of its kind."""
        policy.load_state_dict(self.policy.state_dict())
        _blend([weight for weight in policy.parameters() if weight.requires_grad], self._average, 1.0)

    def load_policy(self, policy: torch.nn.Module) -> None:
        """Continue with the weights of another policy of the same kind."""
        self.policy.load_state_dict(policy.state_dict())
        _blend(self._average, self._weights, 1.0)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return weights, their average, moments and count of steps as plain named tensors."""
        saved = {f"weight.{name}": tensor for name, tensor in self.policy.state_dict().items()}
        saved |= {f"average.{place}": tensor for place, tensor in enumerate(self._average)}
        for place, state in self._adam.state_dict()["state"].items():
            saved |= {f"optimizer.{place}.{name}": torch.as_tensor(value) for name, value in state.items()}
        return {**saved, "steps": torch.tensor([self.steps])}

    def load_state_dict(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Restore the tensors of `state_dict`; other names are ignored."""
        self.steps = int(tensors["steps"][0])
        self.policy.load_state_dict(below("weight.", tensors))
        for place, one in enumerate(self._average):
            one.copy_(tensors[f"average.{place}"])
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, one in tensors.items():
            if name.startswith("optimizer."):
                _, place, key = name.split(".", 2)
                state.setdefault(int(place), {})[key] = one.clone()
        self._adam.load_state_dict({**self._adam.state_dict(), "state": state})


@torch.no_grad()
def _blend(tensors: Sequence[torch.Tensor], others: Sequence[torch.Tensor], share: float) -> None:
    """Move tensors by a share of the way to others, in place and in one call; all the way for 1."""
    every: Any = torch._foreach_lerp_
    every(list(tensors), [other.detach() for other in others], share)
