"""Start states of rollouts: sampler interface, and mixed starts from data, failures and hindsight."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch

from falsework.learn.algorithms.extension import Extension
from falsework.learn.algorithms.hindsight import relabel
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.data.random_walks import GoalSampler
from falsework.learn.data.solvable_states import SolvableStates

_FROM_DATA = 0.5
"""Share of rollouts that start where searches found states."""
_FROM_FAILURES = 0.25
"""Share that starts where a rollout failed lately. Without goals, the others start at any solvable state."""
_FROM_HINDSIGHT = 0.1
"""With goals: share between two states of an earlier rollout; the others are drawn anew, half of them extended."""
_COMPARED = 4
"""Pairs of which the one is taken whose success is the least certain."""
_REMEMBERED = 4
"""Failures and hindsight pairs that are kept, in collections."""


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
        collection: int,
        *,
        tasks: GoalSampler | None = None,
        value: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None,
        extension: Extension | None = None,
    ) -> None:
        """Begin without failures.

        Args:
            starts: solvable states like those that the policy is for, shape (count, parts); with goals not used.
            solved: states known to be solvable, and the held-out ones.
            collection: rollouts per collection of this process.
            tasks: of a policy with goals, draws starts and targets for every collection.
            value: with goals, predicts the return of pairs, from -1 for failure to 1 for success. Of most pairs it is
                near one of these, and little is learned from them.
            extension: with goals, moves starts and targets to other states.
        """
        self._starts, self._tasks, self._solved, self._value = starts, tasks, solved, value
        self._extension = extension
        none = starts[:0]
        self._failed = self._passed = StartBatch(none, None if tasks is None else none)
        self._most = _REMEMBERED * collection

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`."""
        failures = round(count * _FROM_FAILURES) if len(self._failed.states) else 0
        passed = round(count * _FROM_HINDSIGHT) if len(self._passed.states) else 0
        anywhere = 0 if self._tasks is not None else count - round(count * (_FROM_DATA + _FROM_FAILURES))
        fresh = count - failures - passed - anywhere
        if self._tasks is None:
            pieces = [
                _some(StartBatch(self._starts), fresh, generator),
                _some(StartBatch(self._solved.states), anywhere, generator),
            ]
            return _joined([*pieces, _some(self._failed, failures, generator)])
        more = 1 if self._value is None else _COMPARED
        drawn = StartBatch(*self._tasks.draw(more * fresh, generator)[:2])
        pieces = [
            _some(pairs, more * one, generator) for pairs, one in ((self._passed, passed), (self._failed, failures))
        ]
        pairs = self._uncertain(_joined([drawn, *pieces]), more)
        if self._extension is None or pairs.targets is None:
            return pairs
        half = fresh // 2
        ends = self._extension.extended(pairs.states[:half], pairs.targets[:half], generator)
        return _joined([StartBatch(*ends), _take(pairs, slice(half, None))])

    def _uncertain(self, pairs: StartBatch, compared: int) -> StartBatch:
        """Return of each few pairs in a row the one whose predicted success is nearest to one half."""
        if self._value is None or pairs.targets is None:
            return pairs
        certain = self._value(pairs.states, pairs.targets).abs().view(-1, compared)
        rows = torch.arange(len(certain), device=certain.device) * compared + certain.argmin(dim=1)
        return _take(pairs, rows)

    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """See `StartSampler`."""
        failed = (~transitions.success).nonzero()[:, 0]
        self._failed = _take(_joined([_take(batch, failed), self._failed]), slice(self._most))
        if batch.targets is not None:
            pairs = relabel(transitions, len(batch.states), self._solved, generator)
            self._passed = _take(_joined([StartBatch(*pairs), self._passed]), slice(self._most))

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
