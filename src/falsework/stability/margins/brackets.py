"""Bracketing search for the stability bound of a one-parameter family of conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from falsework.stability.margins.conditions import Answer, OutOfTime

ACCURACY = 0.01
"""Share of a bound to which it is known: the largest width of a bracket; the distance at which a proof is sought where
the outer end of a bracket could not be proven; and twice the share by which a family must be weaker than the weakest so
far to be searched. Documented; all margins are claimed and checked to it."""
FLOOR = 1e-4
"""Width at which a bracket near zero is narrow enough, in units of the family: shares of gravity, factors, weights of a
part and the largest settlement."""
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


def strides(growth: float) -> Iterator[float]:
    """Yield the ratios of successive probes from the bound of a nearby state: short at first, then `growth`.

    Bounds of successive states of a plan are mostly the same, or differ by a few per cent.
    """
    excess = 2.0 * ACCURACY
    while 1.0 + excess < growth:
        yield 1.0 + excess
        excess *= GROWTH
    yield from repeat(growth)


def largest(
    probe: Probe,
    start: Answer,
    *,
    guess: float,
    cap: float,
    low: float = 0.0,
    floor: float = 0.0,
    growth: float = GROWTH,
    near: bool = False,
    known: tuple[float, Answer] | None = None,
    cut: Callable[[Answer], float] | None = None,
) -> Bracket:
    """Find the largest stable value of a family: outwards in strides until one fails, then by halves.

    Failing probes are costly, so a value that fails is followed by one not far below it.

    Args:
        probe: the family.
        start: the stable answer at `low`.
        guess: value to try first.
        cap: value beyond which there is no bound.
        low: value at which the family is known to be stable.
        floor: absolute width at which a bracket is narrow enough.
        growth: ratio of successive probes while only one end is known.
        near: whether the guess is the bound of a nearby state, so that the first steps from it are short.
        known: a failing value and its answer, if known.
        cut: value down to which the velocity of a failing answer proves failure, if it proves it for others.
    """
    inside, (high, outside) = start, known if known is not None else (None, None)
    ratios, cut_last = strides(growth) if near else repeat(growth), False
    value = guess / (1.0 + ACCURACY) if near else guess
    if high is not None and not low < value < high:
        value = high / float(np.sqrt(growth))
    value = min(value if value > low else next(ratios) * low, cap)
    while True:
        try:
            answer = probe(value, inside)
        except OutOfTime:
            return Bracket(low, inside, high, outside, finished=False)
        before = high
        if answer.stands:
            low, inside, cut_last = value, answer, False
            if high is None and value >= cap:
                return Bracket(low, inside, None, None)
        else:
            proven = value if cut is None else min(cut(answer), value)
            # Successive cuts may take ever shorter steps; then bisection takes over.
            slow = cut_last and before is not None and before - proven < 0.5 * (before - low)
            cut_last = low < proven < value and not slow
            high, outside = max(proven, low * (1.0 + 1e-9)), answer
        if high is None:
            value = min(next(ratios) * value, cap)
        elif high - low <= max(ACCURACY * low, floor):
            return Bracket(low, inside, high, outside)
        elif cut_last:
            value = high - 0.25 * max(ACCURACY * high, floor)
        elif low < high / growth:
            value = max(high / next(ratios), float(np.sqrt(low * high)))
        else:
            value = 0.5 * (low + high)


def checked(
    bracket: Bracket,
    probe: Callable[[float, Answer | None], Answer],
    start: Answer,
    again: Callable[[float, Answer], Bracket],
    origin: float = 0.0,
) -> Bracket:
    """Probe a family half way to its bound; where it fails there, return the bound before that.

    Args:
        bracket: the bound.
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


def weakest(
    families: Sequence[int],
    test: Callable[[int, float], Answer],
    bound: Callable[[int, tuple[float, Answer] | None], Bracket],
    cap: float,
    start: Answer,
) -> tuple[int, Bracket] | None:
    """Find the family with the least bound, without a search for the bounds of the others.

    A monotone family that is stable at the least bound so far is not weaker, so for most families one probe is enough.
    It is made just inside that bound, within the 1 % to which a bound is known.

    Args:
        families: those to compare, likely weakest first.
        test: answer of a family at a value.
        bound: bound of a family, given a failing value and its answer where known.
        cap: value beyond which there is no bound.
        start: the stable answer at 0.

    Returns:
        The family and its bracket, without an outer end where no family has a bound; None without families.
    """
    best: tuple[int, Bracket] | None = None
    for family in families:
        known = None
        try:
            if best is not None:
                # Where the first has no bound, others mostly have none either.
                value = cap if best[1].outside is None else (1.0 - ACCURACY / 2) * best[1].inside
                answer = test(family, value)
                if answer.stands:
                    continue
                known = value, answer
            bracket = bound(family, known)
        except OutOfTime:
            bracket = Bracket(0.0, start, None, None, finished=False)
        if not bracket.finished:  # nothing is known of the families that were not tested
            least = bracket if best is None or bracket.outside is not None else best[1]
            return family, Bracket(0.0, start, least.outside, least.fails, finished=False)
        if best is None or bracket.outside is not None:
            best = family, bracket
    return best
