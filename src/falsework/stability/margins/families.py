"""Brackets of the families of conditions of a state: decreasing friction and increasing loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.margins.brackets import FLOOR, Bracket, Interval, Probe, checked, largest
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

    def ask(value: float, nearby: Answer | None) -> Answer:
        return prober.ask(state, Condition(value, extra), nearby, coarse=True)

    def from_rest(value: float, _: Answer | None) -> Answer:
        return ask(value, None)

    def find(
        known: tuple[float, Answer] | None, low: float = own, stands: Answer = start, probe: Probe = from_rest
    ) -> Bracket:
        _, guess = near.get("friction", (0, 0.5 * own)) if low == own else (0, low)
        found = largest(
            lambda inverse, nearby: probe(1.0 / inverse, nearby),
            Interval(
                stands,
                guess=1.0 / guess,
                cap=1.0 / floor,
                low=1.0 / low,
                growth=2.0,
                near="friction" in near or low < own,
                known=None if known is None else (1.0 / known[0], known[1]),
            ),
        )
        if not found.finished:
            outside = None if found.outside is None else 1.0 / found.outside
            return Bracket(1.0 / found.inside, found.stands, outside, found.fails, finished=False)
        if found.outside is not None:
            return Bracket(1.0 / found.inside, found.stands, 1.0 / found.outside, found.fails)
        smooth = from_rest(0.0, None)
        if smooth.stands:
            return Bracket(0.0, smooth, None, None)
        return Bracket(1.0 / found.inside, found.stands, 0.0, smooth)

    if not prober.assembly.has_common_friction:
        return None
    if own == 0.0:
        return Bracket(0.0, start, None, None)
    if own <= floor:
        smooth = from_rest(0.0, None)
        return Bracket(0.0, smooth, None, None) if smooth.stands else Bracket(own, start, 0.0, smooth)
    found = find(None, probe=ask)
    if prober.contact:
        try:
            found = _from_rest_too(found, from_rest, lambda low, stands: find(None, low, stands))
            # A check of the number starts from rest, and near the bound the start matters.
            loaded = from_rest(found.inside, None)
            found = replace(found, stands=loaded) if loaded.stands else find((found.inside, loaded))
            found = checked(found, ask, start, lambda value, answer: find((value, answer)), origin=own)
        except OutOfTime:
            found = replace(found, finished=False)
    if found.inside > floor and found.finished:
        near["friction"] = 0, found.inside
    return found


def weakest_load(
    prober: Prober,
    state: States,
    start: Answer,
    under: Callable[[int, float], Condition],
    order: Sequence[int],
    *,
    guess: Callable[[int], float],
    cap: float,
    near: Near | None = None,
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
        near: weakest family of a nearby state, and its bound; replaced by that of this one.
        numbers: identifier of each family, the same in all states; its index by default.
        loads: where values are multiples of loads, these, N and Nm, shape (families, parts, 6).
        around, sample: as for `Weakest`.
    """
    names, near = range(max(order, default=-1) + 1) if numbers is None else numbers, {} if near is None else near
    weak, value = near.get("load", (-1, 0.0))
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
            return largest(ask, Interval(start, guess=first, cap=cap, floor=FLOOR * first, known=known))

        try:
            bracket = checked(bracket, ask, start, again)
        except OutOfTime:
            bracket = replace(bracket, finished=False)
    if bracket.outside is not None and bracket.finished:
        near["load"] = names[row], bracket.inside
    return row, bracket


def _from_rest_too(
    found: Bracket, full: Callable[[float, Answer], Answer], find: Callable[[float, Answer], Bracket]
) -> Bracket:
    """Return a bracket whose outer end has no rest position from an unloaded start either.

    Args:
        found: the bracket found by quick probes.
        full: answer at a value, from a nearby answer and from rest.
        find: the bracket beyond a value that proves stable.
    """
    while found.outside is not None and found.fails is not None and found.fails.coarse:
        answer = full(found.outside, found.stands)
        if not answer.stands:
            return replace(found, fails=replace(answer, moves_away=answer.moves_away or found.fails.moves_away))
        found = find(found.outside, answer)
    return found
