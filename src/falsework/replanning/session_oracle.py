"""Oracle of a replanning request: it ends with the clock of the request, and leaves out what replays have excluded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.request_replayer import RequestReplayer
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.oracle import Oracle, WrappedOracle
from falsework.stability.verdict import Verdict, Verdicts


class SessionOracle(WrappedOracle):
    """Oracle of one request, which counts the states that it is asked for."""

    def __init__(self, oracle: Oracle, clock: Deadline, replayer: RequestReplayer | None = None) -> None:
        """Query an oracle until a clock has run out.

        What `replayer` has shown counts, whatever the verdict of the oracle, see `as_replayed`.
        """
        super().__init__(oracle)
        self.asked = 0
        """Number of states checked."""
        self._replayer, self._clock = replayer, clock

    @property
    def replayer(self) -> RequestReplayer | None:
        """Replayer of the request; None where there is no history to take into account."""
        return self._replayer

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """See `falsework.search.problem.oracle.Oracle`.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        with self._clock.piece("verdicts"):
            found = super().verdicts(states, near=near, require_certificate=require_certificate)
        if not require_certificate:
            found.verdict[:] = self.as_replayed(states, found)
            self.asked += len(states)
        return found

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states a replay may find at rest, see `StabilityOracle.plausible`.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        with self._clock.piece("verdicts"):
            found = super().plausible(states, parents)
        self.asked += len(states)
        return found & ~self.rules_out(states)

    def as_replayed(self, states: States, verdicts: Verdicts) -> NDArray[np.int8]:
        """Return verdicts from rest with what replays have shown, shape (batch,).

        A state that they exclude slides. The state from which sequences go on stands as it has been built, unless that
        falls, also where it would slide from rest.
        """
        shown = verdicts.verdict.copy()
        if self._replayer is not None:
            shown[verdicts.depends_on_path & self._replayer.has_built(states)] = Verdict.STABLE
        shown[self.rules_out(states)] = Verdict.SLIDES
        return shown

    def rules_out(self, states: States) -> Mask:
        """Return which states replays have excluded, shape (batch,)."""
        known = () if self._replayer is None else self._replayer.falls.ruled_out
        return np.array([bool(known) and state.tobytes() in known for state in states], dtype=bool)
