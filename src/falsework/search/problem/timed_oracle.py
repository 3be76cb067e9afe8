"""Oracle that keeps a deadline between small batches of verdicts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from falsework.assembly.state import Mask, States
from falsework.search.problem.deadline import AdaptiveBatchSize, Deadline, DeadlineExceeded
from falsework.search.problem.oracle import Oracle, Screen
from falsework.search.problem.timed_replayer import DeadlineReplayer
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Verdict, Verdicts


class TimedOracle:
    """Oracle that checks the deadline between small batches, so that any search can be stopped."""

    def __init__(
        self,
        oracle: Oracle,
        clock: Deadline,
        between: Callable[[], None] | None = None,
        replayer: DeadlineReplayer | None = None,
    ) -> None:
        """Query `oracle` until `clock` has run out; call `between` before each batch.

        States that `replayer` has excluded count as sliding, whatever the verdict of `oracle`.
        """
        self.asked = 0
        """Number of states checked."""
        self.limited = clock.limited
        """Whether there is a deadline, so that batches must be small."""
        self.holds_keep_stable = bool(getattr(oracle, "holds_keep_stable", False))
        self.settings: StabilitySettings | None = getattr(oracle, "settings", None)
        """Of the oracle, for the groups that robots carry."""
        self.replayer = replayer
        """Replays the routes of searches; None where there is no history to take into account."""
        self._oracle = oracle
        self._screen: Screen = getattr(oracle, "plausible", lambda states, near: oracle.verdicts(states).stable)
        self._clock = clock
        self._between = between or (lambda: None)

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """See `falsework.search.problem.oracle.Oracle`; verdicts with certificates are of a few states, at once.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        if require_certificate:
            self._between()
            if self._clock.passed:
                raise DeadlineExceeded
            with self._clock.timed("verdicts"):
                return self._oracle.verdicts(states, near=near, require_certificate=True)
        verdicts = Verdicts.all_undecided(len(states))
        pace = AdaptiveBatchSize(limited=self.limited)
        begin = 0
        while begin < len(states):
            self._between()
            if self._clock.passed:
                raise DeadlineExceeded
            rows = np.arange(begin, min(begin + pace.batch, len(states)))
            with self._clock.timed("verdicts"), pace.measure():
                found = self._oracle.verdicts(states[rows], near=None if near is None else near[rows])
            verdicts.put(rows, found)
            verdicts.verdict[rows[self.rules_out(states[rows])]] = Verdict.SLIDES
            self.asked += len(rows)
            begin += len(rows)
        return verdicts

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states a replay may find at rest, see `StabilityOracle.plausible`.

        Raises:
            DeadlineExceeded: the deadline has passed.
        """
        self._between()
        if self._clock.passed:
            raise DeadlineExceeded
        with self._clock.timed("verdicts"):
            found = self._screen(states, parents)
        self.asked += len(states)
        return found & ~self.rules_out(states)

    def keeps(self, states: States) -> Mask:
        """Return which states keep the margins that the oracle asks for; see `MarginOracle.keeps`."""
        keeps = getattr(self._oracle, "keeps", None)
        return np.ones(len(states), dtype=bool) if keeps is None else keeps(states)

    def rules_out(self, states: States) -> Mask:
        """Return which states replays have excluded, shape (batch,)."""
        known = () if self.replayer is None else self.replayer.ruled_out
        return np.array([bool(known) and state.tobytes() in known for state in states], dtype=bool)


def timed(oracle: StabilityOracle, clock: Deadline) -> Oracle:
    """Return the oracle of a search that ends at the deadline of a clock, in the middle of a level if need be."""
    if not clock.limited:
        return oracle
    replayer = oracle.replayer
    return TimedOracle(oracle, clock, replayer=None if replayer is None else DeadlineReplayer(replayer, clock))
