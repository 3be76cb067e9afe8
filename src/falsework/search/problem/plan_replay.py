"""Summary of a replay of a plan, which plans and plan files carry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.stability.contact.build_verifier import StepCertificate
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.holds import Press
from falsework.stability.judges.judgement import Judgement
from falsework.utils.quantity import format_bound

if TYPE_CHECKING:
    from falsework.stability.contact.history import Replay

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
    presses: tuple[tuple[Press, ...], ...] = field(default=(), compare=False, repr=False)
    """Presses of the step to each state in the order of assembly; empty where they are not known."""
    steps: tuple[StepCertificate, ...] = field(default=(), compare=False, repr=False)
    """Certificates of these steps, where the search has kept them."""
    varied: bool = False
    """Whether it also comes to rest under each of some changes of settings, see `AllVariations`."""
    judgement: Judgement | None = None
    """How far discrete elements built the plan, where that was asked for."""
    loads: Loads = field(default=(), compare=False, repr=False)
    """What robots bear under the true friction, one entry a state in the order of assembly; empty where it is not
    known."""

    @property
    def fails_at(self) -> int | None:
        """First state in the order of assembly that does not come to rest, in the replay or by discrete elements."""
        return self.falls_at if self.judgement is None or not self.stands else self.judgement.falls_at

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values, without presses, certificates and loads."""
        plain = {name: value for name, value in vars(self).items() if name not in _NOT_PLAIN}
        return plain if self.judgement is None else {**plain, "judgement": self.judgement.to_dict()}

    @classmethod
    def from_replay(cls, replay: Replay) -> PlanReplay:
        """Return the summary of a replay."""
        resting = np.flatnonzero(replay.stands == 1)
        most = int(resting[np.argmax(replay.moved[resting])]) if len(resting) else -1
        part = int(replay.part[most]) if most >= 0 else -1
        return cls(replay.good, replay.largest, part, replay.falls_at, replay.presses)

    def denied_by(self, replay: Replay, *, marginal: bool = False) -> str:
        """Return what another replay of the same plan denies of this summary, in words; empty if nothing.

        Args:
            marginal: it does not come to rest under some change of settings.
        """
        if self.stands and not replay.good:
            return "that it succeeds"
        if self.stands and replay.largest > _REPEATS * self.moved + _LEAST:
            return f"that parts move by {format_bound(self.moved, 'length')}"
        if self.varied and marginal:
            return "that it succeeds under changed settings too"
        return ""


_NOT_PLAIN = "presses", "steps", "judgement", "loads"
