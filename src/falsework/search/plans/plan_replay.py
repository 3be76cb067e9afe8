"""Replayer of a search, and the summary of a replay that plans and plan files carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from falsework.search.problem.oracle import Oracle
    from falsework.search.settings import PlannerSettings
    from falsework.stability.contact.replay import Replay
    from falsework.stability.contact.varied_replay import AnyReplayer, VariableReplayer

_REPEATS, _LEAST = 1.1, 1e-9
"""Factor and length in m within which two replays of the same plan agree, on different processors too."""


@dataclass(frozen=True)
class PlanReplay:
    """Result of a replay of a plan in assembly order with contact history."""

    stands: bool
    """Whether every state comes to rest."""
    moved: float
    """Largest movement of a part in a state that comes to rest, m."""
    part: int
    """The part that moved that far, -1 if none moved."""
    falls_at: int | None = None
    """First state in the order of assembly that does not come to rest, counted from 0."""

    @classmethod
    def of(cls, replay: Replay) -> PlanReplay:
        """Return the summary of a replay."""
        resting = np.flatnonzero(replay.stands == 1)
        most = int(resting[np.argmax(replay.moved[resting])]) if len(resting) else -1
        return cls(replay.good, replay.largest, int(replay.part[most]) if most >= 0 else -1, replay.falls_at)

    def denied_by(self, replay: Replay) -> str:
        """Return what another replay of the same plan denies of this summary, in words; empty if nothing."""
        if self.stands and not replay.good:
            return "that it succeeds"
        if self.stands and replay.largest > _REPEATS * self.moved + _LEAST:
            return f"that parts move by at most {self.moved * 1e3:.3g} mm"
        return ""


def replayer_of(oracle: Oracle, settings: PlannerSettings) -> AnyReplayer | None:
    """Return the replayer for the routes of a search; None for an oracle without replays."""
    replayer: VariableReplayer | None = getattr(oracle, "replayer", None)
    if replayer is None or not settings.robust:
        return replayer
    from falsework.stability.contact.varied_replay import RobustReplayer

    return RobustReplayer(replayer)
