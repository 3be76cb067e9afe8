"""An environment that takes notes while rollouts go on, whoever plays them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.env.environment import Environment, Step
from falsework.learn.env.rollout import Rollouts


class Memory:
    """The last so many rows of several columns, on one device; old ones are overwritten in turn."""

    def __init__(self, capacity: int, columns: dict[str, torch.Tensor]) -> None:
        """Begin empty.

        Args:
            capacity: rows kept.
            columns: for each name one example row with the right type and device.
        """
        self.capacity = capacity
        self._columns = {
            name: torch.zeros((capacity, *row.shape), dtype=row.dtype, device=row.device)
            for name, row in columns.items()
        }
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self.capacity)

    def add(self, **columns: torch.Tensor) -> None:
        """Write rows, each column of shape (count, ...)."""
        count = len(next(iter(columns.values())))
        count, skipped = min(count, self.capacity), max(count - self.capacity, 0)
        if count == 0:
            return
        device = next(iter(self._columns.values())).device
        place = (torch.arange(count, device=device) + self._written + skipped) % self.capacity
        for name, rows in columns.items():
            self._columns[name][place] = rows[skipped:]
        self._written += count + skipped

    def draw(self, count: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Rows drawn evenly, with repetition; only if there are any."""
        device = next(iter(self._columns.values())).device
        rows = torch.randint(len(self), (count,), generator=generator, device=device)
        return {name: column[rows] for name, column in self._columns.items()}

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save, for `load`."""
        kept = {name: column[: len(self)] for name, column in self._columns.items()}
        return {**kept, "written": torch.tensor([self._written])}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Go back to what `tensors` gave."""
        self._written = int(tensors["written"][0])
        for name, column in self._columns.items():
            column[: len(self)] = tensors[name].to(column.device)


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
