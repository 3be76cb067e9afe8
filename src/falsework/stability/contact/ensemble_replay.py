"""Replay under several settings at once: a step counts only if the structure comes to rest under each of them.

Stiffness, damping, release, the friction in new contacts and the forces of robots are never known exactly. A plan that
a search finds under one setting and that is tried under others afterwards often fails late, where the search has to go
back far. An ensemble tries each step under all settings when the search takes it. So each plan stands under all, and
presses are chosen so that it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.history import History, Presses, Replay, ReplaySettings
from falsework.stability.contact.newton import OPEN
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.contact.varied_replay import GROUPS, Change, changed, variations
from falsework.stability.settings import StabilitySettings


@dataclass(frozen=True)
class _Member:
    """Replayer under changed settings, and the changes, those of presses included."""

    replayer: Replayer
    changes: Sequence[Change]
    settings: StabilitySettings

    def replay(self, batch: States, history: History | None, presses: Presses) -> Replay:
        """Replay checked states; robots err in the presses as the changes say."""
        return self.replayer._replay(batch, history, changed(self.changes, self.settings, presses)[2])


class EnsembleReplayer(Replayer):
    """Replayer of one structure under its settings and, at the same time, under groups of changes of them.

    A history that has none under the changed settings is continued under the own settings alone.
    """

    varies = True

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = StabilitySettings(),
        replay: ReplaySettings = ReplaySettings(),
        solver: ContactSolver | None = None,
    ) -> None:
        """Lay out the structure; see `Replayer`."""
        super().__init__(assembly, settings, replay, solver)
        known = variations(self.settings, draws=len(GROUPS))
        self._members = []
        for group in GROUPS:
            changes = [change for change in group if change in known or change.press is not None]
            other, numerics, _ = changed(changes, self.settings, ())
            self._members.append(_Member(self.vary(other, numerics), changes, self.settings))

    def _replay_all(self, batch: States, history: History | None, presses: Presses) -> Replay:
        found = self._replay(batch, history, presses)
        if history is not None and not history.changed:
            return found
        others, reached = list[Sequence[History]](), len(found.histories)
        for number, member in enumerate(self._members if reached else ()):
            past = None if history is None else history.changed[number]
            other = member.replay(batch[:reached], past, presses[:reached])
            others.append(other.histories)
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


__all__ = ["EnsembleReplayer"]
