"""Proximal policy optimisation (Schulman et al. 2017), as the paper trains its policies (section 5.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from falsework.learn.algorithms.hindsight import relabel
from falsework.learn.algorithms.nan_guard import NanGuard
from falsework.learn.algorithms.optimizer_state import load_saved, saved_tensors
from falsework.learn.algorithms.rollout_storage import Storage
from falsework.learn.config.ppo import PpoSettings
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import Rollouts, play
from falsework.learn.networks.policy import masked_log_probabilities
from falsework.utils.collectives import average_gradients, summed
from falsework.utils.distributed import Shards

if TYPE_CHECKING:
    from falsework.learn.algorithms.curriculum import Curriculum

_ADAM_EPSILON = 1e-5


@dataclass(frozen=True, eq=False)
class Outcome:
    """How the rollouts of one update ended, for the curriculum."""

    success: torch.Tensor
    """`bool`, shape (rollouts,)."""
    surrogate: torch.Tensor
    """Mean size of the surrogate loss over the actions of each rollout and all epochs, shape (rollouts,)."""


@dataclass(frozen=True, eq=False)
class Batch:
    """State-action pairs of one step of the optimizer; the padding at the end has weight 0."""

    states: torch.Tensor
    mask: torch.Tensor
    actions: torch.Tensor
    log_probability: torch.Tensor
    advantage: torch.Tensor
    returns: torch.Tensor
    weight: torch.Tensor
    entropy: torch.Tensor
    """Weight of the entropy."""
    rollout: torch.Tensor
    targets: torch.Tensor | None

    def tensors(self) -> dict[str, torch.Tensor]:
        """By name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class Loss:
    """The loss of a batch and what it is made of."""

    total: torch.Tensor
    surrogate: torch.Tensor
    """Of each pair, shape (batch,)."""
    statistics: torch.Tensor
    """Surrogate loss, value error, entropy, divergence, share of clipped ratios; means, shape (5,)."""


def ppo_loss(logits: torch.Tensor, value: torch.Tensor, batch: Batch, clip: float, value_weight: float) -> Loss:
    """Clipped surrogate loss, squared error of the value, and entropy.

    Args:
        logits: shape (batch, 2 parts).
        value: shape (batch,).
        batch: what was done, and what came of it.
        clip: how far the ratio of probabilities may go from 1.
        value_weight: weight of the error of the value.
    """
    log_probability = masked_log_probabilities(logits, batch.mask)
    taken = log_probability.gather(1, batch.actions[:, None])[:, 0]
    logarithm = taken - batch.log_probability
    ratio = logarithm.exp()
    surrogate = -torch.min(ratio * batch.advantage, ratio.clamp(1 - clip, 1 + clip) * batch.advantage)
    error = (value - batch.returns).square()
    # An illegal action has probability zero and adds nothing; its logarithm is minus infinity and would make NaN.
    finite = log_probability.masked_fill(~batch.mask, 0.0)
    entropy = -(finite.exp() * batch.mask * finite).sum(dim=1)
    count = batch.weight.count_nonzero().clamp(min=1)
    per_pair = surrogate + value_weight * error - batch.entropy * entropy
    with torch.no_grad():
        counted = batch.weight > 0
        clipped = ((ratio - 1).abs() > clip).float()
        # http://joschu.net/blog/kl-approx.html: never negative, and of small variance.
        divergence = (ratio - 1) - logarithm
        columns = torch.stack([surrogate, error, entropy, divergence, clipped])
        statistics = torch.where(counted, columns, 0.0).sum(dim=1) / count
    return Loss((per_pair * batch.weight).sum() / count, surrogate.detach(), statistics)


class PPO:
    """Makes a policy better by what its own rollouts came to."""

    def __init__(
        self,
        policy: torch.nn.Module,
        environment: Environment,
        settings: PpoSettings = PpoSettings(),
        generator: torch.Generator | None = None,
        *,
        shards: Shards = Shards(),
        folder: Path | str | None = None,
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            policy: called as `policy(states, targets)`; trained in place.
            environment: rules and verdicts.
            settings: of the method.
            generator: source of randomness on the device of the environment, another one in every process; seed 0 of
                the environment plus the rank if not given.
            shards: processes that each play rollouts of their own and average their gradients.
            folder: where a batch goes whose loss is not finite.
        """
        self.policy = policy
        self.environment = environment
        self.settings = settings
        self.shards = shards
        self.generator = environment.generator(shards.rank) if generator is None else generator
        self.updates = 0
        """Updates so far."""
        self.rate = 1.0
        """What the learning rate is multiplied with besides its milestones, for schedules that know the time."""
        self.outcome: Outcome | None = None
        """Of the last update."""
        self._weights = [weight for weight in policy.parameters() if weight.requires_grad]
        self._optimizer: Any = torch.optim.Adam(
            self._weights, lr=settings.learning_rate, betas=settings.betas, eps=_ADAM_EPSILON, fused=True
        )
        self._guard = NanGuard(folder, rank=shards.rank)
        self._storage: Storage | None = None

    @property
    def learning_rate(self) -> float:
        """Step of Adam in the next update."""
        passed = sum(milestone <= self.updates for milestone in self.settings.milestones)
        return self.settings.learning_rate * self.rate * 0.1**passed

    def learn(self, curriculum: Curriculum, rollouts: int) -> dict[str, float]:
        """One update with rollouts from start states that a curriculum draws, which then hears how they ended.

        Args:
            curriculum: start states, and how much to explore from each.
            rollouts: how many, in this process.

        Returns:
            As `update`, and how far the curriculum is.
        """
        draw = curriculum.draw(rollouts)
        report = self.update(draw.starts, draw.targets, entropy=draw.entropy, weight=draw.weight)
        assert self.outcome is not None
        curriculum.learn(draw, self.outcome.success, self.outcome.surrogate)
        return {**report, **curriculum.report()}

    def update(
        self,
        starts: torch.Tensor,
        targets: torch.Tensor | None = None,
        *,
        entropy: torch.Tensor | None = None,
        weight: torch.Tensor | None = None,
    ) -> dict[str, float]:
        """Play a rollout from each start, actions drawn, and learn from all of them.

        Args:
            starts: stable states, shape (rollouts, parts).
            targets: shape (rollouts, parts), or None.
            entropy: weight of the entropy for each rollout, shape (rollouts,); that of the settings if not given.
            weight: of each rollout in the loss, above zero, shape (rollouts,); 1 if not given.

        Returns:
            Means over all processes: `success` of the drawn rollouts, `surrogate_loss`, `value_loss`, `entropy`,
            `divergence`, `clipped`, and `steps` taken in the environment, `learning_rate`.

        Raises:
            TrainingError: a loss that is not finite.
        """
        storage = self._play(starts, targets)
        place, rollout = storage.pairs()
        pairs, device = len(place), starts.device
        if pairs == 0:  # another process may have something to learn: take part in its averages with nothing
            place = rollout = torch.zeros(1, dtype=torch.int64, device=device)
        advantage, returns = (values.reshape(-1) for values in self._returns(storage))
        advantage, returns = (values[place] if pairs else values.new_zeros(1) for values in (advantage, returns))
        if entropy is None:
            entropy = torch.full((len(starts),), self.settings.curriculum.entropy, device=device)
        weight = torch.ones(len(starts), device=device) if weight is None else weight
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        sums = torch.zeros(5, device=device)
        surrogate = torch.zeros(len(starts), device=device)
        steps = epochs = 0
        hindsight = self._hindsight(storage)
        self.policy.train()
        for epoch in range(self.settings.epochs):
            divergence = torch.zeros((), device=device)
            begun = steps
            for rows, counts in self._minibatches(pairs):
                batch = self._batch(storage, place[rows], rollout[rows], advantage[rows], returns[rows], entropy)
                batch = _weighted(batch, weight[batch.rollout] * counts)
                loss = self._step(batch, hindsight, f"update {self.updates + 1} epoch {epoch + 1} step {steps + 1}")
                surrogate.index_add_(0, batch.rollout, loss.surrogate.abs() * counts)
                sums += loss.statistics
                divergence += loss.statistics[3]
                steps += 1
            epochs += 1
            limit = self.settings.target_divergence
            if (
                limit
                and summed([float(divergence)], self.shards, device)[0] > limit * (steps - begun) * self.shards.size
            ):
                break  # all processes see the same sum
        self._guard.check()
        self.policy.eval()
        taken = storage.taken[: storage.steps].sum(dim=0)
        self.outcome = Outcome(storage.success.clone(), surrogate / (epochs * taken).clamp(min=1))
        self.updates += 1
        return self._report(storage, sums / max(steps, 1), pairs)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Weights and optimizer, which are the same in all processes, to save; for `load`."""
        saved = saved_tensors(self.policy, self._optimizer)
        return {**saved, "updates": torch.tensor([self.updates])}

    def own_tensors(self) -> dict[str, torch.Tensor]:
        """The source of randomness, which every process has for itself."""
        return {"generator": self.generator.get_state()}

    def load(self, tensors: dict[str, torch.Tensor], own: dict[str, torch.Tensor] | None = None) -> None:
        """Go back to what `tensors` and `own_tensors` gave; without the latter, randomness goes on where it is."""
        load_saved(tensors, self.policy, self._optimizer)
        self.updates = int(tensors["updates"][0])
        if own is not None:
            self.generator.set_state(own["generator"].cpu())

    def _play(self, starts: torch.Tensor, targets: torch.Tensor | None) -> Storage:
        """Rollouts with drawn actions."""
        rules = self.environment.rules
        most = 2 * int((~rules.task.boundary).sum())
        storage = self._storage
        if storage is None or not storage.fits(most, len(starts), targets=targets is not None):
            storage = Storage(most, len(starts), rules.part_count, starts.device, targets=targets is not None)
            self._storage = storage
        storage.clear(rules.reached(starts, targets), targets)
        self.policy.eval()
        for move in play(self.environment, self.policy, starts, targets, greedy=False, generator=self.generator):
            log_probability = masked_log_probabilities(move.logits, move.mask)
            storage.write(move, log_probability.gather(1, move.actions[:, None])[:, 0])
        return storage

    def _returns(self, storage: Storage) -> tuple[torch.Tensor, torch.Tensor]:
        """Advantages, with mean 0 and deviation 1 over all processes, and returns; shape (steps, rollouts)."""
        advantage, returns = storage.returns(self.settings.discount, self.settings.trace)
        taken = storage.taken[: storage.steps]
        parts = torch.stack([taken.sum(), advantage.sum(), advantage.square().sum()])
        count, total, squares = summed(parts.tolist(), self.shards, parts.device)
        mean = total / max(count, 1)
        deviation = max(squares / max(count, 1) - mean * mean, 0.0) ** 0.5
        return (advantage - mean) / (deviation + 1e-7), returns

    def _minibatches(self, pairs: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Rows of all pairs in random order, in pieces of one size, as many in every process.

        Yields:
            Rows, and 1 for each that counts, 0 for what fills the last piece up.
        """
        device = self.generator.device
        size = max(self.settings.batch // self.shards.size, 1)
        most = pairs
        if self.shards.size > 1:
            most = int(self.shards.gather(torch.tensor([pairs], device=device)).max())
        order = torch.randperm(pairs, generator=self.generator, device=device)
        number = -(-most // size)
        size = -(-most // max(number, 1))
        filled = torch.zeros(number * size, dtype=torch.int64, device=device)
        filled[:pairs] = order
        counts = (torch.arange(number * size, device=device) < pairs).float()
        if number:
            yield from zip(filled.split(size), counts.split(size), strict=True)

    def _batch(
        self,
        storage: Storage,
        place: torch.Tensor,
        rollout: torch.Tensor,
        advantage: torch.Tensor,
        returns: torch.Tensor,
        entropy: torch.Tensor,
    ) -> Batch:
        return Batch(
            states=storage.states.flatten(0, 1)[place],
            mask=storage.mask.flatten(0, 1)[place],
            actions=storage.actions.flatten()[place],
            log_probability=storage.log_probability.flatten()[place],
            advantage=advantage,
            returns=returns,
            weight=torch.ones_like(advantage),
            entropy=entropy[rollout],
            rollout=rollout,
            targets=None if storage.targets is None else storage.targets[rollout],
        )

    def _hindsight(self, storage: Storage) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None:
        """States, targets and actions of failed rollouts, as many as there are pairs in a step."""
        if storage.targets is None or not self.settings.hindsight or not storage.steps:
            return None
        used = slice(0, storage.steps)
        # The last state of a rollout was not written down, and all others stand.
        passed = (storage.taken[used].sum(dim=0) - 1).clamp(min=0)
        stands = torch.zeros_like(storage.success)
        rollouts = Rollouts(storage.states[used], storage.actions[used], passed, storage.success, stands)
        samples = relabel(rollouts, max(self.settings.batch // self.shards.size, 1), self.generator)
        return samples if len(samples[0]) else None

    def _imitate(self, samples: tuple[torch.Tensor, torch.Tensor, torch.Tensor], count: int) -> torch.Tensor:
        """Mean of the negative logarithm of the probability of the actions of some samples."""
        rows = torch.randint(len(samples[0]), (count,), generator=self.generator, device=samples[0].device)
        states, targets, actions = (column[rows] for column in samples)
        logits, _ = self.policy(states, targets)
        log_probability = masked_log_probabilities(logits, self.environment.rules.moves(states, targets))
        return -log_probability.gather(1, actions[:, None]).mean()

    def _step(self, batch: Batch, hindsight: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None, name: str) -> Loss:
        settings = self.settings
        logits, value = self.policy(batch.states, batch.targets)
        loss = ppo_loss(logits.float(), value.float(), batch, settings.clip, settings.value)
        total = loss.total
        if hindsight is not None:
            total = total + settings.hindsight * self._imitate(hindsight, -(-len(batch.states) // 4))
        self._optimizer.zero_grad(set_to_none=True)
        total.backward()
        average_gradients(self._weights, self.shards)
        norm = torch.nn.utils.clip_grad_norm_(self._weights, settings.gradient_norm, foreach=True)
        self._optimizer.found_inf = (~norm.isfinite()).float()  # a step that is not finite is left out
        self._optimizer.step()
        self._guard.watch(norm + total.detach(), batch.tensors(), name)
        return loss

    def _report(self, storage: Storage, means: torch.Tensor, pairs: int) -> dict[str, float]:
        sums = [*means.tolist(), float(storage.success.sum()), float(len(storage.success)), float(pairs)]
        *means_summed, success, rollouts, steps = summed(sums, self.shards, means.device)
        names = ("surrogate_loss", "value_loss", "entropy", "divergence", "clipped")
        return {
            "success": success / rollouts,
            **{name: value / self.shards.size for name, value in zip(names, means_summed, strict=True)},
            "steps": steps,
            "learning_rate": self.learning_rate,
        }


def _weighted(batch: Batch, weight: torch.Tensor) -> Batch:
    return Batch(**{**vars(batch), "weight": weight})
