"""Start states of reinforcement from scratch: a curriculum, states that rollouts passed, and explored ones."""

from __future__ import annotations

import torch

from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.exploration import Exploration
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.algorithms.start_states import StartBatch, StartSampler
from falsework.learn.data.solvable_states import SolvableStates


class BlendedStarts(StartSampler):
    """States of a curriculum and, within its horizon, any solvable states, and states that are explored for this."""

    def __init__(
        self,
        curriculum: Curriculum,
        solved: SolvableStates,
        anywhere: float,
        *,
        exploration: Exploration,
        explored: float,
    ) -> None:
        """Begin with the curriculum as it is.

        Args:
            curriculum: states of searches.
            solved: states known to be solvable, which grow, those that rollouts passed included.
            anywhere: share of the starts that is drawn from `solved`.
            exploration: finds solvable states far from those of the searches.
            explored: share of the starts that is drawn from there; none are looked for if it is 0.
        """
        self._curriculum, self._solved, self._exploration = curriculum, solved, exploration
        self._anywhere, self._explored = anywhere, explored

    @property
    def mean_steps(self) -> float:  # type: ignore[override]
        """See `StartSampler`."""
        return self._curriculum.mean_steps

    @property
    def widening(self) -> bool:  # type: ignore[override]
        """See `StartSampler`."""
        return self._curriculum.widening

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`."""
        anywhere, explored = round(count * self._anywhere), round(count * self._explored)
        own = self._curriculum.sample(count - anywhere - explored, generator)
        horizon = self._curriculum.horizon
        others = self._solved.within(horizon, anywhere, generator)
        if explored:
            others = torch.cat([others, self._exploration.draw(explored, horizon, generator)])
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
        """See `StartSampler`; with the number of explored states, and their mean distance to the data."""
        found = {"explored": float(len(self._exploration)), "explored_distance": self._exploration.mean_distance}
        return self._curriculum.report() | (found if self._explored else {})

    def state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        return self._curriculum.state_dict()

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        return self._curriculum.local_state_dict() | self._exploration.tensors()

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `StartSampler`."""
        self._curriculum.load_state_dict(tensors, local)
        if local is not None:
            self._exploration.load(local)
