"""Brackets of the families of conditions of a state: decreasing friction and increasing loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.margins.brackets import FLOOR, Bracket, Interval, checked, largest
from falsework.stability.margins.conditions import Answer, Condition, OutOfTime
from falsework.stability.margins.prober import Prober
from falsework.stability.margins.weakest import Weakest
from falsework.stability.strength import SMOOTH

Array = NDArray[np.float64]
Near = dict[str, tuple[int, float]]
"""Bounds of a nearby state: the number of the weakest load, and its bound."""


def friction_bracket(prober: Prober, state: States, start: Answer, near: Near) -> Bracket | None:
    """Return the bracket of the least friction; None where joints have friction but the structure has none.

    Args:
        prober: solver of the structure.
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
        found = weakest_load(
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
        )
        assert found is not None  # there is one family
        bracket = found[1]
        outside = None if bracket.outside is None else 1.0 / bracket.outside
        bracket = replace(bracket, inside=1.0 / bracket.inside, outside=outside)
    if own == 0.0 or bracket.outside is not None or not bracket.finished:
        return bracket
    smooth = prober.ask(state, Condition(0.0, extra))
    return Bracket(0.0, smooth, None, None) if smooth.stands else replace(bracket, outside=0.0, fails=smooth)


def weakest_load(
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
    around: bool = False,
    sample: int | None = None,
) -> tuple[int, Bracket] | None:
    """Return the family of loads with the least bound, and its bracket; None without families.

    Where none has a bound, the bracket is that of the first one, up to `cap`.

    Args:
        prober: solver of the structure.
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
        around, sample: as for `Weakest`.
    """
    names, near = range(max(order, default=-1) + 1) if numbers is None else numbers, {} if near is None else near
    weak, value = near.get(name, (-1, 0.0))
    order = sorted(order, key=lambda row: names[row] != weak)

    def probe(rows: Sequence[int], value: float, nearby: Sequence[Answer | int]) -> list[Answer]:
        return prober.ask_each(state, [under(row, value) for row in rows], nearby)

    def confirm(row: int, value: float, failed: Answer) -> tuple[float, Answer]:
        """Return the answer from rest, where a quick probe failed."""
        if not failed.coarse:
            # A velocity may prove failure below the value at which it was found.
            return value, replace(failed, condition=under(row, value))
        answer = prober.ask(state, under(row, value))
        return value, replace(answer, moves_away=not answer.stands and (answer.moves_away or failed.moves_away))

    race = Weakest(
        order,
        probe,
        start,
        guess=guess,
        cap=cap,
        low=low,
        floor=lambda row: FLOOR * guess(row),
        around=around,
        sample=sample,
        hurry=prober.limited,
        cut=None if loads is None or prober.contact else lambda row, failed: prober.cut(state, failed, loads[row]),
        near=value if order and names[order[0]] == weak else None,
    )
    found = race.search(confirm)
    if found is None:
        return None
    row, bracket = found
    if prober.contact and bracket.finished and bracket.fails is not None:

        def ask(value: float, nearby: Answer | None) -> Answer:
            return prober.ask(state, under(row, value), nearby, coarse=True)

        def again(value: float, failed: Answer) -> Bracket:
            first, known = guess(row), (value, failed)
            return largest(ask, Interval(start, guess=first, cap=cap, low=low, floor=FLOOR * first, known=known))

        try:
            if name == "friction":  # a check of the number starts from rest, and near the bound the start matters
                loaded = prober.ask(state, under(row, bracket.inside))
                bracket = replace(bracket, stands=loaded) if loaded.stands else again(bracket.inside, loaded)
            bracket = checked(bracket, ask, start, again, origin=low)
        except OutOfTime:
            bracket = replace(bracket, finished=False)
    if bracket.outside is not None and bracket.finished:
        near[name] = names[row], bracket.inside
    return row, bracket
