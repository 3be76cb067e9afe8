"""Bracketing search for the stability bound of a one-parameter family of conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from falsework.stability.margins.conditions import Answer, OutOfTime

ACCURACY = 0.01
"""Share of a bound to which it is known: the largest width of a bracket; the distance at which a proof is sought where
the outer end of a bracket could not be proven; and twice the share by which a family must be weaker than the weakest so
far to be searched. Documented; all margins are claimed and checked to it."""
FLOOR = ACCURACY**2
"""Width at which a bracket near zero is narrow enough, in units of the family (shares of gravity, factors, weights of a
part and the largest settlement): that of a bound of `ACCURACY` units."""
GROWTH = 4.0
"""Ratio of successive probes while only one end of a bracket is known; chosen by numbers of probes."""

Probe = Callable[[float, Answer], Answer]
"""Solution at a value of the parameter, warm-started from a nearby one."""


@dataclass(frozen=True, eq=False)
class Bracket:
    """Bracket of the stability bound of a family: the last stable value and the first failing one."""

    inside: float
    """Last stable value."""
    stands: Answer
    outside: float | None
    """A failing value within `ACCURACY` of `inside`; None where there is no bound."""
    fails: Answer | None
    monotone: bool = True
    """Whether every probed value between the unmodified state and the bound is stable."""
    finished: bool = True
    """Whether the search ended before its time was over; if not, the bracket is wider."""


def strides() -> Iterator[float]:
    """Yield the ratios of successive probes from the bound of a nearby state: short at first, then `GROWTH`.

    Bounds of successive states of a plan are mostly the same, or differ by a few per cent.
    """
    excess = 2.0 * ACCURACY
    while 1.0 + excess < GROWTH:
        yield 1.0 + excess
        excess *= GROWTH
    yield from repeat(GROWTH)


class Interval:
    """Bracket of the bound of one family while it is searched: outwards in strides until one fails, then by halves."""

    def __init__(
        self,
        start: Answer,
        *,
        guess: float,
        cap: float,
        low: float = 0.0,
        floor: float = 0.0,
        known: tuple[float, Answer] | None = None,
        cut: Callable[[Answer], float] | None = None,
    ) -> None:
        """Take the family.

        Args:
            start: the stable answer at `low`.
            guess: value to try first.
            cap: value beyond which there is no bound.
            low: value at which the family is known to be stable.
            floor: absolute width at which a bracket is narrow enough.
            known: a failing value and its answer, if known.
            cut: value down to which the velocity of a failing answer proves failure, if it proves it for others.
        """
        self.low, self.stands = low, start
        self.high, self.fails = known if known is not None else (None, None)
        self._guess: float | None = guess
        self._cap, self._floor, self._cut = cap, floor, cut
        self._ratios: Iterator[float] = repeat(GROWTH)

    def begin_near(self, bound: float) -> None:
        """Begin at the bound of a nearby state."""
        self._guess = bound / (1.0 + ACCURACY)
        self.step_shortly()

    def step_shortly(self) -> None:
        """Go on in steps that are short at first: the bound is likely near."""
        self._ratios = strides()

    @property
    def unbounded(self) -> bool:
        """Whether the family is stable up to the cap."""
        return self.high is None and self.low >= self._cap

    @property
    def narrow(self) -> bool:
        """Whether the bracket is narrow enough."""
        return self.high is not None and self.high - self.low <= self._width(self.low)

    def _width(self, value: float) -> float:
        return max(ACCURACY * value, self._floor)

    def next_value(self) -> float:
        """Return the value to probe next."""
        guess, self._guess = self._guess, None
        if guess is not None and self.low < guess < (np.inf if self.high is None else self.high):
            return min(guess, self._cap)
        if self.high is None:
            return min(next(self._ratios) * self.low, self._cap)
        if self.low < self.high / GROWTH:
            return max(self.high / next(self._ratios), float(np.sqrt(self.low * self.high)))
        return 0.5 * (self.low + self.high)

    def record(self, value: float, answer: Answer) -> bool:
        """Keep the answer at a value; return whether it is stable."""
        if answer.stands:
            self.low, self.stands = value, answer
        else:
            proven = value if self._cut is None else min(self._cut(answer), value)
            self.high, self.fails = max(proven, self.low * (1.0 + 1e-9)), answer
        return answer.stands

    def reopen(self, value: float, answer: Answer) -> None:
        """Go on from a stable answer at or beyond the outer end."""
        self.low, self.stands, self.high, self.fails = value, answer, None, None
        self.step_shortly()

    def bracket(self, *, finished: bool = True) -> Bracket:
        """Return the bracket as it is."""
        return Bracket(self.low, self.stands, self.high, self.fails, finished=finished)


def largest(probe: Probe, search: Interval) -> Bracket:
    """Return the bracket of the largest stable value of a family; not finished where the time ends before."""
    while not (search.narrow or search.unbounded):
        value = search.next_value()
        try:
            answer = probe(value, search.stands)
        except OutOfTime:
            return search.bracket(finished=False)
        search.record(value, answer)
    return search.bracket()


def checked(
    bracket: Bracket,
    probe: Callable[[float, Answer | None], Answer],
    start: Answer,
    again: Callable[[float, Answer], Bracket],
    origin: float = 0.0,
) -> Bracket:
    """Probe a family half way to its bound; where it fails there, return the bound before that.

    Args:
        probe: the family; solves from rest where no nearby answer is given.
        start: the answer at `origin`.
        again: finds the bound between `origin` and a failing value, given with its answer.
        origin: value of the unmodified state.
    """
    value = 0.5 * (origin + bracket.inside)
    # Iterations that find no rest position from one start do not show that there is none.
    answer = probe(value, None)
    for near in (start, bracket.stands):
        answer = answer if answer.stands else probe(value, near)
    if answer.stands:
        return bracket
    return replace(again(value, answer), monotone=False)
