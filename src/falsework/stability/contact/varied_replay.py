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


def variations(settings: StabilitySettings, draws: int) -> list[tuple[str, StabilitySettings, ReplaySettings]]:
    """Return named settings of replays to which the result must be insensitive.

    Args:
        settings: settings of the verdicts.
        draws: number of random initial friction states.
    """
    plain = ReplaySettings()
    varied = [
        ("stiffness ratio 0.4", replace(settings, stiffness_ratio=0.4), plain),
        ("stiffness ratio 1", replace(settings, stiffness_ratio=1.0), plain),
        ("release in 1 increment", settings, replace(plain, increments=1)),
        ("release in 16 increments", settings, replace(plain, increments=16)),
        ("thicker medium", settings, replace(plain, first_step=FIRST_STEP / 30)),
        ("thinner medium", settings, replace(plain, first_step=FIRST_STEP * 30)),
    ]
    stiffness = settings.holds.stiffness
    if np.isfinite(stiffness):
        varied += [
            (f"holds {word}", replace(settings, holds=replace(settings.holds, stiffness=factor * stiffness)), plain)
            for word, factor in (("3 times softer", 1 / 3), ("3 times stiffer", 3.0))
        ]
    varied += [
        (f"friction at the start, draw {seed + 1}", settings, replace(plain, friction_noise=1.0, seed=seed))
        for seed in range(draws)
    ]
    return varied


def combined_variations(settings: StabilitySettings) -> list[tuple[str, StabilitySettings, ReplaySettings]]:
    """Return a few settings of replays in which those of `variations` are changed together.

    Each of them costs one replay, so that the last test of every plan can afford them. A plan that comes to rest under
    a combination is mostly one that does so under each of its changes. Releases in many increments, which take as long
    as all others together, are left to `variations`.
    """
    noisy, holds = ReplaySettings(friction_noise=1.0), settings.holds
    softer, stiffer = (replace(holds, stiffness=factor * holds.stiffness) for factor in (1 / 3, 3.0))
    return [
        (
            "stiffness ratio 0.4, thicker medium, friction at the start",
            replace(settings, stiffness_ratio=0.4, holds=softer),
            replace(noisy, first_step=FIRST_STEP / 30),
        ),
        (
            "stiffness ratio 1, thinner medium, friction at the start",
            replace(settings, stiffness_ratio=1.0, holds=stiffer),
            replace(noisy, first_step=FIRST_STEP * 30, seed=1),
        ),
        ("release in 1 increment, friction at the start", settings, replace(noisy, increments=1, seed=2)),
    ]


def varied_presses(presses: Presses) -> list[tuple[str, Presses]]:
    """Return named presses that robots may carry out instead of the given ones; none where there are none."""
    if not any(presses):
        return []
    names = ["presses 10% weaker", "presses 10% stronger"]
    names += [f"presses {angle} degrees off about {axis}" for axis in "xyz" for angle in (-5, 5)]
    varied = [inexact_presses(some) if some else [()] * len(names) for some in presses]
    return [(name, [some[k] for some in varied]) for k, name in enumerate(names)]


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
    plain = ReplaySettings()
    cases = [(name, *case, given) for name, *case in variations(replayer.settings, draws)]
    cases += [(name, replayer.settings, plain, other) for name, other in varied_presses(given)]

    def run(case: tuple[str, StabilitySettings, ReplaySettings, Presses]) -> Variation:
        name, settings, replay, pressed = case
        result = replayer.vary(settings, replay).replay(states, presses=pressed)
        return Variation(name, result.good, result.falls_at)

    with ThreadPoolExecutor(core_count()) as pool:
        return list(pool.map(run, cases))


class RobustReplayer:
    """Replayer under which a plan succeeds only if it does so under every variation.

    Variations under which plans failed come first, and the first failure ends a replay: while a search excludes one
    state after another, most plans cost one additional replay.
    """

    def __init__(self, replayer: VariableReplayer) -> None:
        self._replayer = replayer
        self._cases = [replayer.vary(settings, replay) for _, settings, replay in variations(replayer.settings, DRAWS)]

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
        cases = [(case, plain.presses) for case in self._cases]
        cases += [(self._replayer, pressed) for _, pressed in varied_presses(plain.presses)]
        workers = core_count()
        with ThreadPoolExecutor(workers) as pool:
            for first in range(0, len(cases), workers):
                some = cases[first : first + workers]
                replays = pool.map(lambda case: case[0].replay(states, presses=case[1]), some)
                for (replayer, _), varied in zip(some, replays, strict=True):
                    if not varied.good:
                        if replayer in self._cases:
                            self._cases.remove(replayer)
                            self._cases.insert(0, replayer)
                        return varied
        return plain

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Take one step under the settings; see `Replayer.step`."""
        return self._replayer.step(history, before, after)


__all__ = ["DRAWS", "RobustReplayer", "Variation", "replay_varied", "variations"]
