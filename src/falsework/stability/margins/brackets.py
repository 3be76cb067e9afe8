"""Bracketing search for the stability bound of a one-parameter family of conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from falsework.stability.margins.conditions import Answer, OutOfTime

SHARE = 0.005
"""Largest width of a bracket, as a share of the bound."""
OUTSIDE = 0.01
"""Distance from the bound at which a proof is sought where the outer end of the bracket could not be proven."""
_BESIDE = 0.4
"""Distance of the next probe below the value down to which a velocity proves failure, as a share of `SHARE`."""
GROWTH = 4.0
"""Ratio of successive probes while only one end of a bracket is known."""
WIDTH = 0.009
"""The same as `SHARE` for families in which failing probes are costly."""
STRIDES = (1.0 + 2.0 * WIDTH, 1.06, 1.4)
"""Ratios of successive probes, starting from the bound of a nearby state, before `GROWTH` applies."""
_BELOW = 1.3
"""Ratio of a failing value to the next one below it."""
SLACK = 0.004
"""Share of the least bound so far by which a family must be weaker to be searched: of equal ones only one is."""
_CHECKED = (0.4, 0.75)
"""Shares of a bound at which a family that need not be monotone is probed again."""

Probe = Callable[[float, Answer], Answer]
"""Solution at a value of the parameter, warm-started from a nearby one."""


@dataclass(frozen=True, eq=False)
class Bracket:
    """Bracket of the stability bound of a family: the last stable value and the first failing one."""

    inside: float
    """Last stable value."""
    stands: Answer
    outside: float | None
    """A failing value within `SHARE` of `inside`; None where there is no bound."""
    fails: Answer | None
    monotone: bool = True
    """Whether every probed value between the unmodified state and the bound is stable."""
    finished: bool = True
    """Whether the search ended before its time was over; if not, the bracket is wider."""


def largest(
    probe: Probe,
    start: Answer,
    *,
    guess: float,
    cap: float,
    floor: float = 0.0,
    cut: Callable[[Answer], float] | None = None,
    known: tuple[float, Answer] | None = None,
) -> Bracket:
    """Find the largest stable value of a family from 0 up.

    Args:
        probe: the family.
        start: the stable answer at 0.
        guess: value to try first.
        cap: value beyond which there is no bound.
        floor: absolute width at which a bracket is narrow enough.
        cut: value down to which the velocity of an answer proves failure.
        known: a failing value and its answer, if known.
    """
    low, inside = 0.0, start
    high, outside = known if known is not None else (None, None)
    value, cut_last = min(guess, cap), False
    if high is not None:
        value = high * (1.0 - SHARE * _BESIDE)
    while True:
        try:
            answer = probe(value, inside)
        except OutOfTime:
            return Bracket(low, inside, high, outside, finished=False)
        shrunk = high
        if answer.stands:
            low, inside, cut_last = value, answer, False
            if high is None and value >= cap:
                return Bracket(low, inside, None, None)
        else:
            high, outside = value, answer
            proven = np.inf if cut is None else cut(answer)
            # Successive cuts may take ever shorter steps; then bisection takes over.
            slow = cut_last and shrunk is not None and shrunk - min(proven, value) < 0.5 * (shrunk - low)
            cut_last = low < proven < value and not slow
            if proven < value:
                high = max(proven, low * (1.0 + 1e-9))
        if high is None:
            value = min(GROWTH * value, cap)
            continue
        if high - low <= max(SHARE * low, floor):
            return Bracket(low, inside, high, outside)
        if cut_last:
            value = high * (1.0 - SHARE * _BESIDE)
        elif low > high / GROWTH:
            value = 0.5 * (low + high)
        else:
            value = np.sqrt(low * high) if low > 0.0 else high / GROWTH


def stride(
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
) -> Bracket:
    """Find the largest stable value of a family in which a failing probe is costly and says nothing of other values.

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
    """
    inside, (high, outside) = start, known if known is not None else (None, None)
    ratios = iter(STRIDES if near else (_BELOW,) if known is not None else ())
    value = guess / (1.0 + WIDTH) if near else guess
    if high is not None and not low < value < high:
        value = high / next(ratios, growth)
    value = min(value if value > low else next(ratios, growth) * low, cap)
    while True:
        try:
            answer = probe(value, inside)
        except OutOfTime:
            return Bracket(low, inside, high, outside, finished=False)
        if answer.stands:
            low, inside = value, answer
            if high is None and value >= cap:
                return Bracket(low, inside, None, None)
        else:
            high, outside = value, answer
        if high is None:
            value = min(next(ratios, growth) * value, cap)
        elif high - low <= max(WIDTH * low, floor):
            return Bracket(low, inside, high, outside)
        elif low < high / growth:
            value = max(high / next(ratios, growth), float(np.sqrt(low * high)))
        else:
            value = 0.5 * (low + high)


def least(probe: Probe, start: Answer, *, value: float, floor: float) -> Bracket:
    """Find the least stable value of a family, starting from a stable one.

    Args:
        probe: the family.
        start: the stable answer at `value`.
        value: value to begin at.
        floor: value at and below which 0 is tried instead.

    Returns:
        A bracket whose `outside` is below `inside`; `inside` is 0 where the family is stable at 0.
    """
    high, inside = value, start
    low, outside = 0.0, None
    try:
        while outside is None:
            trial = high / 2 if high / 2 > floor else 0.0
            answer = probe(trial, inside)
            if not answer.stands:
                low, outside = trial, answer
            elif trial == 0.0:
                return Bracket(0.0, answer, None, None)
            else:
                high, inside = trial, answer
        while high - low > max(SHARE * high, floor * SHARE):
            trial = 0.5 * (low + high)
            answer = probe(trial, inside)
            if answer.stands:
                high, inside = trial, answer
            else:
                low, outside = trial, answer
    except OutOfTime:
        return Bracket(high, inside, None if outside is None else low, outside, finished=False)
    return Bracket(high, inside, low, outside)


def checked(
    bracket: Bracket,
    probe: Callable[[float, Answer | None], Answer],
    start: Answer,
    again: Callable[[float, Answer], Bracket],
    origin: float = 0.0,
) -> Bracket:
    """Probe a family well inside its bound; where it fails there, return the bound before that.

    Args:
        bracket: the bound.
        probe: the family; solves from rest where no nearby answer is given.
        start: the answer at `origin`.
        again: finds the bound between `origin` and a failing value, given with its answer.
        origin: value of the unmodified state.
    """
    for share in _CHECKED:
        value = origin + share * (bracket.inside - origin)
        # Iterations that find no rest position from one start do not show that there is none.
        answer = probe(value, None)
        for near in (start, bracket.stands):
            answer = answer if answer.stands else probe(value, near)
        if not answer.stands:
            found = again(value, answer)
            return Bracket(found.inside, found.stands, found.outside, found.fails, monotone=False)
    return bracket


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
                value = cap if best[1].outside is None else (1.0 - SLACK) * best[1].inside
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
