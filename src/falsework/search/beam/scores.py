"""Scores of the candidates of a level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.search.beam.frontier import Frontier, Rows

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scores:
    """Sum of the scores on the path to each candidate, and the order in which they are tried; higher is better."""

    frontier: Frontier
    before: Array
    """Scores of the states of the level, shape (level,)."""
    guide: NDArray[np.floating] | None = None
    """Scores of moves, shape (level, 2 parts)."""

    def of(self, rows: Rows) -> Array:
        """Return the scores of candidates, shape (rows,)."""
        parent = self.frontier.parent(rows)
        score = self.before[parent]
        if self.guide is not None:
            score = score + self.guide[parent, self.frontier.action(rows)].astype(np.float64)
        return score

    @cached_property
    def _gap(self) -> float:
        """Gap between numbers of held parts: wider than all scores, so that it decides first."""
        score = self.of(self.frontier.candidates())
        return float(np.ptp(score)) + 1.0 if len(score) else 1.0

    def promise(self, rows: Rows) -> Array:
        """Return the promise of candidates, shape (rows,): those that leave more robots free first, then the scores."""
        return self.of(rows) - self.frontier.held(rows) * self._gap

    def best_fixing(self, count: int, most_held: float, rng: np.random.Generator) -> Rows:
        """Return the first candidates that a move which fixes a part leads to, equal ones in random order.

        Args:
            count: number of candidates.
            most_held: leave out those in which robots hold more parts.
            rng: draws the order.
        """
        fixing = np.flatnonzero(self.frontier.fixing)
        rows = fixing[self.frontier.held(fixing) <= most_held]
        value = self.promise(rows)
        if len(rows) > count:
            some = value >= np.partition(value, len(value) - count)[len(value) - count]
            rows, value = rows[some], value[some]
        if len(np.unique(value)) == len(value):
            return rows[np.argsort(-value)][:count]
        place = np.empty(self.frontier.fixing.size, dtype=np.int64)
        place[rng.permutation(fixing)] = np.arange(len(fixing))
        return rows[np.lexsort((place[rows], -value))][:count]
