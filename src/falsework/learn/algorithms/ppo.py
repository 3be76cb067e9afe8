"""Proximal policy optimisation (Schulman et al. 2017) on batches of whole rollouts.

By default it improves a policy that imitation has prepared: rollouts from mixed start states, no discount, a value head
that estimates the return, and an additional imitation loss on known states. `config.ppo.REINFORCEMENT` trains from
scratch, as the paper does (section 5.2).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from falsework.learn.algorithms.advantages import explained_variance, normalized
from falsework.learn.algorithms.imitation import imitation_loss
from falsework.learn.algorithms.learner import Learner
from falsework.learn.algorithms.learner_context import LearnerContext
from falsework.learn.algorithms.ppo_loss import Loss, ppo_loss
from falsework.learn.algorithms.removals import Removals
from falsework.learn.algorithms.rollout_storage import Transitions, collect_transitions
from falsework.learn.algorithms.start_states import StartBatch
from falsework.learn.networks.autocast import Network
from falsework.utils.collectives import summed
from falsework.utils.tensors import below

_IMITATED = 0.25
"""States imitated per step, as a share of the batch."""
_FINAL_LEARNING_RATE = 0.1
"""Learning rate at the end of a phase, as a share of the initial one."""
_WARM_UP = 50
"""With goals: steps over which the learning rate rises, so that values change without harm to actions."""
_BETAS, _EPSILON = (0.95, 0.999), 1e-5
"""Of AdamW, which decays no weights."""
_ENTROPY_STEP, _ENTROPY_MOST = 1.5, 20.0
"""Factor by which the weight of the entropy changes after a collection, and the most that it may be multiplied by."""
_MOST_SOLVED = 20_000_000
"""States known to be solvable beyond which no more are stored."""


class PPO(Learner):
    """Proximal policy optimisation from the outcomes of the policy's own rollouts.

    No loss is taken at held-out states: not by gradients of rollouts, not by imitation.
    """

    def __init__(self, given: LearnerContext) -> None:
        """Begin with the weights that the policy has."""
        settings, shards = given.phase, given.shards
        super().__init__(
            given.policy,
            given.environment.generator(given.seed * 1009 + 700 + shards.rank),
            given.seed,
            shards,
            learning_rate=settings.learning_rate,
            betas=_BETAS,
            epsilon=_EPSILON,
        )
        self.updates = 0
        """Collections learned from."""
        self.entropy_factor = 1.0
        """Of the weight of the entropy; above 1 where the entropy was below its floor."""
        self.environment, self.sampler, self.solved = given.environment, given.starts, given.solved
        self._settings, self._begin, self._reward = settings, given.begin, given.reward
        self._compiled = given.compiled
        self.network = Network(given.policy, given.precision, compiled=given.compiled)
        self._playing = Network(given.policy, given.precision)
        self._share = max(settings.batch // shards.size, 1)
        """Transitions per step of this process."""

    @property
    def widening(self) -> bool:
        """See `Learner.widening`."""
        return self.sampler.widening

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """See `Learner.block`; an update that begins is finished."""
        left, numbers = steps, {}
        while left > 0:
            before = self.steps
            rollouts = max(self._settings.rollouts // self.shards.size, 1)
            done = 1.0 - left / steps
            place = progress[0] + (progress[1] - progress[0]) * done
            batch = self.sampler.sample(rollouts, self.generator)
            numbers = self.update(batch, progress=place)
            left -= max(self.steps - before, 1)
            numbers |= {"updates": float(self.updates), "solved": float(len(self.solved))}
            self.listener(numbers)
        return numbers

    def update(self, batch: StartBatch, *, progress: float = 0.0) -> dict[str, float]:
        """Sample a rollout from each start and update the policy with all of them.

        Args:
            batch: starts.
            progress: of the whole training, for the learning rate.

        Returns:
            Means over all processes: `rollout_success`, `rollout_return`, `loss`, `surrogate_loss`, `value_loss`,
            `entropy`, `kl`, `clipped`, `explained_variance`, `learning_rate`, number of `transitions`, and the report
            of the sampler.

        Raises:
            InputError: the reward is not a finite number for each action, or too large.
            TrainingError: a step was not finite.
        """
        settings, device = self._settings, batch.states.device
        self.policy.eval()
        transitions = collect_transitions(
            self.environment,
            self._playing,
            batch.states,
            batch.targets,
            self.generator,
            discount=settings.discount,
            gae_lambda=settings.gae_lambda,
            reward=self._reward,
        )
        if batch.targets is None and len(self.solved) < _MOST_SOLVED:
            self.solved.add(transitions.states[transitions.success[transitions.rollout]])
        explained = explained_variance(transitions.advantage, transitions.returns, self.shards)
        learnable = transitions.take((~self.solved.is_held_out(transitions.states)).nonzero()[:, 0])
        advantage = learnable.advantage
        if batch.targets is not None and self.updates == 0 and self._begin > 0.0:
            # Imitation has taught the value head that all ends well: it has no advantages of the first rollouts.
            advantage = learnable.success[learnable.rollout].float()
        learnable = replace(learnable, advantage=normalized(advantage, self.shards))
        count = len(learnable)
        if count == 0:  # zero weight: other processes average their gradients with this one
            goals = None if batch.targets is None else batch.targets[:1]
            learnable = Transitions.blank(batch.states[:1], goals, transitions.success)
        asks = settings.removals and batch.targets is not None and count
        removals = Removals.draw(self.environment, learnable, self.generator) if asks else None
        rollouts = len(batch.states)
        entropy = torch.full((rollouts,), settings.entropy, device=device) if batch.entropy is None else batch.entropy
        entropy = entropy * self.entropy_factor
        weight = torch.ones(rollouts, device=device) if batch.weight is None else batch.weight
        rate = self.learning_rate(progress)
        sums, surrogate = torch.zeros(6, device=device), torch.zeros(rollouts, device=device)
        taken = self.steps
        self.policy.train()
        for _ in range(settings.epochs):
            pieces = self.minibatches(count)
            imitated = self.demonstrations(transitions, len(pieces))
            for (rows, counts), shown in zip(pieces, imitated, strict=True):
                piece = learnable.take(rows)
                weights = weight[piece.rollout] * counts
                known = None if removals is None else removals.take(rows)
                loss, total = self._loss(piece, weights, entropy[piece.rollout], shown, known)
                risen = 1.0 if batch.targets is None else min((self.steps + 1) / _WARM_UP, 1.0)
                self.optimizer.step(total, learning_rate=rate * risen, average=settings.average)
                surrogate.index_add_(0, piece.rollout, loss.surrogate.abs() * counts)
                sums += torch.cat([total.detach()[None], loss.statistics])
        self.optimizer.check()
        self.policy.eval()
        self.updates += 1
        seen = torch.bincount(learnable.rollout[:count], minlength=rollouts)
        self.sampler.record(batch, transitions, surrogate / (settings.epochs * seen).clamp(min=1), self.generator)
        numbers = self._report(transitions, sums / max(self.steps - taken, 1))
        low = numbers["entropy"] < settings.entropy_floor * (1.0 - self._through(progress))
        factor = self.entropy_factor * (_ENTROPY_STEP if low else 1.0 / _ENTROPY_STEP)
        self.entropy_factor = min(max(factor, 1.0), _ENTROPY_MOST)
        return {**numbers, "explained_variance": explained, "learning_rate": rate, **self.sampler.report()}

    def learning_rate(self, progress: float) -> float:
        """Return the learning rate of the next update."""
        return self._settings.learning_rate * (1.0 - (1.0 - _FINAL_LEARNING_RATE) * self._through(progress))

    def _through(self, progress: float) -> float:
        """Return the share of this phase that is done."""
        return min(max((progress - self._begin) / max(1.0 - self._begin, 1e-9), 0.0), 1.0)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """See `Learner.state_dict`."""
        saved = {f"starts.{name}": tensor for name, tensor in self.sampler.state_dict().items()}
        counts = {"updates": torch.tensor([self.updates]), "entropy_factor": torch.tensor([self.entropy_factor])}
        return {**super().state_dict(), **saved, **counts}

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """See `Learner.local_state_dict`."""
        saved = {f"starts.{name}": tensor for name, tensor in self.sampler.local_state_dict().items()}
        return {**saved, **super().local_state_dict()}

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `Learner.load_state_dict`."""
        super().load_state_dict(tensors, local)
        self.updates, self.entropy_factor = int(tensors["updates"][0]), float(tensors["entropy_factor"][0])
        self.sampler.load_state_dict(below("starts.", tensors), None if local is None else below("starts.", local))

    def minibatches(self, count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Draw all transitions in random order, in equally many minibatches of one size in every process.

        Padding has weight 0. For a compiled network, which needs one size, minibatches are padded to the full one.

        Args:
            count: transitions of this process.
        """
        device, most = self.generator.device, count
        if self.shards.size > 1:
            most = int(self.shards.gather(torch.tensor([count], device=device)).max())
        number = -(-most // self._share)
        size = self._share if self._compiled else -(-most // max(number, 1))
        rows = torch.zeros((number, size), dtype=torch.int64, device=device)
        used = torch.zeros((number, size), device=device)
        place = torch.arange(count, device=device)
        spot = place % max(number, 1), place // max(number, 1)
        rows[spot], used[spot] = torch.randperm(count, generator=self.generator, device=device), 1.0
        return list(zip(rows, used, strict=True))

    def demonstrations(self, transitions: Transitions, steps: int) -> list[torch.Tensor | None]:
        """Draw the states that are imitated in each of some steps; None where nothing is."""
        if not (self._settings.imitation and transitions.targets is None and len(self.solved)):
            return [None] * steps
        size = steps, max(round(self._share * _IMITATED), 1)
        rows = torch.randint(len(self.solved), size, generator=self.generator, device=transitions.states.device)
        return [self.solved.states[row] for row in rows]

    def _loss(
        self,
        batch: Transitions,
        weight: torch.Tensor,
        entropy_weight: torch.Tensor,
        shown: torch.Tensor | None,
        removals: Removals | None,
    ) -> tuple[Loss, torch.Tensor]:
        """Compute the PPO loss, and the total with the other losses, in one call of the network."""
        states = batch.states if shown is None else torch.cat([batch.states, shown])
        logits, value = self.network(states, batch.targets)
        count = len(batch)
        loss = ppo_loss(logits[:count], value[:count], batch, weight=weight, entropy_weight=entropy_weight)
        total = loss.total
        if removals is not None:
            total = total + self._settings.removals * removals.loss(logits[:count], batch.mask, weight)
        if shown is not None:
            mask = self.environment.rules.moves(shown)
            valid = self.solved.valid_actions(shown, mask)
            total = total + self._settings.imitation * imitation_loss(logits[count:], mask, valid)
        return loss, total

    def _report(self, transitions: Transitions, means: torch.Tensor) -> dict[str, float]:
        rollouts = transitions.success
        sums = [float(one) for one in (rollouts.sum(), transitions.total.sum(), len(rollouts), len(transitions))]
        *totals, success, returns, count, moves = summed([*means.tolist(), *sums], self.shards, means.device)
        names = ("loss", "surrogate_loss", "value_loss", "entropy", "kl", "clipped")
        averages = {name: total / self.shards.size for name, total in zip(names, totals, strict=True)}
        played = {"rollout_success": success / max(count, 1.0), "rollout_return": returns / max(count, 1.0)}
        return {**played, "transitions": moves, **averages}
