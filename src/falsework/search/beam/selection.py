"""Selection of the candidates that a beam keeps and of those that need a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, REMOVED, States
from falsework.search.beam.failed_moves import FailedMoves
from falsework.search.beam.frontier import Frontier, Rows
from falsework.search.beam.paths import BeamPaths
from falsework.search.beam.scores import Scores
from falsework.search.beam.settings import AHEAD
from falsework.search.problem.oracle import CountingOracle
from falsework.search.problem.task import Direction

Clustering = Callable[[States, int, np.random.Generator], tuple[NDArray[np.integer], NDArray[np.number]]]
"""Method that puts points in a number of clusters, such as `k_means`: cluster and squared distance from its centre."""

_CHOICE = 4
"""Times as many states ahead are compared as are kept."""
_VERDICT_BATCH = 2
"""Candidates asked for at once at least, once the first were not enough: the states beyond those wanted leave the next
level a choice."""


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
    cluster: Clustering | None
    """Take one state of each cluster, then the next of each, and so on; else simply the best scored first."""
    pool: int
    """Bound on candidates times parts that are clustered at once; beyond it, of a random sample only."""
    rng: np.random.Generator
    """Breaks ties and seeds the clusters."""
    stable_ancestors: States
    """For each state of the level one near it that is known to be stable, shape (level, parts)."""
    judge: CountingOracle
    """Asked for verdicts."""
    failures: FailedMoves | None = None
    """Moves that failed before, which are tried last."""

    def order(self, rows: Rows, score: Callable[[Rows], NDArray[np.float64]], count: int) -> Rows:
        """Return rows in the order in which they are to be taken, where about `count` are wanted.

        Args:
            rows: some candidates, shape (rows,).
            score: of candidates; higher is better.
            count: number of clusters.
        """
        rows = self.rng.permutation(rows)
        if len(rows) <= count or self.cluster is None:
            return rows[np.argsort(-score(rows), kind="stable")]
        room = max(self.pool // self.frontier.task.part_count, 2 * count)
        # Rows are in random order, so the first ones are a fair sample.
        sample = rows[:room]
        labels, distance = self.cluster(self.frontier.states(sample), count, self.rng)
        order = np.lexsort((distance, -score(sample), labels))
        begin = np.flatnonzero(np.diff(labels[order], prepend=-1))
        rank = np.arange(len(sample)) - np.repeat(begin, np.diff(np.append(begin, len(sample))))
        return np.concatenate([sample[order[np.argsort(rank, kind="stable")]], rows[room:]])

    def select_from_all(self, width: int) -> Selection:
        """Ask for every candidate, then keep `width` stable ones, as in the paper."""
        frontier, rows = self.frontier, self.frontier.candidates()
        stable = frontier.free(rows)
        asked = rows[~stable]
        if len(asked):
            stable[~stable] = self.judge.stable(frontier.states(asked), self.stable_ancestors[frontier.parent(asked)])
        kept = self.order(rows[stable], self.scores.of, width)[:width]
        return self._selection(kept, rows[~stable])

    def select_lazily(self, width: int, lookahead: int, paths: BeamPaths, *, commit: bool) -> Selection:
        """Ask only until `width` states are found stable; keep `lookahead` more that a fixed part leads to.

        States that leave more robots free come first, then the better scored.

        Args:
            width: states to keep among those that a removal, or in assembly a release, leads to.
            lookahead: states to keep among those that fixing a part leads to; their verdicts wait until a descendant is
                kept.
            paths: second test of candidates with a stable verdict.
            commit: once `width` are found, drop states that keep more robots busy than these.
        """
        frontier, promise = self.frontier, self.scores.promise
        loose = self.order(np.flatnonzero(frontier.moves & ~frontier.fixing), promise, width)
        proven, rejected = self._verify_untried_first(loose, width, paths, waits=commit and self.judge.replayed)
        most_held = np.inf
        if commit and len(proven) >= width:
            most_held = float(frontier.held(proven).max())
        if self.cluster is not None:
            fixed = self.order(np.flatnonzero(frontier.fixing), promise, lookahead)
            fixed = fixed[frontier.held(fixed) <= most_held][:lookahead]
        else:
            fixed = self._hopeful_first(self.scores.best_fixing(_CHOICE * lookahead, most_held, self.rng), lookahead)
        return self._selection(np.concatenate([proven, fixed]), rejected)

    def _hopeful_first(self, fixed: Rows, count: int) -> Rows:
        """Return some of the candidates that fixing a part leads to, given best first.

        Half are the first; of the others those come first whose part was not found to fall, with the same parts around
        it, when it was let go of at once.
        """
        if self.failures is None or len(fixed) <= count:
            return fixed[:count]
        frontier, rest = self.frontier, fixed[count // 2 :]
        states, part = frontier.states(rest), frontier.part(rest)
        loose = INSTALLED if frontier.direction is Direction.ASSEMBLY else REMOVED
        states[np.arange(len(rest)), part] = loose
        falls = self.failures.failed(self.failures.keys(states, part))
        rest = rest[np.argsort(falls, kind="stable")]
        return np.concatenate([fixed[: count // 2], rest[: count - count // 2]])

    def _verify_untried_first(self, waiting: Rows, wanted: int, paths: BeamPaths, *, waits: bool) -> tuple[Rows, Rows]:
        """As `_verify_in_order`; moves that failed before, or after which a missing part would, are tried last.

        If it `waits`, they are tried again only from states in which no robot is free: with the same parts around it a
        part that slid once slides again, and until then something around it may still change. So do moves after which
        parts come to rest only far from where they were. Wider beams do not wait, so that they examine all.
        """
        if self.failures is None or not len(waiting):
            return self._verify_in_order(waiting, wanted, paths, waits=waits)
        frontier = self.frontier
        states, part = frontier.states(waiting), frontier.part(waiting)
        keys = self.failures.keys(states, part)
        failed = self.failures.failed(keys)
        if frontier.direction is Direction.ASSEMBLY:
            failed |= self.failures.traps(states, part)
        again = np.flatnonzero(failed)
        if waits:
            again = again[~frontier.fixing[frontier.parent(waiting[again])].any(axis=1)]
        again = again[: AHEAD * wanted]
        order = np.concatenate([np.flatnonzero(~failed), again])
        waiting, keys = waiting[order], keys[order]
        kept, rejected = self._verify_in_order(waiting, wanted, paths, waits=waits)
        for rows, stable in ((kept, True), (rejected, False)):
            place = np.isin(waiting, rows)
            self.failures.learn(keys[place], np.full(int(place.sum()), stable))
        return kept, rejected

    def _verify_in_order(self, waiting: Rows, wanted: int, paths: BeamPaths, *, waits: bool) -> tuple[Rows, Rows]:
        """The first stable candidates of a list, about `wanted` of them, and those found unstable meanwhile."""
        frontier = self.frontier
        kept: list[Rows] = [waiting[:0]]
        rejected: list[Rows] = [waiting[:0]]
        position = 0
        while wanted > 0 and position < len(waiting):
            batch = waiting[position : position + (max(wanted, _VERDICT_BATCH) if position else wanted)]
            stable = self.judge.stable(frontier.states(batch), self.stable_ancestors[frontier.parent(batch)])
            if stable.any():
                stable[stable] = paths.verifier(frontier, batch[stable], waits=waits)
            kept.append(batch[stable])
            rejected.append(batch[~stable])
            position += len(batch)
            wanted -= int(stable.sum())
        return np.concatenate(kept), np.concatenate(rejected)

    def _selection(self, kept: Rows, rejected: Rows) -> Selection:
        best_first = kept[np.argsort(-self.scores.of(kept), kind="stable")]
        return Selection(best_first, rejected, exhaustive=len(kept) + len(rejected) == len(self.frontier))
