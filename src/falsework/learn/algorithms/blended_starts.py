"""Start states of reinforcement from scratch: a curriculum, and states that rollouts passed."""

from __future__ import annotations

import torch

from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.algorithms.start_states import StartBatch
from falsework.learn.data.solvable_states import SolvableStates


class BlendedStarts:
    """States of a curriculum, and any solvable states within its horizon, those that rollouts passed included."""

    def __init__(self, curriculum: Curriculum, solved: SolvableStates, anywhere: float) -> None:
        """Begin with the curriculum as it is.

        Args:
            curriculum: states of searches.
            solved: states known to be solvable, which grow.
            anywhere: share of the starts that is drawn from `solved`.
        """
        self._curriculum, self._solved, self._anywhere = curriculum, solved, anywhere

    @property
    def mean_steps(self) -> float:
        """See `StartSampler`."""
        return self._curriculum.mean_steps

    @property
    def widening(self) -> bool:
        """See `StartSampler`."""
        return self._curriculum.widening

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`."""
        anywhere = round(count * self._anywhere)
        own = self._curriculum.sample(count - anywhere, generator)
        others = self._solved.within(self._curriculum.horizon, anywhere, generator)
        assert own.entropy is not None
        assert own.weight is not None
        more = len(others)
        return StartBatch(
            torch.cat([own.states, others]),
            None,
            torch.cat([own.entropy, own.entropy.new_full((more,), self._curriculum.settings.entropy)]),
            torch.cat([own.weight, own.weight.new_full((more,), float(own.weight.mean()))]),
            own.rows,
        )

    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """See `StartSampler`."""
        assert batch.rows is not None
        own = len(batch.rows)
        self._curriculum.record_outcomes(batch.rows, transitions.success[:own], surrogate[:own])

    def report(self) -> dict[str, float]:
        """See `StartSampler`."""
        return self._curriculum.report()

    def state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        return self._curriculum.state_dict()

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        return self._curriculum.local_state_dict()

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `StartSampler`."""
        self._curriculum.load_state_dict(tensors, local)
