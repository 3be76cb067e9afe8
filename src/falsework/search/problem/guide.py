"""Action heuristics of a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, Mask, States
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


class Guide(Protocol):
    """Action heuristic: higher scores are tried sooner. Any callable can be used, such as a trained policy."""

    def __call__(self, states: States, actions: Mask, direction: Direction, /) -> NDArray[np.floating]:
        """Score the actions of some states; a search adds up the scores along a path.

        Args:
            states: shape (batch, parts).
            actions: which are allowed, shape (batch, 2 parts); only their scores are read.
            direction: in disassembly the actions lead out of the states, in assembly they are undone.

        Returns:
            Shape (batch, 2 parts).
        """
        ...


class SupportGuide:
    """Heuristic that prefers parts with much support in assembly, and with little in disassembly.

    The score of a part is the share of its contact area that touches parts now present. Summed up over an assembly
    that favours compact structures, which are rarely the unstable ones.
    """

    def __init__(self, assembly: Assembly) -> None:
        """Read the contacts of an assembly."""
        parts = assembly.part_count
        area = np.zeros((parts, parts))
        a, b = assembly.contacts.parts.T
        np.add.at(area, (a, b), assembly.contacts.areas)
        area += area.T
        whole = area.sum(axis=0, keepdims=True)
        self._share = np.divide(area, whole, out=np.zeros_like(area), where=whole > 0).astype(np.float32)

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float32]:
        """See `Guide`."""
        support = (states != REMOVED).astype(np.float32) @ self._share
        if direction is Direction.DISASSEMBLY:
            support = -support
        return np.concatenate([support, support], axis=1)


class NoveltyGuide:
    """Heuristic that prefers actions unlike those of given plans, on top of another heuristic.

    The score of a part that is removed, or in assembly inserted, is the share of the parts now present that a given
    plan removes before it: each is a pair that leaves in another order here.
    """

    def __init__(self, base: Guide | None, routes: Sequence[Route], weight: float = 4.0) -> None:
        """Prefer actions unlike `routes`, with `weight` relative to the scores of `base`."""
        ranks = [route.removal_rank() for route in routes]
        self._base = base
        self._removed = np.array([rank >= 0 for rank in ranks])
        self._before = np.array([rank[:, None] < rank[None, :] for rank in ranks], dtype=np.float32)
        self._weight = weight / max(len(routes), 1)

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """See `Guide`."""
        parts = states.shape[1]
        score = np.zeros(actions.shape)
        if self._base is not None:
            score += self._base(states, actions, direction)
        for removed, before in zip(self._removed, self._before, strict=True):
            present = ((states != REMOVED) & removed).astype(np.float32)
            score[:, parts:] += self._weight * (present @ before) / np.maximum(present.sum(axis=1), 1.0)[:, None]
        return score


class MemoizedGuide:
    """Memoized heuristic; all new queries of a call are evaluated together.

    A network takes hardly longer for many states than for one. The oldest entries are evicted first.
    """

    def __init__(self, base: Guide, limit: int = 20_000) -> None:
        """Begin empty.

        Args:
            base: heuristic to evaluate.
            limit: number of cached scores.
        """
        self.calls = 0
        """Number of evaluations of the base heuristic."""
        self._base, self._limit = base, limit
        self._answers: dict[bytes, NDArray[np.floating]] = {}

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.floating]:
        """See `Guide`."""
        questions = np.concatenate([states, np.packbits(actions, axis=1)], axis=1)
        keys = [direction.value.encode() + question.tobytes() for question in questions]
        new = {key: row for row, key in enumerate(keys) if key not in self._answers}
        if new:
            rows = list(new.values())
            self.calls += 1
            answers = self._base(states[rows], actions[rows], direction)
            self._answers.update(zip(new, np.array(answers), strict=True))
        found = np.array([self._answers[key] for key in keys]).reshape(actions.shape)
        while len(self._answers) > self._limit:
            del self._answers[next(iter(self._answers))]
        return found
