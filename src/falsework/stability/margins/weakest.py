"""Bounds of families of conditions of a state, less friction and larger loads, of which the weakest counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.margins.brackets import ACCURACY, FLOOR, GROWTH, Bracket, Interval, checked, largest
from falsework.stability.margins.conditions import Answer, Condition, OutOfTime
from falsework.stability.margins.prober import Prober
from falsework.stability.strength import SMOOTH

Array = NDArray[np.float64]
Near = dict[str, tuple[int, float]]
"""Bounds of a nearby state: the number of the weakest load, and its bound."""


class Weakest:
    """Brackets of the bounds of families of conditions of a state, of which only the least one is narrowed.

    A family that is stable at the least bound so far is not weaker. So the bracket of the first family, likely the
    weakest, is narrowed, and the others are tested at its inner end; one that fails takes its place.
    """

    def __init__(
        self,
        prober: Prober,
        state: States,
        start: Answer,
        under: Callable[[int, float], Condition],
        order: Sequence[int],
        *,
        guess: Callable[[int], float],
        cap: float,
        low: float = 0.0,
        near: Near | None = None,
        name: str = "load",
        numbers: Sequence[int] | None = None,
        loads: Array | None = None,
    ) -> None:
        """Take the families.

        Args:
            state: shape (parts,).
            start: the stable answer for the unmodified state.
            under: condition of a family at a value, mostly a multiple of a load.
            order: order in which to try the families.
            guess: guess at the bound of a family.
            cap: value beyond which there is no bound.
            low: value at which all are known to be stable.
            near: weakest family of a nearby state, and its bound; replaced by that of this one.
            name: under which it is in `near`.
            numbers: identifier of each family, the same in all states; its index by default.
            loads: where values are multiples of loads, these, N and Nm, shape (families, parts, 6).
        """
        self._prober, self._state, self._start, self._under = prober, state, start, under
        self._guess, self._cap, self._low, self._loads = guess, cap, low, loads
        self._near, self._name = {} if near is None else near, name
        self._numbers = range(max(order, default=-1) + 1) if numbers is None else numbers
        weak, bound = self._near.get(name, (-1, 0.0))
        self._families = sorted(order, key=lambda row: self._numbers[row] != weak)
        self._searches = {row: self._interval(row) for row in self._families}
        if self._families and self._numbers[self._families[0]] == weak:
            self._searches[self._families[0]].begin_near(bound)
        self._batch = 1 if prober.limited else max(len(self._families), 1)  # one call is not cut short

    def _interval(self, row: int, known: tuple[float, Answer] | None = None) -> Interval:
        """Return the bracket of a family at its beginning, with a failing value and its answer if known."""
        loads, guess = self._loads, self._guess(row)
        cut = None if loads is None else lambda failed: self._prober.cut(self._state, failed, loads[row])
        return Interval(
            self._start, guess=guess, cap=self._cap, low=self._low, floor=FLOOR * guess, known=known, cut=cut
        )

    def find(self) -> tuple[int, Bracket] | None:
        """Return the family with the least bound, and its bracket; None without families.

        Where none has a bound, the bracket is that of the first one, up to the cap.
        """
        found = self._search()
        if found is None:
            return None
        row, bracket = found
        if not self._prober.convex and bracket.finished and bracket.fails is not None:

            def again(value: float, failed: Answer) -> Bracket:
                return largest(partial(self._ask, row), self._interval(row, (value, failed)))

            try:
                if self._name == "friction":  # a check of it starts from rest, and near the bound the start matters
                    loaded = self._ask(row, bracket.inside)
                    bracket = replace(bracket, stands=loaded) if loaded.stands else again(bracket.inside, loaded)
                bracket = checked(bracket, partial(self._ask, row), self._start, again, origin=self._low)
            except OutOfTime:
                bracket = replace(bracket, finished=False)
        if bracket.outside is not None and bracket.finished:
            self._near[self._name] = self._numbers[row], bracket.inside
        return row, bracket

    def _ask(self, row: int, value: float, near: Answer | None = None) -> Answer:
        return self._prober.ask(self._state, self._under(row, value), near, coarse=True)

    def _search(self) -> tuple[int, Bracket] | None:
        """Return the weakest family and its bracket as quick probes find it, with an outer end that is confirmed."""
        try:
            if self._prober.limited and self._families:  # what all families bear is found first, if roughly
                least = min(map(self._guess, self._families)) / (2.0 * GROWTH)
                self._raise_all(max(least, (1.0 + 2.0 * ACCURACY) * self._low))
            while (best := self._weakest()) is not None:
                search = self._searches[best]
                assert search.high is not None
                if search.fails is None:
                    return best, search.bracket()
                answer = self._confirmed(best, search.high, search.fails)
                if not answer.stands:
                    search.fails = answer
                    return best, search.bracket()
                search.reopen(search.high, answer)
            row = next(iter(self._families), None)
            return None if row is None else (row, self._searches[row].bracket())
        except OutOfTime:
            searches = self._searches.values()
            least = min(self._families, key=lambda row: self._searches[row].low)
            failing = ((search.high, search.fails) for search in searches if search.high is not None)
            outside, fails = min(failing, key=lambda known: known[0], default=(None, None))
            return least, replace(self._searches[least].bracket(finished=False), outside=outside, fails=fails)

    def _confirmed(self, row: int, value: float, failed: Answer) -> Answer:
        """Return the answer of a family from rest, where a quick probe failed."""
        if not failed.coarse:
            # A velocity may prove failure below the value at which it was found.
            return replace(failed, condition=self._under(row, value))
        answer = self._prober.ask(self._state, self._under(row, value))
        return replace(answer, moves_away=not answer.stands and (answer.moves_away or failed.moves_away))

    def _weakest(self) -> int | None:
        """Return the family with the least bound, with a narrow bracket; None where none has a bound."""
        best, left = None, list(self._families)
        while left:
            if best is None:
                row = left.pop(0)
                self._raise(row)
                if self._searches[row].unbounded:
                    continue
            else:
                value = (1.0 - ACCURACY / 2) * self._searches[best].low
                least = (1.0 - ACCURACY / 2) * value  # the least bound may rise so far without a new test
                left = [row for row in left if self._searches[row].low < least]
                row = next((row for row in left if (self._searches[row].high or np.inf) <= value), -1)
                if row >= 0:
                    left.remove(row)
                else:
                    some = left[: self._batch]
                    answers = self._probe_all(some, value) if some else []
                    del left[: len(answers)]
                    if not answers or answers[-1].stands:
                        continue
                    row = some[len(answers) - 1]
                    self._searches[row].step_shortly()
            while not self._searches[row].narrow:
                self._probe_all([row], self._searches[row].next_value())
            best = row
        return best

    def _raise_all(self, value: float) -> None:
        """Raise the loads of all families together until one fails or the cap is reached."""
        while value < self._cap:
            for first in range(0, len(self._families), self._batch):
                if not self._probe_all(self._families[first : first + self._batch], value)[-1].stands:
                    return
            value *= 2.0

    def _raise(self, row: int) -> None:
        """Raise a load until it fails or reaches the cap, at once where others have reached it."""
        search = self._searches[row]
        while search.high is None and not search.unbounded:
            beyond = any(other.unbounded for other in self._searches.values())
            self._probe_all([row], self._cap if beyond else search.next_value())

    def _probe_all(self, rows: Sequence[int], value: float) -> list[Answer]:
        """Probe families at a value, each from its last rest, until one fails."""
        conditions, near = [self._under(row, value) for row in rows], [self._searches[row].stands for row in rows]
        answers = self._prober.ask_each(self._state, conditions, near)
        for row, answer in zip(rows, answers, strict=False):
            self._searches[row].record(value, answer)
        return answers


def friction_bracket(prober: Prober, state: States, start: Answer, near: Near) -> Bracket | None:
    """Return the bracket of the least friction; None where joints have friction but the structure has none.

    Args:
        state: shape (parts,).
        start: the stable answer for the unmodified state.
        near: bound of a nearby state; replaced by that of this one.
    """
    extra, own = start.condition.extra, start.condition.friction
    floor = SMOOTH * max(own, 1.0)
    if not prober.assembly.has_common_friction:
        return None
    bracket = Bracket(own, start, None, None)
    if own > floor:
        found = Weakest(
            prober,
            state,
            start,
            lambda _, inverse: Condition(1.0 / inverse, extra),
            [0],
            guess=lambda _: 2.0 / own,
            cap=1.0 / floor,
            low=1.0 / own,
            near=near,
            name="friction",
        ).find()
        assert found is not None  # there is one family
        bracket = found[1]
        outside = None if bracket.outside is None else 1.0 / bracket.outside
        bracket = replace(bracket, inside=1.0 / bracket.inside, outside=outside)
    if own == 0.0 or bracket.outside is not None or not bracket.finished:
        return bracket
    smooth = prober.ask(state, Condition(0.0, extra))
    return Bracket(0.0, smooth, None, None) if smooth.stands else replace(bracket, outside=0.0, fails=smooth)
