"""Search for the weakest of many families of conditions, or the bound of one, in which failing probes are costly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from falsework.stability.margins.brackets import ACCURACY, GROWTH, Bracket, Interval
from falsework.stability.margins.conditions import Answer, OutOfTime

_COARSE = float(np.sqrt(GROWTH))
"""Ratio of the ends of a bracket, split once, at which the other families are tested before it is narrowed further, and
of two values up to which a probe under one may start from another family's rest under the other."""
Probe = Callable[[Sequence[int], float, Sequence[Answer | int]], list[Answer]]
"""Answers of families at a value by quick probes, until the first that fails. Each is warm-started from an answer, or
from that of an earlier family in the list, given by its index."""


class Weakest:
    """Brackets of the bounds of families, of which only the least one is narrowed.

    A family that is stable at the least bound so far is not weaker. So all families are tested at the inner end of a
    coarse bracket first; then the bracket of the weakest is narrowed, and the others are tested at its inner end again.
    """

    def __init__(
        self,
        families: Sequence[int],
        probe: Probe,
        start: Answer,
        *,
        guess: Callable[[int], float],
        cap: float,
        low: float = 0.0,
        floor: Callable[[int], float],
        around: bool = False,
        sample: int | None = None,
        hurry: bool = False,
        cut: Callable[[int, Answer], float] | None = None,
        near: float | None = None,
    ) -> None:
        """Take the families.

        Args:
            families: those to compare, likely weakest first.
            probe: answers of families at a value.
            start: the stable answer at 0.
            guess: value of a family to try first.
            cap: value beyond which there is no bound.
            low: value at which all are known to be stable.
            floor: absolute width at which the bracket of a family is narrow enough.
            around: whether families are numbered around a circle; a probe starts from the rest of a family nearby.
            sample: number of the first families that are tested before the weakest of them is narrowed; all by
                default.
            hurry: whether the time is limited, so that what all families bear is found first, if roughly.
            cut: as for `Interval`, of each family.
            near: bound of the first family in a nearby state.
        """
        self._families, self._probe, self._cap = list(families), probe, cap
        self._searches = {
            row: Interval(
                start,
                guess=guess(row),
                cap=cap,
                low=low,
                floor=floor(row),
                cut=None if cut is None else partial(cut, row),
            )
            for row in families
        }
        if near is not None and self._families:
            self._searches[self._families[0]].begin_near(near)
        self._first = max(min(map(guess, families), default=0.0) / (2.0 * GROWTH), (1.0 + 2.0 * ACCURACY) * low)
        self._distance = _distances(len(self._families)) if around else None
        self._beyond = True
        """Whether families are tested beyond the least bound: until one fails, since failures are costly."""
        self._batch = 1 if hurry else max(len(self._families), 1)  # the time is looked at between two calls
        self._sample, self._hurry = self._families[:sample], hurry

    def search(self, confirm: Callable[[int, float, Answer], tuple[float, Answer]]) -> tuple[int, Bracket] | None:
        """Return the weakest family and its bracket, without an outer end where none has a bound; None without any.

        Args:
            confirm: answer of a family at a value at which a quick probe failed, given that answer, or a stable one at
                a larger value.
        """
        try:
            return self._search(confirm)
        except OutOfTime:
            searches = self._searches.values()
            least = min(self._families, key=lambda row: self._searches[row].low)
            failing = ((search.high, search.fails) for search in searches if search.high is not None)
            outside, fails = min(failing, key=lambda known: known[0], default=(None, None))
            return least, replace(self._searches[least].bracket(finished=False), outside=outside, fails=fails)

    def _search(self, confirm: Callable[[int, float, Answer], tuple[float, Answer]]) -> tuple[int, Bracket] | None:
        confirmed: dict[int, float] = {}
        last = None
        if self._hurry:
            self._raise_all(self._first)
        while True:
            bounded = {row: search.high for row, search in self._searches.items() if search.high is not None}
            if not bounded:
                rows = [row for row in self._families if not self._searches[row].unbounded]
                if not rows:
                    row = next(iter(self._families), None)
                    return None if row is None else (row, self._searches[row].bracket())
                self._raise(last if last in rows else rows[0])
                continue
            best = last = min(bounded, key=lambda row: self._searches[row].low)
            search, high = self._searches[best], bounded[best]
            if not search.narrow and high > _COARSE * search.low:
                self._ask(best, search.next_value())
                continue
            value = (1.0 - ACCURACY / 2) * search.low
            least = (1.0 - ACCURACY / 2) * value  # the least bound may rise so far without a new test of the others
            rows, demand = (self._families, least) if search.narrow else (self._sample, value / _COARSE)
            left = [row for row in rows if row != best and self._searches[row].low < demand]
            if left:
                self._test(best, left, value, high)
            elif not search.narrow:
                self._ask(best, search.next_value())
            elif confirmed.get(best) == high or search.fails is None:
                return best, search.bracket()
            else:
                value, answer = confirm(best, high, search.fails)
                confirmed[best] = high
                if answer.stands:
                    search.reopen(value, answer)
                else:
                    search.high, search.fails = value, answer

    def _raise_all(self, value: float) -> None:
        """Raise the loads of all families together until one fails or the cap is reached."""
        while value < self._cap:
            for first in range(0, len(self._families), self._batch):
                if not self._probe_all(self._families[first : first + self._batch], value):
                    return
            value *= 2.0

    def _raise(self, row: int) -> None:
        """Raise a load until it fails or reaches the cap, at once where others have reached it."""
        search = self._searches[row]
        if self._beyond and any(other.unbounded for other in self._searches.values()):
            self._beyond = self._ask(row, self._cap)
            return
        while self._ask(row, search.next_value()) and not search.unbounded:
            pass

    def _test(self, best: int, left: Sequence[int], value: float, high: float) -> None:
        """Test families at a value below which they are known to be stable, or beyond the bound, to do so only once."""
        distance = self._distance
        if distance is None:
            self._beyond &= self._probe_all(left[: self._batch], high if self._beyond else value)
            return
        sampled = [row for row in left if row in self._sample]
        rows = sampled or sorted(left, key=distance[best].__getitem__)
        self._probe_all(rows[: self._batch], value)

    def _probe_all(self, rows: Sequence[int], value: float) -> bool:
        """Probe families at a value until one fails; return whether none does."""
        answers = self._probe(rows, value, self._origins(rows, value))
        for row, answer in zip(rows, answers, strict=False):
            self._searches[row].record(value, answer)
        return answers[-1].stands

    def _origins(self, rows: Sequence[int], value: float) -> list[Answer | int]:
        """Return where to start the probe of each family: its last rest, or that of a neighbour or one before it."""
        searches, distance = self._searches, self._distance
        if distance is None:
            return [searches[row].stands for row in rows]
        known = [row for row in self._families if value / _COARSE <= searches[row].low <= _COARSE * value]
        kin, origins = np.array([*known, *rows]), list[Answer | int]()
        for place, row in enumerate(rows):
            near = kin[: len(known) + place]
            first = int(distance[row, near].argmin()) if len(near) else -1
            if first >= len(known):
                origins.append(first - len(known))
                continue
            own = searches[row]
            other = searches[known[first]] if first >= 0 else own
            origins.append((other if abs(other.low - value) < abs(own.low - value) else own).stands)
        return origins

    def _ask(self, row: int, value: float) -> bool:
        """Probe a family and keep the answer; return whether it is stable."""
        (answer,) = self._probe([row], value, [self._searches[row].stands])
        return self._searches[row].record(value, answer)


def _distances(count: int) -> NDArray[np.intp]:
    """Return the distances of points on a circle, in steps, shape (count, count)."""
    turns = np.subtract.outer(np.arange(count), np.arange(count)) % count
    return np.minimum(turns, count - turns)
