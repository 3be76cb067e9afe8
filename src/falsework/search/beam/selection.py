"""Selection of the candidates that a beam keeps and of those that need a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.search.beam.failures import FailureMemory
from falsework.search.beam.frontier import Frontier, Rows
from falsework.search.beam.k_means import k_means
from falsework.search.beam.scores import Promise, Scores
from falsework.search.problem.oracle import CountingOracle
from falsework.search.problem.task import Direction


class Confirmation(Protocol):
    """Second test of candidates with a stable verdict."""

    def __call__(self, rows: Rows) -> Mask:
        """Return which candidates are reached by states that are stable too, and come to rest. Shape (rows,)."""
        ...


_ENOUGH = 4
"""Moves that failed before are tried where fewer than one in so many of the states wanted is found without them."""
_THOROUGH_WIDTH = 64
"""States wanted from which all moves are tried: beams so wide are to prove that there is no plan."""
_TRIED_AGAIN = 16
"""Moves that failed before which a beam of width 1 tries at a level at most."""
_NEAR_CONTACTS = 2
"""Contacts, one after the other, between two parts that are near each other."""
_FEW_ROBOTS = 4
"""With more robots than these, repeated trials of failed moves would take most of the time ..."""
_TRIED_AGAIN_EVERY = 8
"""... so failed moves are repeated only every so many levels, or where no other part can be fixed instead."""
_TURN = 4
"""Candidates that come from one state in a turn."""
_FARTHER = 4
"""So many times more candidates are looked up where too few of the first are left."""
_VERDICT_BATCH = 2
"""Candidates asked for at once at least, once the first were not enough: enough to share two cores. The first mostly
are, and a stable state costs ten times the verdict of one that falls."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Outcome of a selection."""

    kept: Rows
    """Stable candidates that the beam keeps, best scored first, shape (kept,)."""
    rejected: Rows
    """Candidates found not stable, shape (rejected,)."""
    exhaustive: bool
    """Every candidate is either kept or rejected."""


@dataclass(frozen=True, eq=False)
class Selector:
    """Selection among the candidates of one level."""

    frontier: Frontier
    scores: Scores
    clustered: bool
    """Take one state of each cluster, then the next of each, and so on; else simply the best scored first."""
    pool: int
    """Bound on candidates times parts that are clustered at once; beyond it, of a random sample only."""
    rng: np.random.Generator
    """Breaks ties and seeds the clusters."""
    standing: States
    """For each state of the level one near it that is known to be stable, shape (level, parts)."""
    failures: FailureMemory | None = None
    """Moves that failed before, which are tried last."""

    def order(self, rows: Rows, score: Callable[[Rows], NDArray[np.float64]], count: int) -> Rows:
        """Return rows in the order in which they are to be taken, where about `count` are wanted.

        Args:
            rows: some candidates, shape (rows,).
            score: of candidates; higher is better.
            count: number of clusters.
        """
        rows = self.rng.permutation(rows)
        if len(rows) <= count or not self.clustered:
            return rows[np.argsort(-score(rows), kind="stable")]
        room = max(self.pool // self.frontier.task.part_count, 2 * count)
        # Rows are in random order, so the first ones are a fair sample.
        sample = rows[:room]
        labels, distance = k_means(self.frontier.states(sample), count, self.rng)
        order = np.lexsort((distance, -score(sample), labels))
        begin = np.flatnonzero(np.diff(labels[order], prepend=-1))
        rank = np.arange(len(sample)) - np.repeat(begin, np.diff(np.append(begin, len(sample))))
        return np.concatenate([sample[order[np.argsort(rank, kind="stable")]], rows[room:]])

    def all_judged(self, judge: CountingOracle, width: int) -> Selection:
        """Ask for every candidate, then keep `width` stable ones; the way of the paper."""
        frontier, rows = self.frontier, self.frontier.candidates()
        stable = frontier.free(rows)
        asked = rows[~stable]
        if len(asked):
            stable[~stable] = judge.stable(frontier.states(asked), self.standing[frontier.parent(asked)])
        kept = self.order(rows[stable], self.scores.of, width)[:width]
        return self._selection(kept, rows[~stable])

    def most_promising(
        self,
        judge: CountingOracle,
        width: int,
        lookahead: int,
        confirmed: Confirmation,
        *,
        commit: bool,
        in_turn: bool = False,
        compact: bool = False,
        early: tuple[int, ...] = (),
    ) -> Selection:
        """Ask only until `width` states are found stable; keep `lookahead` more that a fixed part leads to.

        States that leave more robots free come first, then the better scored.

        Args:
            judge: asked in the order of promise.
            width: states to keep among those that a removal, or in assembly a release, leads to.
            lookahead: states to keep among those that fixing a part leads to; their verdicts wait until a descendant is
                kept.
            confirmed: second test of candidates with a stable verdict.
            commit: once `width` are found, drop states that keep more robots busy than these.
            in_turn: take those in which every robot holds a part in turn over the states of the level.
            compact: fix only parts near those that robots hold, wherever they hold any.
            early: parts around these are fixed only once they are there.
        """
        frontier, promise = self.frontier, Promise(self.scores, self.rng)
        loose = self.order(promise.loose, promise.of, width)
        fixed = None
        if promise.few or self.clustered or in_turn or compact or early:
            fixing = self._not_around(np.flatnonzero(frontier.fixing), early)
            fixed = self.order(self._near_held(fixing) if compact else fixing, promise.of, lookahead)
        later = bool(frontier.fixing.any()) if fixed is None else len(fixed) > 0
        proven, rejected = self._likely_ones(judge, loose, width, confirmed, later=later)
        most_held = np.inf
        if commit and len(proven) >= width:
            most_held = float(frontier.held(proven).max())
        if fixed is None:
            fixed = self._hopeful_first(lambda count: promise.best_fixing(count, most_held), lookahead, width)
        else:
            ordered = fixed[frontier.held(fixed) <= most_held]
            if in_turn and len(ordered) > lookahead:
                ordered = self._in_turn(ordered)
            fixed = self._hopeful_first(lambda count: ordered[:count], lookahead, width)
        return self._selection(np.concatenate([proven, fixed]), rejected)

    def _not_around(self, fixing: Rows, early: tuple[int, ...]) -> Rows:
        """Return candidates without those in which a part is fixed beside an absent one that is to be there before."""
        task = self.frontier.task
        if not early or task.neighbours is None:
            return fixing
        absent = self.frontier.level[:, early] == REMOVED
        barred = absent @ task.neighbours[list(early)]
        barred[:, early] = False
        return fixing[~barred[self.frontier.parent(fixing), self.frontier.part(fixing)]]

    def _near_held(self, fixing: Rows) -> Rows:
        """Return candidates in which a part is fixed near one that robots hold, or that none is held before."""
        task = self.frontier.task
        if task.neighbours is None:
            return fixing
        held = near = (self.frontier.level == HELD) & ~task.boundary
        for _ in range(_NEAR_CONTACTS):
            near = near | _beside(near, task.neighbours)
        near = near | ~held.any(axis=1)[:, None]
        return fixing[near[self.frontier.parent(fixing), self.frontier.part(fixing)]]

    def _in_turn(self, fixed: Rows) -> Rows:
        """Return candidates in which every robot holds a part in turn over the states that they come from.

        What is held already is mostly released with the help of a part beside it, so such parts come first.
        """
        task, full = self.frontier.task, self.frontier.held(fixed) == self.frontier.task.robots
        rows = fixed[full]
        parent, beside = self.frontier.parent(rows), np.zeros(len(rows), dtype=bool)
        if task.neighbours is not None:
            holding = (self.frontier.level == HELD) & ~task.boundary
            beside = _beside(holding, task.neighbours)[parent, self.frontier.part(rows)]
        order = _stable_order(2 * parent + ~beside)
        begin = np.flatnonzero(np.diff(parent[order], prepend=-1))
        rank = np.empty(len(rows), dtype=np.int64)
        rank[order] = np.arange(len(rows)) - np.repeat(begin, np.diff(np.append(begin, len(rows))))
        return np.concatenate([fixed[~full], rows[_stable_order(rank // _TURN)]])

    def _hopeful_first(self, first: Callable[[int], Rows], wanted: int, width: int) -> Rows:
        """Return candidates that fixing a part leads to, those first from which a move is left that has not failed.

        Args:
            first: returns so many of them in order, or all if there are no more.
            wanted: number of candidates.
            width: of the beam.
        """
        task, count = self.frontier.task, wanted
        held = (self.frontier.level == HELD) & ~task.boundary
        loosened = INSTALLED if self.frontier.direction is Direction.ASSEMBLY else REMOVED
        while True:
            fixed = first(count)
            if self.failures is None or width >= _THOROUGH_WIDTH or not len(fixed):
                return fixed[:wanted]
            moves = self.frontier.parent(fixed), self.frontier.part(fixed)
            value = task.moved_value(self.frontier.action(fixed), self.frontier.direction)
            bad = self.failures.hopeless(self.frontier.level, held, *moves, value, loosened)
            if len(fixed) < count or len(fixed) - int(bad.sum()) >= wanted:
                return np.concatenate([fixed[~bad], fixed[bad]])[:wanted]
            count *= _FARTHER

    def _likely_ones(
        self, judge: CountingOracle, waiting: Rows, wanted: int, confirmed: Confirmation, *, later: bool
    ) -> tuple[Rows, Rows]:
        """As `_stable_ones`; moves that failed before are tried only where too few of the others are stable.

        With many robots that is at some levels only, unless it is not `later` possible.
        """
        if self.failures is None or not len(waiting):
            return self._stable_ones(judge, waiting, wanted, confirmed)
        frontier = self.frontier
        keys = self.failures.keys(frontier.states(waiting), frontier.part(waiting))
        failed = self.failures.failed(keys)
        kept, rejected = self._stable_ones(judge, waiting[~failed], wanted, confirmed)
        enough = wanted if wanted >= _THOROUGH_WIDTH else -(-wanted // _ENOUGH)
        if len(kept) < enough and failed.any():
            again = waiting[failed] if wanted > 1 else waiting[failed][: 0 if later and self._waits else _TRIED_AGAIN]
            more, bad = self._stable_ones(judge, again, enough - len(kept), confirmed)
            kept, rejected = np.concatenate([kept, more]), np.concatenate([rejected, bad])
        for rows, stable in ((kept, True), (rejected, False)):
            place = np.isin(waiting, rows)
            self.failures.learn(keys[place], np.full(int(place.sum()), stable))
        return kept, rejected

    @property
    def _waits(self) -> bool:
        """Whether a beam of width 1 tries no move again at this level."""
        state, many = self.frontier.level[0], self.frontier.task.robots > _FEW_ROBOTS
        return many and int((state != REMOVED).sum() + (state == INSTALLED).sum()) % _TRIED_AGAIN_EVERY > 0

    def _stable_ones(
        self, judge: CountingOracle, waiting: Rows, wanted: int, confirmed: Confirmation
    ) -> tuple[Rows, Rows]:
        """The first stable candidates of a list, about `wanted` of them, and those found not stable on the way."""
        frontier = self.frontier
        kept: list[Rows] = [waiting[:0]]
        rejected: list[Rows] = [waiting[:0]]
        position = 0
        while wanted > 0 and position < len(waiting):
            batch = waiting[position : position + (max(wanted, _VERDICT_BATCH) if position else wanted)]
            stable = judge.stable(frontier.states(batch), self.standing[frontier.parent(batch)])
            if stable.any():
                stable[stable] = confirmed(batch[stable])
            kept.append(batch[stable])
            rejected.append(batch[~stable])
            position += len(batch)
            wanted -= int(stable.sum())
        return np.concatenate(kept), np.concatenate(rejected)

    def _selection(self, kept: Rows, rejected: Rows) -> Selection:
        best_first = kept[np.argsort(-self.scores.of(kept), kind="stable")]
        return Selection(best_first, rejected, exhaustive=len(kept) + len(rejected) == len(self.frontier))


def _beside(some: Mask, neighbours: Mask) -> Mask:
    """Return which parts are in contact with at least one of some others, mostly few. Shapes (states, parts)."""
    parts = np.flatnonzero(some.any(axis=0))
    return some[:, parts].astype(np.float32) @ neighbours[parts].astype(np.float32) > 0


def _stable_order(keys: NDArray[np.int64]) -> Rows:
    """Return the order that sorts non-negative integers, equal ones as they were; NumPy sorts short ones faster."""
    return np.argsort(keys.astype(np.min_scalar_type(keys.max(initial=0))), kind="stable")
