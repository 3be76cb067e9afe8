"""Replays of a plan under varied settings, to which the result for a robust plan is insensitive."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.contact.newton import FIRST_STEP
from falsework.stability.contact.replay import History, Presses, Replay, ReplaySettings
from falsework.stability.holds import inexact_presses
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.utils.cores import core_count

DRAWS = 20
"""Number of variations with random initial friction."""


class AnyReplayer(Protocol):
    """Interface of a replayer of routes for a search."""

    @property
    def problem(self) -> Problem:
        """Contact problem of the structure."""
        ...

    @property
    def settings(self) -> StabilitySettings:
        """Settings of the verdicts."""
        ...

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay consecutive states in assembly order."""
        ...

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Take one step, as a replay of both states."""
        ...


class VariableReplayer(AnyReplayer, Protocol):
    """Interface of a `Replayer`, or of one that checks a deadline between steps."""

    @property
    def assembly(self) -> Assembly:
        """The structure."""
        ...

    def vary(self, settings: StabilitySettings, replay: ReplaySettings) -> Self:
        """Return a replayer of the same structure under other settings."""
        ...

    def first_tipping(self, states: States, histories: Sequence[History]) -> int | None:
        """Return the first state that a small motion leaves, though it is at rest; None if there is none."""
        ...

    def loads(self, states: States, histories: Sequence[History]) -> Loads:
        """Return what robots bear in states in assembly order."""
        ...


@dataclass(frozen=True)
class Variation:
    """Replay under other settings, and the number of its stable steps."""

    name: str
    good: bool
    falls_at: int | None


@dataclass(frozen=True)
class Change:
    """Change of the settings of a replay, to which the result for a plan must be insensitive."""

    name: str
    ratio: float | None = None
    """Ratio of tangential to normal stiffness; that of the settings if not given."""
    hold_factor: float = 1.0
    """Factor of the stiffness of holds, where they are not locked."""
    replay: tuple[tuple[str, float], ...] = ()
    """Fields of `ReplaySettings` with other values."""
    press: int | None = None
    """Error of all presses, an index of `inexact_presses`."""


def _draw(number: int) -> Change:
    noise = (("friction_noise", 1.0), ("seed", number - 1))
    return Change(f"friction at the start, draw {number}", replay=noise)


_SMALL_RATIO = Change("stiffness ratio 0.4", ratio=0.4)
_LARGE_RATIO = Change("stiffness ratio 1", ratio=1.0)
_AT_ONCE = Change("release in 1 increment", replay=(("increments", 1),))
_SLOWLY = Change("release in 16 increments", replay=(("increments", 16),))
_THICK = Change("thicker medium", replay=(("first_step", FIRST_STEP / 30),))
_THIN = Change("thinner medium", replay=(("first_step", FIRST_STEP * 30),))
_SOFT = Change("holds 3 times softer", hold_factor=1 / 3)
_STIFF = Change("holds 3 times stiffer", hold_factor=3.0)
_PRESSES = tuple(
    Change(name, press=k)
    for k, name in enumerate(
        ["presses 10% weaker", "presses 10% stronger"]
        + [f"presses {angle} degrees off about {axis}" for axis in "xyz" for angle in (-5, 5)]
    )
)
GROUPS: tuple[tuple[Change, ...], ...] = (
    (_SMALL_RATIO, _THICK, _SOFT, _draw(1), _PRESSES[0]),
    (_LARGE_RATIO, _THIN, _STIFF, _draw(2), _PRESSES[1]),
    (_AT_ONCE, _draw(3), _PRESSES[2]),
)
"""Changes that are tried together first, one replay a group. Releases in many increments, which take as long as all
groups, and further draws and directions are left to `variations`."""


def changed(
    changes: Sequence[Change], settings: StabilitySettings, presses: Presses
) -> tuple[StabilitySettings, ReplaySettings, Presses]:
    """Return settings and presses with some changes."""
    replay = ReplaySettings(**{name: value for change in changes for name, value in change.replay})  # type: ignore[arg-type]
    for change in changes:
        holds = replace(settings.holds, stiffness=change.hold_factor * settings.holds.stiffness)
        settings = replace(settings, holds=holds, stiffness_ratio=change.ratio or settings.stiffness_ratio)
        if change.press is not None:
            presses = [inexact_presses(some)[change.press] if some else () for some in presses]
    return settings, replay, presses


def variations(settings: StabilitySettings, draws: int, presses: Presses = ()) -> list[Change]:
    """Return changes to which the result of a replay must be insensitive.

    Args:
        settings: settings of the verdicts.
        draws: number of random initial friction states.
        presses: of the plan; without any, none of them errs.
    """
    found = [_SMALL_RATIO, _LARGE_RATIO, _AT_ONCE, _SLOWLY, _THICK, _THIN]
    found += [_SOFT, _STIFF] if np.isfinite(settings.holds.stiffness) else []
    return [*found, *map(_draw, range(1, draws + 1)), *(_PRESSES if any(presses) else ())]


class GroupedVariations:
    """Test of a plan under changed settings, several of them at a time.

    A plan that comes to rest under all changes of a group together counts as one that does under each of them; where it
    does not, they are tried one by one. So most plans cost one replay a group.
    """

    def __init__(self, replayer: VariableReplayer) -> None:
        """Prepare the test of plans with the settings of a replayer."""
        self._replayer, self._groups = replayer, list(GROUPS)

    def failure(self, states: States, presses: Presses) -> tuple[str, int] | None:
        """Return the change under which a plan does not come to rest, and the first such state; None if there is none.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            presses: of the steps that lead to each state, one entry a state.
        """
        some = variations(self._replayer.settings, DRAWS, presses)
        for place, group in enumerate(self._groups):
            changes = [change for change in group if change in some]
            if self._falls_at(changes, states, presses) is None:
                continue
            for change in changes if len(changes) > 1 else ():
                falls_at = self._falls_at([change], states, presses)
                if falls_at is not None:
                    self._groups.insert(0, self._groups.pop(place))  # others mostly fail under the same
                    return change.name, falls_at
        return None

    def _falls_at(self, changes: Sequence[Change], states: States, presses: Presses) -> int | None:
        settings, replay, pressed = changed(changes, self._replayer.settings, presses)
        return self._replayer.vary(settings, replay).replay(states, presses=pressed).falls_at


def replay_varied(
    replayer: VariableReplayer, states: States, presses: Presses | None = None, *, draws: int = DRAWS
) -> list[Variation]:
    """Replay a plan under other settings: a plan that collapses under one of them is marginal.

    Args:
        replayer: replayer with the settings of the plan.
        states: in assembly order, shape (states, parts).
        presses: of the steps that lead to each state; none if not given.
        draws: number of random initial friction states.
    """
    given: Presses = [()] * len(states) if presses is None else presses

    def run(change: Change) -> Variation:
        settings, replay, pressed = changed([change], replayer.settings, given)
        result = replayer.vary(settings, replay).replay(states, presses=pressed)
        return Variation(change.name, result.good, result.falls_at)

    with ThreadPoolExecutor(core_count()) as pool:
        return list(pool.map(run, variations(replayer.settings, draws, given)))


class RobustReplayer:
    """Replayer under which a plan succeeds only if it does so under every variation.

    Variations under which plans failed come first, and the first failure ends a replay: while a search excludes one
    state after another, most plans cost one additional replay.
    """

    def __init__(self, replayer: VariableReplayer) -> None:
        self._replayer, self._first = replayer, list[Change]()

    @property
    def problem(self) -> Problem:
        """Contact problem of the structure."""
        return self._replayer.problem

    @property
    def settings(self) -> StabilitySettings:
        """Settings of the verdicts."""
        return self._replayer.settings

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay under the settings, and a complete plan under every variation too.

        Args:
            states: in assembly order, shape (states, parts).
            history: history of the first state; with it nothing is varied, since it belongs to one setting.
            presses: of the steps that lead to each state; chosen where needed if not given.

        Returns:
            The plain replay if it and all variations succeed, else one that fails.
        """
        plain = self._replayer.replay(states, history, presses)
        if history is not None or not plain.good:
            return plain
        changes = variations(self._replayer.settings, DRAWS, plain.presses)
        changes.sort(key=lambda change: self._first.index(change) if change in self._first else len(self._first))
        workers = core_count()

        def run(change: Change) -> Replay:
            settings, varied, pressed = changed([change], self._replayer.settings, plain.presses)
            return self._replayer.vary(settings, varied).replay(states, presses=pressed)

        with ThreadPoolExecutor(workers) as pool:
            for first in range(0, len(changes), workers):
                some = changes[first : first + workers]
                for change, varied in zip(some, pool.map(run, some), strict=True):
                    if not varied.good:
                        self._first = [change, *(other for other in self._first if other != change)]
                        return varied
        return plain

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Take one step under the settings; see `Replayer.step`."""
        return self._replayer.step(history, before, after)


__all__ = ["DRAWS", "GroupedVariations", "RobustReplayer", "Variation", "replay_varied", "variations"]
