"""Contact histories of structures under construction, and the results of replays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.stability.contact.newton import OPEN, RESTS
from falsework.stability.holds import Press, inexact_presses
from falsework.stability.settings import NumericalSettings, StabilitySettings
from falsework.utils.quantity import check_positive

Array = NDArray[np.float64]

Presses = Sequence[Sequence[Press]]
"""Presses of the steps that lead to each state, one entry a state."""


def of_all(presses: Presses, count: int) -> tuple[tuple[Press, ...], ...]:
    """Return one entry for each of some states: a replay has none for those that it did not reach."""
    return (*map(tuple, presses), *((),) * (count - len(presses)))


@dataclass(frozen=True)
class ReplaySettings:
    """Numerical settings of a replay; the result for a stable plan must not depend on them."""

    increments: int = 4
    """Increments in which the load of a robot is transferred to the contacts when it releases a part. More than four
    are the smallest: after one that a single iteration balances the next is twice as large, up to a quarter."""
    first_step: float = NumericalSettings.first_step
    """First time step of the Newton iterations; a shorter one means higher viscosity."""
    friction_noise: float = 0.0
    """Largest tangential force in new contact points before they carry load, as a share of the friction limit of a
    typical point under its share of a part's weight."""
    seed: int = 0
    """Seed of the noise."""
    keeps_track: bool = True
    """Whether histories have the displacement in each increment, of which certificates are made."""

    def __post_init__(self) -> None:
        if self.increments < 1:
            raise InputError("a replay needs at least one increment")
        check_positive(self, "first_step")
        if not (np.isfinite(self.friction_noise) and self.friction_noise >= 0):
            raise InputError(f"friction_noise is {self.friction_noise}; give a number from 0 up")


@dataclass(frozen=True)
class Change:
    """Change of the settings of a replay, to which the result for a plan must be insensitive."""

    name: str
    ratio: float | None
    """Ratio of tangential to normal stiffness; None for that of the settings."""
    hold_factor: float
    """Factor of the stiffness of holds, where they are not locked."""
    press: int | None
    """Error of all presses, an index of `inexact_presses`; None for none."""
    replay: ReplaySettings
    """Release, damping and friction in new contacts."""
    reserve: float | None = None
    """Factor of safety on friction; None for that of the settings."""

    def applied_to(self, settings: StabilitySettings) -> StabilitySettings:
        """Return settings with this change."""
        holds = replace(settings.holds, stiffness=self.hold_factor * settings.holds.stiffness)
        ratio = settings.stiffness_ratio if self.ratio is None else self.ratio
        reserve = settings.reserve if self.reserve is None else self.reserve
        return replace(settings, holds=holds, stiffness_ratio=ratio, reserve=reserve)

    def inexact(self, presses: Presses) -> Presses:
        """Return presses with their error."""
        if self.press is None:
            return presses
        return [inexact_presses(some)[self.press] if some else () for some in presses]


@dataclass(frozen=True, eq=False)
class History:
    """Contact history of a structure under construction."""

    displacement: Array
    """Displacement of each part since it was placed, m and rad, shape (parts, 6)."""
    springs: Array
    """Spring forces of the contact points in scaled variables, shape (points, 3)."""
    torn: NDArray[np.bool_]
    """Contact points whose tensile strength was exceeded, shape (points,)."""
    age: NDArray[np.int32]
    """Steps for which both parts of each contact point have been present, shape (points,), or (0,) where no joint
    sets."""
    moved: float = 0.0
    """Largest movement of a part since it was placed, m."""
    part: int = -1
    """The part that moved most, -1 where none moved."""
    presses: tuple[Press, ...] = ()
    """Presses of the step that led here."""
    track: Array | None = None
    """Displacement of each part in each increment of that step, m and rad, shape (increments, parts, 6); None where it
    is not kept."""
    changed: tuple[History, ...] = ()
    """The same under each of `Replayer.changes`; empty where one setting alone is replayed."""

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take, bytes."""
        arrays = self.displacement, self.springs, self.torn, self.age, self.track
        own = sum(array.nbytes for array in arrays if array is not None)
        return own + sum(history.nbytes for history in self.changed)


@dataclass(frozen=True, eq=False)
class Replay:
    """Result of a replay in assembly order, up to the first state that does not come to rest."""

    stands: NDArray[np.int8]
    """For each state: 1 it comes to rest, -1 parts move away, -2 a robot bears more than it can, 0 undecided or not
    reached; shape (states,)."""
    moved: Array
    """Largest movement of a part since it was placed, m, shape (states,)."""
    part: NDArray[np.int32]
    """The part that moved most, -1 where none moved, or whose robot bears too much, shape (states,)."""
    residual: Array
    """Residual at rest, in the units of the tolerance, shape (states,)."""
    histories: tuple[History, ...] = ()
    """Histories after each state that was reached."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of the step to each state that was reached."""

    @property
    def good(self) -> bool:
        """Whether every state comes to rest."""
        return bool((self.stands == RESTS).all())

    @property
    def falls_at(self) -> int | None:
        """First state that does not come to rest; None if all do."""
        bad = np.flatnonzero(self.stands != RESTS)
        return int(bad[0]) if len(bad) else None

    @property
    def largest(self) -> float:
        """Largest movement of a part in the states that come to rest, m."""
        return float(self.moved[self.stands == RESTS].max(initial=0.0))


def joined(parts: list[Replay], count: int) -> Replay:
    """Join replays of consecutive states, each of which begins with the state at which the one before it ended."""
    if len(parts) == 1:
        return parts[0]
    histories: list[History] = []
    stands, residual = np.full(count, OPEN, np.int8), np.full(count, np.nan)
    moved, most = np.zeros(count), np.full(count, -1, np.int32)
    for replay in parts:
        begin = len(histories)
        for whole, piece in zip(
            (stands, residual, moved, most), (replay.stands, replay.residual, replay.moved, replay.part), strict=True
        ):
            whole[begin:] = piece
        histories += replay.histories
    presses = tuple(history.presses for history in histories)
    return Replay(stands, moved, most, residual, tuple(histories), presses)
