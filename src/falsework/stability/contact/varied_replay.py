"""Replays under changed settings, to which the result for a robust plan is insensitive.

Stiffness, damping, release, the friction in new contacts and the forces of robots are never known exactly. A plan that
a search finds under one setting and that is tried under others afterwards often fails late, where the search has to go
back far. An ensemble tries each step under several settings when the search takes it. So each plan stands under all of
them, and presses are chosen so that it does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.history import History, Presses, Replay, ReplaySettings
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.contact.newton import OPEN
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import inexact_presses
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.utils.cores import core_count

DRAWS = 20
"""Number of variations with random initial friction."""


class AnyReplayer(Protocol):
    """Interface of a `Replayer`, or of one that checks a deadline between steps."""

    @property
    def problem(self) -> Problem:
        """Contact problem of the structure."""

    @property
    def settings(self) -> StabilitySettings:
        """Settings of the verdicts."""

    @property
    def varies(self) -> bool:
        """Whether every step must come to rest under changed settings too."""

    @property
    def iterations(self) -> int:
        """Newton iterations so far."""

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay consecutive states in assembly order."""

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Take one step, as a replay of both states."""

    @property
    def assembly(self) -> Assembly:
        """The structure."""

    def vary(self, settings: StabilitySettings, replay: ReplaySettings) -> Self:
        """Return a replayer of the same structure under other settings."""

    def first_tipping(self, states: States, histories: Sequence[History], known: int = 0) -> int | None:
        """Return the first state that a small motion leaves, though it is at rest; None if there is none."""

    def slip(self, before: History, after: History) -> float:
        """Return the largest movement of a part between two histories, as a share of the movement limit."""

    def loads(self, states: States, histories: Sequence[History]) -> Loads:
        """Return what robots bear in states in assembly order."""


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
_THICK = Change("thicker medium", replay=(("first_step", ReplaySettings.first_step / 30),))
_THIN = Change("thinner medium", replay=(("first_step", ReplaySettings.first_step * 30),))
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
    (_LARGE_RATIO, _THIN, _STIFF, _draw(2), _PRESSES[1], _AT_ONCE),
)
"""Changes under which an `EnsembleReplayer` replays, all of a group together."""


def changed(
    changes: Sequence[Change], settings: StabilitySettings, presses: Presses
) -> tuple[StabilitySettings, ReplaySettings, Presses]:
    """Return settings and presses with some changes."""
    replay = ReplaySettings(**{name: value for change in changes for name, value in change.replay})  # type: ignore[arg-type]
    for change in changes:
        holds = replace(settings.holds, stiffness=change.hold_factor * settings.holds.stiffness)
        settings = replace(settings, holds=holds, stiffness_ratio=change.ratio or settings.stiffness_ratio)
    return settings, replay, _inexact(changes, presses)


def _inexact(changes: Sequence[Change], presses: Presses) -> Presses:
    """Return presses with the errors of some changes."""
    for error in (change.press for change in changes if change.press is not None):
        presses = [inexact_presses(some)[error] if some else () for some in presses]
    return presses


def _replays(
    replayer: AnyReplayer, changes: Sequence[Change], states: States, presses: Presses
) -> Iterator[tuple[Change, Replay]]:
    """Yield each change with the replay of a plan under it; as many replays as there are cores go on ahead."""

    def run(change: Change) -> Replay:
        settings, varied, pressed = changed([change], replayer.settings, presses)
        return replayer.vary(settings, varied).replay(states, presses=pressed)

    workers = core_count()
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, len(changes), workers):
            some = changes[first : first + workers]
            yield from zip(some, pool.map(run, some), strict=True)


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


class EnsembleReplayer(Replayer):
    """Replayer of one structure under its settings and, at the same time, under groups of changes of them.

    A history that has none under the changed settings is continued under the own settings alone.
    """

    varies = True

    @cached_property
    def _members(self) -> list[tuple[Replayer, Sequence[Change]]]:
        """Replayer under each group of changes, and the group."""
        known = variations(self.settings, draws=len(GROUPS))
        groups = [[change for change in group if change in known or change.press is not None] for group in GROUPS]
        return [(self.vary(*changed(group, self.settings, ())[:2]), group) for group in groups]

    @property
    def iterations(self) -> int:
        """As of `Replayer`, under all settings."""
        return self._iterations + sum(member.iterations for member, _ in self._members)

    def _replay_all(self, batch: States, history: History | None, presses: Presses) -> Replay:
        found = self._replay(batch, history, presses)
        if history is not None and not history.changed:
            return found
        others, reached = list[Sequence[History]](), len(found.histories)
        for number, (member, group) in enumerate(self._members if reached else ()):
            past = None if history is None else history.changed[number]
            # Where robots give way, how far depends on the stiffness that the group changes.
            guess = member._guess(found.histories[:reached]) if np.isinf(self.settings.holds.stiffness) else None
            other = member._replay(batch[:reached], past, _inexact(group, presses[:reached]), guess)
            others.append([replace(history, track=None) for history in other.histories])
            if len(other.histories) < reached:
                reached = len(other.histories)
                found = _cut(found, other, reached)
        whole = [
            replace(own, changed=tuple(some[row] for some in others))
            for row, own in enumerate(found.histories[:reached])
        ]
        return replace(found, histories=tuple(whole), presses=found.presses[:reached])


def _cut(found: Replay, other: Replay, row: int) -> Replay:
    """Return a replay that ends in a state which does not come to rest in another."""
    stands, part = found.stands.copy(), found.part.copy()
    stands[row], part[row] = other.stands[row], other.part[row]
    stands[row + 1 :] = OPEN
    return replace(found, stands=stands, part=part)


def replay_varied(
    replayer: AnyReplayer, states: States, presses: Presses | None = None, *, draws: int = DRAWS
) -> list[Variation]:
    """Replay a plan under other settings: a plan that collapses under one of them is marginal.

    Args:
        replayer: replayer with the settings of the plan.
        states: in assembly order, shape (states, parts).
        presses: of the steps that lead to each state; none if not given.
        draws: number of random initial friction states.
    """
    given: Presses = [()] * len(states) if presses is None else presses
    found = _replays(replayer, variations(replayer.settings, draws, given), states, given)
    return [Variation(change.name, replay.good, replay.falls_at) for change, replay in found]


class AllVariations:
    """Test of plans under every change of settings, one by one, and under many draws of initial friction.

    Changes under which plans failed come first, and the first failure ends the test: while a search excludes one state
    after another, most plans cost one replay.
    """

    def __init__(self, replayer: AnyReplayer) -> None:
        """Prepare the test of plans with the settings of a replayer."""
        self._replayer, self._first = replayer, list[Change]()

    def falls_at(self, states: States, presses: Presses) -> int | None:
        """Return the first state in which a plan does not come to rest under some change; None if there is none.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            presses: of the steps that lead to each state, one entry a state.
        """
        changes = variations(self._replayer.settings, DRAWS, presses)
        changes.sort(key=lambda change: self._first.index(change) if change in self._first else len(self._first))
        for change, replay in _replays(self._replayer, changes, states, presses):
            if replay.falls_at is not None:
                self._first = [change, *(other for other in self._first if other != change)]
                return replay.falls_at
        return None
