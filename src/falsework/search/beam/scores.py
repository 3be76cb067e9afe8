"""Scores of the candidates of a level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask
from falsework.search.beam.frontier import Frontier, Rows
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scores:
    """Sum of the scores on the way to each candidate; higher is better."""

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
        """Begin without looking at any candidate; equal ones will be in random order."""
        self._scores, self._frontier, self._rng = scores, scores.frontier, rng
        parts = scores.frontier.task.part_count
        self._begin = 0 if scores.frontier.direction is Direction.DISASSEMBLY else parts
        self._place: NDArray[np.int64] | None = None

    @cached_property
    def loose(self) -> Rows:
        """Candidates that no move which fixes a part leads to, ascending."""
        return np.flatnonzero(self._frontier.moves & ~self._frontier.fixing)

    @cached_property
    def _turned(self) -> Rows:
        """Candidates that a move which fixes a part leads to, though not first."""
        parts, begin = self._frontier.task.part_count, self._frontier.task.part_count - self._begin
        level, part = np.divmod(np.flatnonzero(self._frontier.fixing[:, begin : begin + parts]), parts)
        return level * 2 * parts + part + begin

    @cached_property
    def _half(self) -> Mask:
        """Candidates that a move which fixes a part leads to first, shape (level, parts)."""
        return self._frontier.fixing[:, self._begin : self._begin + self._frontier.task.part_count]

    @cached_property
    def _gap(self) -> float:
        """Gap between numbers of held parts: wider than all scores, so that it decides first."""
        if not len(self._frontier):
            return 1.0
        others = self._scores.of(np.concatenate([self.loose, self._turned]))
        most = max(self._table.max(initial=-np.inf, where=self._half), others.max(initial=-np.inf))
        return most - min(self._table.min(initial=np.inf, where=self._half), others.min(initial=np.inf)) + 1.0

    @cached_property
    def _fixing(self) -> Array:
        """Promise of the candidates that a move which fixes a part leads to first, shape (level, parts)."""
        promise = self._table - ((self._frontier.held_before + 1) * self._gap)[:, None]
        promise[~self._half] = -np.inf
        return promise

    def of(self, rows: Rows) -> Array:
        """Return the promise of candidates, shape (rows,)."""
        return self._scores.of(rows) - self._frontier.held(rows) * self._gap

    def best_fixing(self, count: int, most_held: float) -> Rows:
        """Return the first candidates that a move which fixes a part leads to.

        Equal to the first of all of them in random order, sorted by promise, but only those are sorted that may be
        among them.

        Args:
            count: number of candidates.
            most_held: leave out those in which robots hold more parts.
        """
        parts = self._fixing.shape[1]
        holds = self._frontier.held_before + 1 <= most_held
        table = self._fixing if holds.all() else np.where(holds[:, None], self._fixing, -np.inf)
        # The best of one row bound those of all rows from below.
        least, best = -np.inf, table[table.max(axis=1).argmax()]
        if count < parts:
            least = np.partition(best, parts - count)[parts - count]
        at = np.flatnonzero(table >= least if least > -np.inf else table > -np.inf)
        rows, value = at // parts * 2 * parts + at % parts + self._begin, table.ravel()[at]
        turned = self._turned[self._frontier.held(self._turned) <= most_held]
        if len(turned):
            rows, value = np.concatenate([rows, turned]), np.concatenate([value, self.of(turned)])
        if len(rows) > count:
            some = value >= np.partition(value, len(value) - count)[len(value) - count]
            rows, value = rows[some], value[some]
        if len(np.unique(value)) == len(value):
            return rows[np.argsort(-value)][:count]
        return rows[np.lexsort((self._random_place()[rows], -value))][:count]

    @cached_property
    def _table(self) -> Array:
        """Return the scores of all moves that fix a part, legal or not, shape (level, parts)."""
        scores, parts = self._scores, self._frontier.task.part_count
        table = np.repeat(scores.before[:, None], parts, axis=1)
        if scores.guide is not None:
            table += scores.guide[:, self._begin : self._begin + parts]
        return table

    def _random_place(self) -> NDArray[np.int64]:
        """Return for the candidates that a move which fixes a part leads to their places in a random order."""
        if self._place is None:
            rows = np.flatnonzero(self._frontier.fixing)
            self._place = np.empty(self._frontier.fixing.size, dtype=np.int64)
            self._place[self._rng.permutation(rows)] = np.arange(len(rows))
        return self._place
