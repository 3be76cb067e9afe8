"""Environment that records which held-out states rollouts visit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment, Step


class RecordingEnvironment(Environment):
    """Environment of training: counts held-out states that rollouts visit.

    Its rollouts are there to learn from, so states that are open after the solver on a GPU are given up.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As `Environment`."""
        super().__init__(*arguments, **options)
        self.solved: SolvableStates | None = None
        """Where visits to held-out states are recorded."""
        self.exact = False

    @contextmanager
    def paused_recording(self) -> Iterator[None]:
        """Record nothing for the length of a `with` block, and leave no state open, as for an evaluation."""
        before = self.solved, self.exact
        self.solved, self.exact = None, True
        try:
            yield
        finally:
            self.solved, self.exact = before

    def step(
        self,
        states: torch.Tensor,
        actions: torch.Tensor,
        targets: torch.Tensor | None = None,
        *,
        check: bool = False,
    ) -> Step:
        """As `Environment.step`."""
        step = super().step(states, actions, targets, check=check)
        if self.solved is not None:
            self.solved.record_visits(step.states)
        return step
