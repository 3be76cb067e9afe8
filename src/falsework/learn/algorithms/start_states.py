"""Start states of rollouts: sampler interface, and mixed starts from data, failures and hindsight."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from falsework.learn.algorithms.hindsight import relabel
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.data.random_walks import GoalSampler
from falsework.learn.data.solvable_states import SolvableStates
from falsework.search.device.rules import TensorRules

_FROM_DATA = 0.5
"""Share of rollouts that start where searches found states."""
_FROM_FAILURES, _WITH_GOALS = 0.25, 0.5
"""Share that starts where a rollout failed lately, without and with goals: random actions solve half of the pairs that
are drawn. Without goals, the others start at any solvable state."""
_FROM_HINDSIGHT = 0.1
"""With goals: share between two states of an earlier rollout; the others are drawn anew."""
_REMEMBERED = 4
"""Failures and hindsight pairs that are kept, in collections."""
_MEASURED = 4096
"""Start states whose distance to the target is measured, about."""


@dataclass(frozen=True, eq=False)
class StartBatch:
    """Start states of a batch of rollouts."""

    states: torch.Tensor
    """Shape (rollouts, parts)."""
    targets: torch.Tensor | None = None
    """Shape (rollouts, parts)."""
    entropy: torch.Tensor | None = None
    """Weight of the entropy for each, shape (rollouts,); that of the settings if None."""
    weight: torch.Tensor | None = None
    """Importance weight of each, above 0 and at most 1, shape (rollouts,); 1 if None."""
    rows: torch.Tensor | None = None
    """Indices of the states in their sampler, shape (rollouts,)."""


class StartSampler(ABC):
    """Sampler of start states that adapts to the outcomes of rollouts."""

    mean_steps: float
    """Steps from a start to its target, on average."""
    widening = False
    """Whether farther states will still be drawn."""

    @abstractmethod
    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """Draw the starts of `count` rollouts of this process."""

    @abstractmethod
    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """Take note of how rollouts ended.

        Args:
            batch: where they started.
            transitions: all of them, at held-out states too.
            surrogate: mean size of the surrogate loss of each rollout, shape (rollouts,).
            generator: source of randomness.
        """

    def report(self) -> dict[str, float]:
        """Return numbers to log."""
        return {}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that is the same in all processes."""
        return {}

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that belongs to this process."""
        return {}

    @abstractmethod
    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """Restore both; `local` is None if the number of processes has changed."""


class MixedStarts(StartSampler):
    """States that searches found, recent failures, and hindsight pairs or any state known to be solvable."""

    def __init__(
        self,
        starts: torch.Tensor,
        solved: SolvableStates,
        rules: TensorRules,
        collection: int,
        *,
        targets: torch.Tensor | None = None,
        tasks: GoalSampler | None = None,
    ) -> None:
        """Begin without failures.

        Args:
            starts: solvable states like those that the policy is for, shape (count, parts).
            solved: states known to be solvable, and the held-out ones.
            rules: of the structure.
            collection: rollouts per collection of this process.
            targets: of each start, shape (count, parts), or None.
            tasks: draws other starts and targets for every collection, in place of those.
        """
        self._starts, self._targets, self._tasks, self._solved = starts, targets, tasks, solved
        self._failed = StartBatch(starts[:0], None if targets is None else targets[:0])
        self._passed = StartBatch(starts[:0], None if targets is None else targets[:0])
        self._most = _REMEMBERED * collection
        some = slice(None, None, max(len(starts) // _MEASURED, 1))
        left = rules.steps_left(starts[some], None if targets is None else targets[some])
        self.mean_steps = max(float(left.double().mean()), 1.0) if len(left) else 1.0

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`."""
        goals = self._targets is not None
        failures = round(count * (_WITH_GOALS if goals else _FROM_FAILURES)) if len(self._failed.states) else 0
        passed = round(count * _FROM_HINDSIGHT) if goals and len(self._passed.states) else 0
        anywhere = 0 if goals else count - round(count * (_FROM_DATA + _FROM_FAILURES))
        fresh = count - failures - passed - anywhere
        if self._tasks is not None:
            pieces = [StartBatch(*self._tasks.draw(fresh, generator)[:2])]
        else:
            pieces = [_some(StartBatch(self._starts, self._targets), fresh, generator)]
        pieces.append(_some(self._failed, failures, generator))
        if goals:
            pieces.append(_some(self._passed, passed, generator))
        else:
            pieces.append(_some(StartBatch(self._solved.states), anywhere, generator))
        return _joined(pieces)

    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """See `StartSampler`."""
        failed = (~transitions.success).nonzero()[:, 0]
        self._failed = _take(_joined([_take(batch, failed), self._failed]), slice(self._most))
        if batch.targets is not None:
            pairs = relabel(transitions, len(batch.states), self._solved, generator)
            self._passed = _take(_joined([StartBatch(*pairs[:2]), self._passed]), slice(self._most))

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        saved = {"failed": self._failed.states, "passed": self._passed.states}
        if self._failed.targets is None or self._passed.targets is None:
            return saved
        return {**saved, "failed_targets": self._failed.targets, "passed_targets": self._passed.targets}

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `StartSampler`."""
        if local is None:
            return
        moved = {name: tensor.to(self._starts.device) for name, tensor in local.items()}
        self._failed = StartBatch(moved["failed"], moved.get("failed_targets"))
        self._passed = StartBatch(moved["passed"], moved.get("passed_targets"))


def _take(batch: StartBatch, rows: torch.Tensor | slice) -> StartBatch:
    return StartBatch(batch.states[rows], None if batch.targets is None else batch.targets[rows])


def _some(batch: StartBatch, count: int, generator: torch.Generator) -> StartBatch:
    device = batch.states.device
    return _take(batch, torch.randint(max(len(batch.states), 1), (count,), generator=generator, device=device))


def _joined(pieces: list[StartBatch]) -> StartBatch:
    states = torch.cat([one.states for one in pieces])
    targets = [one.targets for one in pieces if one.targets is not None]
    return StartBatch(states, torch.cat(targets) if targets else None)
