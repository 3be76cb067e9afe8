"""Brackets of the families of conditions of a state: decreasing friction and increasing loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.margins.brackets import FLOOR, Bracket, Probe, checked, largest, weakest
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
            stands,
            guess=1.0 / guess,
            cap=1.0 / floor,
            low=1.0 / low,
            growth=2.0,
            near="friction" in near or low < own,
            known=None if known is None else (1.0 / known[0], known[1]),
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


class LoadFamily:
    """Family of the multiples of a load on a state, under `contact`."""

    def __init__(self, prober: Prober, state: States, start: Answer, load: Array, *, guess: float, cap: float) -> None:
        """Take the load.

        Args:
            prober: solver of the structure.
            state: shape (parts,).
            start: the stable answer for the unmodified state.
            load: N and Nm, shape (parts, 6).
            guess: multiple to try first.
            cap: multiple beyond which there is no bound.
        """
        self._prober, self._state, self._start, self._load = prober, state, start, load
        self._guess, self._cap = guess, cap

    def _under(self, value: float) -> Condition:
        return Condition(self._start.condition.friction, value * self._load)

    def probe(self, value: float, nearby: Answer | None) -> Answer:
        """Return the answer at a multiple, only from a nearby answer where one is given."""
        return self._prober.ask(self._state, self._under(value), nearby, coarse=True)

    def coarse(
        self, known: tuple[float, Answer] | None = None, *, low: float = 0.0, stands: Answer | None = None
    ) -> Bracket:
        """Return the bracket by quick probes, from a stable multiple up or from a failing one down."""
        first, floor = low or self._guess, FLOOR * self._guess
        start = stands or self._start
        return largest(self.probe, start, guess=first, cap=self._cap, low=low, floor=floor, near=low > 0.0, known=known)

    def settle(self, value: float, failed: Answer) -> tuple[float, Answer]:
        """Return the answer from rest at a multiple at which a quick probe failed.

        Where parts neither come to rest nor are seen to move away, a stable multiple beyond is looked for, from the
        unloaded state.
        """
        answer = self._prober.ask(self._state, self._under(value))
        answer = replace(answer, moves_away=not answer.stands and (answer.moves_away or failed.moves_away))
        return value, answer

    def settled(self, found: Bracket) -> Bracket:
        """Return a bracket whose outer end has no rest position from an unloaded start either."""
        while found.outside is not None and found.fails is not None and found.fails.coarse:
            value, answer = self.settle(found.outside, found.fails)
            if not answer.stands:
                return replace(found, fails=answer)
            found = self.coarse(low=value, stands=answer)
        return found

    def checked(self, found: Bracket) -> Bracket:
        """Return the bracket, or that of an earlier bound where a multiple well inside it fails."""
        if found.fails is None:
            return found
        return checked(found, self.probe, self._start, lambda value, answer: self.coarse((value, answer)))


def load_bracket(
    prober: Prober,
    state: States,
    start: Answer,
    load: Array,
    *,
    guess: float,
    cap: float,
    known: tuple[float, Answer] | None = None,
) -> Bracket:
    """Return the bracket of the largest multiple of a load; arguments as for `LoadFamily`.

    `known` is a failing multiple and its answer.
    """
    if prober.contact:
        family = LoadFamily(prober, state, start, load, guess=guess, cap=cap)
        found = family.coarse(known)
        try:
            return family.checked(family.settled(found))
        except OutOfTime:
            return replace(found, finished=False)
    friction = start.condition.friction
    found = largest(
        lambda value, nearby: prober.ask(state, Condition(friction, value * load), nearby),
        start,
        guess=guess,
        cap=cap,
        floor=FLOOR * guess,
        cut=lambda answer: prober.cut(state, answer, load),
        known=known,
    )
    if found.fails is None or found.outside is None:
        return found
    # A velocity may prove failure below the value at which it was found.
    return replace(found, fails=replace(found.fails, condition=Condition(friction, found.outside * load)))


def weakest_load(
    prober: Prober,
    state: States,
    start: Answer,
    loads: Array,
    order: Sequence[int],
    *,
    guess: Callable[[int], float],
    cap: float,
    near: Near,
    numbers: Sequence[int] | None = None,
    around: bool = False,
    sample: int | None = None,
) -> tuple[int, Bracket] | None:
    """Return the load with the least largest multiple, and its bracket; None without loads.

    Where no load has a bound, the bracket is that of the first one, up to `cap`.

    Args:
        prober: solver of the structure.
        state: shape (parts,).
        start: the stable answer for the unmodified state.
        loads: N and Nm, shape (loads, parts, 6).
        order: order in which to try them.
        guess: guess at the bound of a load.
        cap: multiple beyond which there is no bound.
        near: weakest load of a nearby state, and its bound; replaced by that of this one.
        numbers: identifier of each load, the same in all states; its index by default.
        around, sample: as for `Weakest`.
    """
    names = range(len(loads)) if numbers is None else numbers
    weak, value = near.get("load", (-1, 0.0))
    order = sorted(order, key=lambda row: names[row] != weak)
    if prober.contact:
        families = {row: LoadFamily(prober, state, start, loads[row], guess=guess(row), cap=cap) for row in order}
        friction = start.condition.friction

        def probe(rows: Sequence[int], multiple: float, nearby: Sequence[Answer | int]) -> list[Answer]:
            conditions = [Condition(friction, multiple * loads[row]) for row in rows]
            return prober.ask_each(state, conditions, nearby)

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
        )
        known = value if order and names[order[0]] == weak else None
        found = race.search(lambda row, multiple, failed: families[row].settle(multiple, failed), near=known)
        try:
            found = found and (found[0], families[found[0]].checked(found[1]))
        except OutOfTime:
            found = found and (found[0], replace(found[1], finished=False))
    else:
        found = weakest(
            order,
            lambda row, multiple: prober.ask(state, Condition(start.condition.friction, multiple * loads[row]), start),
            lambda row, known: load_bracket(prober, state, start, loads[row], guess=guess(row), cap=cap, known=known),
            cap,
            start,
        )
    if found is not None and found[1].outside is not None and found[1].finished:
        near["load"] = names[found[0]], found[1].inside
    return found


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
