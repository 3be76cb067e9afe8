"""Scores of the candidates of a level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.search.beam.frontier import Frontier, Rows

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scores:
    """Sum of the scores on the path to each candidate; higher is better."""

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


class Priorities:
    """Order in which candidates are tried: those that leave more robots free first, then the better scored."""

    def __init__(self, scores: Scores, rng: np.random.Generator) -> None:
        """Compare the scores of all candidates; equal ones will be in random order."""
        self._scores, self._frontier, self._rng = scores, scores.frontier, rng
        score = scores.of(self._frontier.candidates())
        self._gap = float(np.ptp(score)) + 1.0 if len(score) else 1.0
        """Between numbers of held parts: wider than all scores, so that it decides first."""

    def of(self, rows: Rows) -> Array:
        """Return the promise of candidates, shape (rows,)."""
        return self._scores.of(rows) - self._frontier.held(rows) * self._gap

    def best_fixing(self, count: int, most_held: float) -> Rows:
        """Return the first candidates that a move which fixes a part leads to.

        Args:
            most_held: leave out those in which robots hold more parts.
        """
        fixing = np.flatnonzero(self._frontier.fixing)
        rows = fixing[self._frontier.held(fixing) <= most_held]
        value = self.of(rows)
        if len(rows) > count:
            some = value >= np.partition(value, len(value) - count)[len(value) - count]
            rows, value = rows[some], value[some]
        if len(np.unique(value)) == len(value):
            return rows[np.argsort(-value)][:count]
        place = np.empty(self._frontier.fixing.size, dtype=np.int64)
        place[self._rng.permutation(fixing)] = np.arange(len(fixing))
        return rows[np.lexsort((place[rows], -value))][:count]
