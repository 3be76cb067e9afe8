"""Search for the weakest of many families of conditions, in which failing probes are costly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from falsework.stability.margins.brackets import ACCURACY, GROWTH, Bracket, strides
from falsework.stability.margins.conditions import Answer, OutOfTime

_COARSE = float(np.sqrt(GROWTH))
"""Ratio of the ends of a bracket, split once, at which the other families are tested before it is narrowed further, and
of two values up to which a probe under one may start from another family's rest under the other."""
_BATCH = 1000
"""Families that are tested in one call, divided by the number of parts."""
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
        floor: Callable[[int], float],
        around: bool = False,
        sample: int | None = None,
        hurry: bool = False,
    ) -> None:
        """Take the families.

        Args:
            families: those to compare, likely weakest first.
            probe: answers of families at a value.
            start: the stable answer at 0.
            guess: value of a family to try first.
            cap: value beyond which there is no bound.
            floor: absolute width at which the bracket of a family is narrow enough.
            around: whether families are numbered around a circle; a probe starts from the rest of a family nearby.
            sample: number of the first families that are tested before the weakest of them is narrowed; all by
                default.
            hurry: whether the time is limited, so that what all families bear is found first, if roughly.
        """
        self._families, self._probe, self._guess = list(families), probe, guess
        self._cap, self._floor = cap, floor
        self._distance = _distances(len(self._families)) if around else None
        self._beyond = True
        """Whether families are tested beyond the least bound: until one fails, since failures are costly."""
        self._batch = max(_BATCH // max(len(start.condition.extra), 1), 1)
        self._sample, self._hurry = self._families[:sample], hurry
        self._low = dict.fromkeys(families, (0.0, start))
        self._high: dict[int, tuple[float, Answer]] = {}

    def search(
        self, confirm: Callable[[int, float, Answer], tuple[float, Answer]], near: float | None = None
    ) -> tuple[int, Bracket] | None:
        """Return the weakest family and its bracket, without an outer end where none has a bound; None without any.

        Args:
            confirm: answer of a family at a value at which a quick probe failed, given that answer, or a stable one at
                a larger value.
            near: bound of the first family in a nearby state.
        """
        try:
            return self._search(confirm, near)
        except OutOfTime:
            least = min(self._families, key=lambda row: self._low[row][0])
            failing = min(self._high.values(), key=lambda known: known[0], default=(None, None))
            return least, Bracket(*self._low[least], *failing, finished=False)

    def _search(
        self, confirm: Callable[[int, float, Answer], tuple[float, Answer]], near: float | None
    ) -> tuple[int, Bracket] | None:
        confirmed: dict[int, float] = {}
        last = None
        if self._hurry and self._families:
            self._raise_all(min(self._guess(row) for row in self._families) / (2.0 * GROWTH))
        while True:
            if not self._high:
                rows = [row for row in self._families if self._low[row][0] < self._cap]
                if not rows:
                    row = next(iter(self._families), None)
                    return None if row is None else (row, Bracket(*self._low[row], None, None))
                row = last if last in rows else rows[0]
                self._raise(row, self._guess(row) if near is None else near, near is not None or row == last)
                near = None
                continue
            best = min(self._high, key=lambda row: self._low[row][0])
            last = best
            low, high = self._low[best][0], self._high[best][0]
            narrow = high - low <= max(ACCURACY * low, self._floor(best))
            if not narrow and high > _COARSE * low:
                self._narrow(best)
                continue
            value = (1.0 - ACCURACY / 2) * low
            least = (1.0 - ACCURACY / 2) * value  # the least bound may rise so far without a new test of the others
            rows, demand = (self._families, least) if narrow else (self._sample, value / _COARSE)
            left = [row for row in rows if row != best and self._low[row][0] < demand]
            if left:
                self._test(best, left, value, high)
            elif not narrow:
                self._narrow(best)
            elif confirmed.get(best) == high:
                return best, self._bracket(best)
            else:
                value, answer = confirm(best, *self._high.pop(best))
                confirmed[best] = high
                (self._low if answer.stands else self._high)[best] = value, answer

    def _bracket(self, row: int) -> Bracket:
        (low, stands), (high, fails) = self._low[row], self._high[row]
        return Bracket(low, stands, high, fails)

    def _raise_all(self, value: float) -> None:
        """Raise the loads of all families together until one fails or the cap is reached."""
        while value < self._cap:
            for first in range(0, len(self._families), self._batch):
                if not self._probe_all(self._families[first : first + self._batch], value):
                    return
            value *= 2.0

    def _raise(self, row: int, value: float, near: bool) -> None:
        """Raise a load until it fails or reaches the cap, at once where others have reached it."""
        if self._beyond and any(low >= self._cap for low, _ in self._low.values()):
            self._beyond = self._ask(row, self._cap, self._low[row][1])
            return
        ratios = strides(GROWTH) if near else repeat(GROWTH)
        value = min(max(value, (1.0 + 2.0 * ACCURACY) * self._low[row][0]), self._cap)
        while self._ask(row, value, self._low[row][1]) and value < self._cap:
            value = min(next(ratios) * value, self._cap)

    def _narrow(self, row: int) -> None:
        """Probe a family within its bracket."""
        low, high = self._low[row][0], self._high[row][0]
        if low == 0.0:
            value = min(self._guess(row), high / GROWTH)
        elif low < high / GROWTH:
            value = float(np.sqrt(low * high))
        else:
            value = 0.5 * (low + high)
        self._ask(row, value, self._low[row][1])

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
            self._keep(row, value, answer)
        return answers[-1].stands

    def _origins(self, rows: Sequence[int], value: float) -> list[Answer | int]:
        """Return where to start the probe of each family: its last rest, or that of a neighbour or one before it."""
        lows, distance = self._low, self._distance
        if distance is None:
            return [lows[row][1] for row in rows]
        known = [row for row in self._families if value / _COARSE <= lows[row][0] <= _COARSE * value]
        kin, origins = np.array([*known, *rows]), list[Answer | int]()
        for place, row in enumerate(rows):
            near = kin[: len(known) + place]
            first = int(distance[row, near].argmin()) if len(near) else -1
            if first >= len(known):
                origins.append(first - len(known))
                continue
            low, own = lows[row]
            other, rest = lows[known[first]] if first >= 0 else lows[row]
            origins.append(rest if abs(other - value) < abs(low - value) else own)
        return origins

    def _ask(self, row: int, value: float, near: Answer) -> bool:
        """Probe a family and keep the answer; return whether it is stable."""
        (answer,) = self._probe([row], value, [near])
        self._keep(row, value, answer)
        return answer.stands

    def _keep(self, row: int, value: float, answer: Answer) -> None:
        (self._low if answer.stands else self._high)[row] = value, answer


def _distances(count: int) -> NDArray[np.intp]:
    """Return the distances of points on a circle, in steps, shape (count, count)."""
    turns = np.subtract.outer(np.arange(count), np.arange(count)) % count
    return np.minimum(turns, count - turns)
