"""Replays of a plan under varied settings, on which the result for a robust plan does not depend."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Protocol, Self

from numpy.typing import ArrayLike

from falsework.assembly.state import States
from falsework.stability.contact.newton import FIRST_STEP
from falsework.stability.contact.replay import History, Replay, ReplaySettings
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings

DRAWS = 20
"""Random states of friction at the start among the variations."""


class AnyReplayer(Protocol):
    """Interface of what replays routes for a search."""

    @property
    def problem(self) -> Problem:
        """Contact problem of the structure."""
        ...

    def replay(self, states: ArrayLike, history: History | None = None) -> Replay:
        """Replay consecutive states in the order of assembly."""
        ...

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Take one step in a single increment."""
        ...


class VariableReplayer(AnyReplayer, Protocol):
    """Interface of a `Replayer`, or of one that checks a deadline between steps."""

    @property
    def settings(self) -> StabilitySettings:
        """Settings of the verdicts."""
        ...

    def vary(self, settings: StabilitySettings, replay: ReplaySettings) -> Self:
        """Return a replayer of the same structure under other settings."""
        ...


@dataclass(frozen=True)
class Variation:
    """Replay under other settings, and the number of its stable steps."""

    name: str
    good: bool
    falls_at: int | None


def variations(settings: StabilitySettings, draws: int) -> list[tuple[str, StabilitySettings, ReplaySettings]]:
    """Return settings of replay on which the answer must not hang, with names.

    Args:
        settings: of the verdicts.
        draws: how many random states of friction.
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
    varied += [
        (f"friction at the start, draw {seed + 1}", settings, replace(plain, friction_noise=1.0, seed=seed))
        for seed in range(draws)
    ]
    return varied


def replay_varied(
    replayer: VariableReplayer, states: States, *, draws: int = DRAWS, threads: int | None = None
) -> list[Variation]:
    """Replay a plan under other settings: a plan that falls in one of them is marginal.

    Args:
        replayer: with the settings of the plan.
        states: in the order of assembly, shape (states, parts).
        draws: how many random states of friction.
        threads: all cores by default.
    """

    def run(case: tuple[str, StabilitySettings, ReplaySettings]) -> Variation:
        name, settings, replay = case
        result = replayer.vary(settings, replay).replay(states)
        return Variation(name, result.good, result.falls_at)

    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return list(pool.map(run, variations(replayer.settings, draws)))


class RobustReplayer:
    """Replayer in which a plan succeeds only if it does so under every variation.

    Variations under which plans failed come first, and the first failure ends a replay: while a search rules out one
    state after the other, most plans cost one replay more.
    """

    def __init__(self, replayer: VariableReplayer, draws: int = DRAWS) -> None:
        """Vary the settings of `replayer`, with `draws` random states of friction at the start."""
        self._replayer = replayer
        self._cases = [replayer.vary(settings, replay) for _, settings, replay in variations(replayer.settings, draws)]

    @property
    def problem(self) -> Problem:
        """See `Replayer`."""
        return self._replayer.problem

    def replay(self, states: ArrayLike, history: History | None = None) -> Replay:
        """Replay under the settings, and a whole plan under every variation too.

        Args:
            states: in the order of assembly, shape (states, parts).
            history: of the first state; with it nothing is varied, since it belongs to one setting.

        Returns:
            The plain replay if it and all variations succeed, else one that fails.
        """
        plain = self._replayer.replay(states, history)
        if history is not None or not plain.good:
            return plain
        workers, cases = os.cpu_count() or 1, list(self._cases)
        with ThreadPoolExecutor(workers) as pool:
            for first in range(0, len(cases), workers):
                some = cases[first : first + workers]
                for case, varied in zip(some, pool.map(lambda case: case.replay(states), some), strict=True):
                    if not varied.good:
                        self._cases.remove(case)
                        self._cases.insert(0, case)
                        return varied
        return plain

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """See `Replayer.step`."""
        return self._replayer.step(history, before, after)


__all__ = ["DRAWS", "RobustReplayer", "Variation", "replay_varied", "variations"]
