"""Imitation: raise the probability of all actions that are known to keep a structure solvable, whichever it takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from falsework.errors import InputError
from falsework.learn.algorithms.nan_guard import NanGuard
from falsework.learn.algorithms.optimizer_state import load_saved, saved_tensors
from falsework.learn.config.train import ImitationSettings
from falsework.learn.data.random_walks import TaskSource
from falsework.learn.data.replay_buffer import Memory
from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.policy import Policy, masked_log_probabilities
from falsework.search.device.rules import TensorRules
from falsework.utils.collectives import average_gradients
from falsework.utils.distributed import Shards

_LOW = -1e30
"""Stands for minus infinity where one would make NaN of a gradient."""


def imitation_loss(logits: torch.Tensor, mask: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean of `-log(sum of the probabilities of the valid actions)` over the rows that have a valid action.

    Args:
        logits: shape (batch, actions).
        mask: legal actions, bool, shape (batch, actions).
        valid: actions to imitate; those that are not legal are none, such as where the image of a part under a
            symmetry has no free way out. Shape (batch, actions).
    """
    log_probability = masked_log_probabilities(logits, mask)
    valid = valid & mask
    known = valid.any(dim=1)
    # Rows without a valid action count for nothing; let them look at all actions, so that they make no NaN either.
    looked = torch.where(known[:, None], valid, mask)
    inside = torch.logsumexp(torch.where(looked, log_probability, _LOW), dim=1)
    return -(inside * known).sum() / known.sum().clamp(min=1)


def unlearning_loss(logits: torch.Tensor, mask: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """Mean of `-log(1 - probability)` of actions that bring something down, where there is another choice.

    Args:
        logits: shape (batch, actions).
        mask: legal actions, bool, shape (batch, actions).
        actions: shape (batch,).
    """
    log_probability = masked_log_probabilities(logits, mask)
    others = mask.scatter(1, actions[:, None], False)
    choice = others.any(dim=1)
    looked = torch.where(choice[:, None], others, mask)
    rest = torch.logsumexp(torch.where(looked, log_probability, _LOW), dim=1)
    return -(rest * choice).sum() / choice.sum().clamp(min=1)


def blend(tensors: Sequence[torch.Tensor], others: Sequence[torch.Tensor], share: float) -> None:
    """Move tensors by a share of the way to others, in place and in one call; all the way for 1."""
    with torch.no_grad():
        every: Any = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
        every(list(tensors), [other.detach() for other in others], share)


class Imitation:
    """Takes steps of AdamW on batches drawn on the device; nothing waits for the device between two reports."""

    def __init__(
        self,
        policy: Policy,
        rules: TensorRules,
        settings: ImitationSettings,
        *,
        seed: int = 0,
        precision: str = "float32",
        compiled: bool = False,
        shards: Shards = Shards(),
        folder: Path | str | None = None,
        copies: Sequence[Policy] = (),
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            policy: what is trained, in place.
            rules: legal actions.
            settings: filled in, see `TrainSettings.resolved`.
            seed: of the batches.
            precision: of the network.
            compiled: compile the network.
            shards: processes that share every batch and average their gradients.
            folder: where the batch goes whose loss is not finite.
            copies: policies with the very same weights for copies of the structure, as of
                `falsework.learn.networks.policy.share`; steps take the policy and them in turn.
        """
        if settings.batch < shards.size:
            raise InputError(f"a batch of {settings.batch} cannot be shared by {shards.size} processes; make it larger")
        self.policy = policy
        self.settings = settings
        self.shards = shards
        self.steps = 0
        """Steps taken."""
        self._rules = rules
        self._device = rules.device
        self._networks = [Network(one, precision, compiled=compiled) for one in (policy, *copies)]
        self._weights = [weight for weight in policy.parameters() if weight.requires_grad]
        # Steps of the size of the weight are for matrices; norms and biases are not pulled to zero.
        matrices = [weight for weight in self._weights if weight.dim() > 1]
        others = [weight for weight in self._weights if weight.dim() <= 1]
        groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._optimizer: Any = torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True, betas=(0.9, 0.98))
        self._generator = torch.Generator(self._device).manual_seed(seed * 1009 + shards.rank)
        self._average = [weight.detach().clone() for weight in self._weights]
        self._sums = torch.zeros(4, device=self._device)
        """Of losses, norms of the gradient, steps, and steps left out."""
        self._one = torch.ones((), device=self._device)
        self._left_out = torch.tensor([0.0, 0.0, 0.0, 1.0], device=self._device)
        self._guard = NanGuard(folder, rank=shards.rank)
        self._odd: torch.Tensor | None = None
        """States of the first batch since the last report whose gradient was not finite, if there was one."""

    def run(
        self,
        solved: SolvedStates,
        steps: int,
        progress: tuple[float, float],
        *,
        mistakes: Memory | None = None,
        outcomes: Memory | None = None,
        tasks: TaskSource | None = None,
    ) -> None:
        """Take some steps.

        Args:
            solved: states to draw from.
            steps: how many.
            progress: how much of the whole training is done before and after these steps, between 0 and 1.
            mistakes: actions to unlearn, as of `WatchedEnvironment`.
            outcomes: values to learn, likewise.
            tasks: draws states with targets, in place of `solved`.
        """
        self.policy.train()
        share = self.settings.batch // self.shards.size
        # All at once, since a draw takes as many small kernels for one task as for all of them.
        drawn = None if tasks is None else tasks.draw(steps * share, self._generator)
        for step in range(steps):
            place = progress[0] + (progress[1] - progress[0]) * step / steps
            rows = slice(step * share, (step + 1) * share)
            batch = None if drawn is None else (drawn[0][rows], drawn[1][rows], drawn[2][rows])
            loss = self._loss(solved, share, mistakes, outcomes, batch)
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            average_gradients(self._weights, self.shards)
            norm = torch.nn.utils.clip_grad_norm_(self._weights, self.settings.clip, foreach=True)
            rate = self.settings.learning_rate * self.schedule(self.steps, place)
            for group in self._optimizer.param_groups:
                group["lr"] = rate
            odd = ~norm.isfinite()
            self._optimizer.found_inf = odd.float()  # a step that is not finite is left out
            self._optimizer.step()
            self._note(odd)
            self.steps += 1
            # The first averages are over few steps, or they would remember the random weights of the beginning.
            keep = min(self.settings.average, (1 + self.steps) / (10 + self.steps))
            blend(self._average, self._weights, 1.0 - keep)
            numbers = torch.stack([loss.detach(), norm.detach(), self._one, odd.float()])
            self._sums += torch.where(odd, self._left_out, numbers)
        self.policy.eval()

    def schedule(self, step: int, progress: float) -> float:
        """Learning rate as a share of the largest: a rise by steps, a plateau, half a cosine by progress."""
        settings = self.settings
        rise = min((step + 1) / max(settings.warm_up, 1), 1.0)
        fallen = min(max((progress - 1.0 + settings.decay) / max(settings.decay, 1e-9), 0.0), 1.0)
        least = settings.least_learning_rate
        return rise * (least + (1 - least) * 0.5 * (1 + math.cos(math.pi * fallen)))

    def report(self) -> dict[str, float]:
        """Means since the last report; waits for the device.

        Raises:
            TrainingError: the loss or its gradient was not finite in between; these steps were left out.
        """
        loss, norm, count, odd = self._sums.tolist()
        self._sums.zero_()
        if odd and self._odd is not None:
            self._guard.watch(torch.tensor(torch.nan), {"states": self._odd}, f"step {self.steps}")
            self._guard.check()
        return {"loss": loss / max(count, 1), "gradient_norm": norm / max(count, 1)}

    def adopt(self, policy: Policy) -> None:
        """Begin with the weights of another policy of the same kind."""
        self.policy.load_state_dict(policy.state_dict())
        with torch.no_grad():
            blend(self._average, self._weights, 1.0)

    def averaged(self, policy: Policy) -> Policy:
        """Write the moving average of the weights into another policy of the same kind."""
        with torch.no_grad():
            blend([weight for weight in policy.parameters() if weight.requires_grad], self._average, 1.0)
        return policy.eval()

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save, for `load`."""
        saved = saved_tensors(self.policy, self._optimizer, self._average)
        saved["steps"] = torch.tensor([self.steps])
        saved["sums"] = self._sums
        return saved

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Go back to what `tensors` gave."""
        load_saved(tensors, self.policy, self._optimizer, self._average)
        self.steps = int(tensors["steps"][0])
        self._sums.copy_(tensors["sums"])

    def generator_state(self) -> torch.Tensor:
        """Where the random numbers of this process are."""
        return self._generator.get_state()

    def set_generator_state(self, state: torch.Tensor) -> None:
        """Go back to random numbers that `generator_state` gave."""
        self._generator.set_state(state.cpu())

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on."""
        self._generator.manual_seed(seed)

    def _note(self, odd: torch.Tensor) -> None:
        """Keep the batch if its step was not finite and it is the first such since the last report."""
        if self._odd is None or self._odd.shape != self._batch.shape:
            self._odd = self._batch.clone()
        first = odd & (self._sums[3] == 0)
        self._odd = torch.where(first, self._batch, self._odd)

    def _loss(
        self,
        solved: SolvedStates,
        count: int,
        mistakes: Memory | None,
        outcomes: Memory | None,
        tasks: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None,
    ) -> torch.Tensor:
        settings = self.settings
        if tasks is None:
            rows = torch.randint(len(solved), (count,), generator=self._generator, device=self._device)
            states, aims = solved.states[rows], None
            mask = self._rules.moves(states)
            valid = solved.valid_actions(states, mask)
        else:
            states, aims, valid = tasks
            mask = self._rules.moves(states, aims)
        sizes = [count]
        wrong = value = None
        if tasks is None and mistakes is not None and len(mistakes) and settings.unstable:
            wrong = mistakes.draw(max(settings.mistakes // self.shards.size, 1), self._generator)
            states = torch.cat([states, wrong["states"]])
            sizes.append(len(wrong["states"]))
        if tasks is None and outcomes is not None and len(outcomes) and settings.value:
            value = outcomes.draw(max(settings.mistakes // self.shards.size, 1), self._generator)
            states = torch.cat([states, value["states"]])
            sizes.append(len(value["states"]))
        self._batch = states
        logits, estimate = self._networks[self.steps % len(self._networks)](states, aims)
        logit_parts, estimate_parts = list(logits.split(sizes)), list(estimate.split(sizes))
        loss = imitation_loss(logit_parts.pop(0), mask, valid)
        # All stored states are solvable; only rollouts can say where the policy fails none the less.
        loss = loss + settings.value * ((estimate_parts.pop(0) - 1.0) ** 2).mean() * (value is None)
        if wrong is not None:
            estimate_parts.pop(0)
            mask = self._rules.moves(wrong["states"])
            loss = loss + settings.unstable * unlearning_loss(logit_parts.pop(0), mask, wrong["actions"])
        if value is not None:
            loss = loss + settings.value * ((estimate_parts.pop(0) - value["value"]) ** 2).mean()
        return loss
