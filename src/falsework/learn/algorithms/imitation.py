"""Imitation of sets of valid actions: raise the probability of all that are known to keep a structure solvable."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch

from falsework.errors import InputError
from falsework.learn.algorithms.learner import Learner
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.data.random_walks import GoalSampler
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.policy import Policy, masked_log_probabilities
from falsework.utils.distributed import ProcessGroup

_LOW = -1e30
"""Stands for minus infinity where one would make NaN of a gradient."""
_FINAL_LEARNING_RATE = 0.01
"""Learning rate at the end, as a share of the largest."""
_WEIGHT_DECAY = 0.01
"""Of matrices, by AdamW."""
_BETAS = (0.9, 0.98)
"""Decay of the moments of AdamW."""
_AVERAGE = 0.998
"""Decay of the moving average of the weights that is evaluated and saved."""
_VALUE_WEIGHT = 0.1
"""Weight of the squared error of the value head: all stored states are solvable, so their value is 1."""


def imitation_loss(logits: torch.Tensor, mask: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Return the mean of `-log(sum of the probabilities of the valid actions)` over the rows that have a valid action.

    Args:
        logits: shape (batch, actions).
        mask: legal actions, bool, shape (batch, actions).
        valid: actions to imitate; those that are not legal are none, such as where the image of a part under a
            symmetry has no free way out. Shape (batch, actions).
    """
    log_probability = masked_log_probabilities(logits, mask)
    valid = valid & mask
    known = valid.any(dim=1)
    # Rows without a valid action have weight zero; they use all actions, so that they yield no NaN.
    looked = torch.where(known[:, None], valid, mask)
    inside = torch.logsumexp(torch.where(looked, log_probability, _LOW), dim=1)
    return -(inside * known).sum() / known.sum().clamp(min=1)


class Imitation(Learner):
    """Imitation learner on batches of solvable states drawn on the device."""

    def __init__(
        self,
        policy: Policy,
        solved: SolvableStates,
        settings: ImitationPhase,
        *,
        tasks: GoalSampler | None = None,
        seed: int = 0,
        precision: str = "float32",
        compiled: bool = False,
        shards: ProcessGroup = ProcessGroup(),
        copies: Sequence[Policy] = (),
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            policy: trained in place.
            solved: states to draw from, and their valid actions.
            settings: resolved, see `ImitationPhase.resolved`.
            tasks: draws states with targets, in place of `solved`.
            compiled: compile the network.
            shards: processes that share every batch and average their gradients.
            copies: policies with the very same weights for copies of the structure, as of
                `falsework.learn.networks.factory.share`; steps take the policy and them in turn.

        Raises:
            InputError: fewer states in a batch than processes.
        """
        if settings.batch < shards.size:
            raise InputError(f"a batch of {settings.batch} cannot be shared by {shards.size} processes; make it larger")
        # Steps of the size of the weight are for matrices; norms and biases are not pulled to zero.
        super().__init__(
            policy,
            torch.Generator(solved.device).manual_seed(seed * 1009 + shards.rank),
            seed,
            shards,
            learning_rate=settings.learning_rate,
            weight_decay=_WEIGHT_DECAY,
            only_matrices=True,
            betas=_BETAS,
        )
        self._solved, self._settings, self._tasks = solved, settings, tasks
        self._share = settings.batch // shards.size
        self._networks = [Network(one, precision, compiled=compiled) for one in (policy, *copies)]

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """See `Learner.block`."""
        self.policy.train()
        drawn = self._draw(steps)
        sums = torch.zeros(2, device=self._solved.device)
        for step, (states, targets, valid) in enumerate(drawn):
            place = progress[0] + (progress[1] - progress[0]) * step / steps
            mask = self._solved.rules.moves(states, targets)
            valid = self._solved.valid_actions(states, mask) if valid is None else valid
            logits, value = self._networks[self.steps % len(self._networks)](states, targets)
            loss = imitation_loss(logits, mask, valid) + _VALUE_WEIGHT * (value - 1.0).square().mean()
            norm = self.optimizer.step(
                loss,
                learning_rate=self._settings.learning_rate * self.schedule(self.steps, place),
                # The first averages are over few steps, or they would remember the random initial weights.
                average=min(_AVERAGE, (2 + self.steps) / (11 + self.steps)),
            )
            sums += torch.stack([loss.detach(), norm])
        self.optimizer.check()
        self.policy.eval()
        loss, norm = (sums / max(steps, 1)).tolist()
        numbers = {"loss": loss, "gradient_norm": norm, "solved": float(len(self._solved))}
        self.listener(numbers)
        return numbers

    def schedule(self, step: int, progress: float) -> float:
        """Return the learning rate as a share of the largest: a rise by steps, a plateau, half a cosine by progress."""
        settings = self._settings
        rise = min((step + 1) / max(settings.warm_up, 1), 1.0)
        fallen = min(max((progress - 1.0 + settings.decay) / max(settings.decay, 1e-9), 0.0), 1.0)
        return rise * (_FINAL_LEARNING_RATE + (1 - _FINAL_LEARNING_RATE) * 0.5 * (1 + math.cos(math.pi * fallen)))

    def _draw(self, steps: int) -> Iterator[tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]]:
        """Draw states, their targets and valid actions for each of some steps; None where there are no targets."""
        if self._tasks is not None:
            # All at once, since a draw takes as many small kernels for one task as for all of them.
            drawn = self._tasks.draw(steps * self._share, self.generator)
            yield from zip(*(column.split(self._share) for column in drawn), strict=True)
            return
        for _ in range(steps):
            rows = torch.randint(
                len(self._solved), (self._share,), generator=self.generator, device=self._solved.device
            )
            yield self._solved.states[rows], None, None
