"""Oracle that keeps a deadline between small batches of verdicts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.problem.deadline import Deadline, pieces
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.timed_replayer import DeadlineReplayer
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Verdict, Verdicts


class TimedOracle(Oracle):
    """Oracle that checks the deadline between small batches, so that any search can be stopped."""

    def __init__(
        self,
        oracle: Oracle,
        clock: Deadline,
        replayer: DeadlineReplayer | None = None,
    ) -> None:
        """Query `oracle` until `clock` has run out.

        What `replayer` has shown counts, whatever the verdict of `oracle`, see `as_replayed`.
        """
        self.asked = 0
        """Number of states checked."""
        self.limited = clock.limited
        """Whether there is a deadline, so that batches must be small."""
        self._oracle, self._replayer, self._clock = oracle, replayer, clock

    @property
    def holds_keep_stable(self) -> bool:
        """As of the oracle."""
        return self._oracle.holds_keep_stable

    @property
    def replayer(self) -> DeadlineReplayer | None:
        """Replayer that keeps the deadline too; None where there is no history to take into account."""
        return self._replayer

    @property
    def settings(self) -> StabilitySettings | None:
        """As of the oracle."""
        return self._oracle.settings

    @property
    def premises(self) -> dict[str, Any]:
        """As of the oracle."""
        return self._oracle.premises

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """See `falsework.search.problem.oracle.Oracle`; verdicts with certificates are of a few states, at once.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        if require_certificate:
            with self._clock.piece("verdicts"):
                return self._oracle.verdicts(states, near=near, require_certificate=True)
        verdicts = Verdicts.all_undecided(len(states))
        for rows in pieces(len(states), limited=self.limited):
            with self._clock.piece("verdicts"):
                found = self._oracle.verdicts(states[rows], near=None if near is None else near[rows])
            verdicts.put(rows, found)
            verdicts.verdict[rows] = self.as_replayed(states[rows], found.verdict)
            self.asked += len(rows)
        return verdicts

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states a replay may find at rest, see `StabilityOracle.plausible`.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        with self._clock.piece("verdicts"):
            found = self._oracle.plausible(states, parents)
        self.asked += len(states)
        return found & ~self.rules_out(states)

    def keeps(self, states: States) -> Mask:
        """Return which states keep the margins that the oracle asks for; see `MarginOracle.keeps`."""
        return self._oracle.keeps(states)

    def as_replayed(self, states: States, verdict: NDArray[np.int8]) -> NDArray[np.int8]:
        """Return verdicts from rest with what replays have shown, shape (batch,).

        A state that they exclude slides. The state from which sequences go on stands as it has been built, unless that
        falls, also where it would slide from rest.
        """
        shown = verdict.copy()
        if self._replayer is not None:
            moves = (verdict == Verdict.SLIDES) | (verdict == Verdict.UNDECIDED)
            shown[moves & self._replayer.has_built(states)] = Verdict.STABLE
        shown[self.rules_out(states)] = Verdict.SLIDES
        return shown

    def rules_out(self, states: States) -> Mask:
        """Return which states replays have excluded, shape (batch,)."""
        known = () if self._replayer is None else self._replayer.falls.ruled_out
        return np.array([bool(known) and state.tobytes() in known for state in states], dtype=bool)


def timed(oracle: StabilityOracle, clock: Deadline) -> Oracle:
    """Return the oracle of a search that ends at the deadline of a clock, in the middle of a level if need be."""
    if not clock.limited:
        return oracle
    replayer = oracle.replayer
    return TimedOracle(oracle, clock, replayer=None if replayer is None else DeadlineReplayer(replayer, clock))
