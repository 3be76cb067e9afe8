"""Environment wrapper that records failed actions and rollout outcomes for replay."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from falsework.learn.data.replay_buffer import Memory
from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.env.environment import Environment, Rollouts, Step


class WatchedEnvironment(Environment):
    """Notes which test states rollouts come across, and which actions bring something down.

    Its rollouts are there to learn from, so states that are open after the solver on a GPU are given up.
    """

    def __init__(self, *arguments: Any, memory: int = 200_000, **options: Any) -> None:
        """As `Environment`; `memory` mistakes are remembered."""
        super().__init__(*arguments, **options)
        self.solved: SolvedStates | None = None
        """Where test states that are met are noted."""
        state, number = self.rules.complete()[0], torch.zeros((), dtype=torch.int64, device=self.device)
        self.mistakes = Memory(memory, {"states": state, "actions": number})
        """States of rollouts, and actions after which stability was not proven. Test states are not among them."""
        self.outcomes = Memory(memory, {"states": state, "value": number.float()})
        """States of rollouts that were drawn, not greedy, and how these ended: 1 or -1. No test states either."""
        self.remember = False
        """Keep mistakes and outcomes, which costs a wait for the device at every step."""
        self._watching = True
        self.exact = False

    @contextmanager
    def unwatched(self) -> Iterator[None]:
        """Take no notes for the length of a `with` block, and leave no state open, as for an evaluation."""
        before = self._watching, self.exact
        self._watching, self.exact = False, True
        try:
            yield
        finally:
            self._watching, self.exact = before

    def note(self, rollouts: Rollouts, *, told: bool, drawn: bool, whole: bool) -> None:
        """As `Environment.note`: remember how rollouts without targets ended that were drawn."""
        if self.solved is None or not (self._watching and self.remember and drawn and whole) or told:
            return
        value = (2.0 * rollouts.success.float() - 1.0).expand(len(rollouts.states), -1)
        passed = rollouts.passed()
        states, value = rollouts.states[passed], value[passed]
        learnable = (~self.solved.is_forbidden(states)).nonzero()[:, 0]
        self.outcomes.add(states=states[learnable], value=value[learnable])

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
        if self._watching and self.solved is not None:
            self.solved.meet(step.states)
        if self._watching and self.remember and self.solved is not None and targets is None:
            wrong = (step.unstable & ~self.solved.is_forbidden(states)).nonzero()[:, 0]
            self.mistakes.add(states=states[wrong], actions=actions[wrong].long())
        return step
