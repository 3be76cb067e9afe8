"""Stability oracle protocol, a base of its wrappers, and one that splits and counts queries."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from falsework.assembly.state import INSTALLED, Mask, States
from falsework.search.problem.hashing import chunks
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Solver, Verdicts

if TYPE_CHECKING:
    from falsework.stability.contact.replay import Replayer


_QUERY = 150_000
"""Work of a query and of the search around it, beyond iterations: some half of a millisecond."""
_EXACT = 100
"""Fast iterations that one of the exact solver counts for, by their time on a structure of 399 parts (80 to 140)."""


class Criterion(Protocol):
    """What decides which moves of a task need a verdict."""

    @property
    def holds_keep_stable(self) -> bool:
        """Whether a stable state stays stable when a part of it is held; see `Task.holds_keep_stable`."""
        ...


class Oracle(Criterion, Protocol):
    """Stability oracle for batches of states; `falsework.stability.StabilityOracle` is one.

    A class that inherits from it has to define `verdicts` alone: by default every move needs a verdict, states have no
    history, and no margins are demanded.
    """

    @property
    def holds_keep_stable(self) -> bool:
        """As of `Criterion`."""
        return False

    @property
    def replayer(self) -> Replayer | None:
        """Replayer of sequences of states; None where there is no history to take into account."""
        return None

    @property
    def settings(self) -> StabilitySettings | None:
        """Settings of the verdicts, by which robots carry groups of parts; None where these cannot be judged."""
        return None

    @property
    def premises(self) -> dict[str, Any]:
        """What verdicts depend on beside the structure, as plain JSON values; a saved search goes on under the same."""
        return {}

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts on states.

        Args:
            states: shape (batch, parts).
            near: for each state a stable one that is one move away; solvers may start from its forces.
            require_certificate: return certificates too, if the oracle has any.
        """
        ...

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states a replay may find at rest, given stable ones that are one move away. Shape (batch,)."""
        return self.verdicts(states, near=parents).stable

    def keeps(self, states: States) -> Mask:
        """Return which stable states keep all margins that are demanded. Shape (batch,)."""
        return np.ones(len(states), dtype=bool)


class WrappedOracle(Oracle):
    """Oracle that answers as another one; classes that inherit from it define what is different."""

    def __init__(self, oracle: Oracle) -> None:
        self.oracle = oracle

    @property
    def holds_keep_stable(self) -> bool:
        """As of the oracle, like all that follows."""
        return self.oracle.holds_keep_stable

    @property
    def replayer(self) -> Replayer | None:
        """Replayer of sequences of states."""
        return self.oracle.replayer

    @property
    def settings(self) -> StabilitySettings | None:
        """Settings of the verdicts."""
        return self.oracle.settings

    @property
    def premises(self) -> dict[str, Any]:
        """What verdicts depend on beside the structure."""
        return self.oracle.premises

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts on states."""
        return self.oracle.verdicts(states, near=near, require_certificate=require_certificate)

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states a replay may find at rest."""
        return self.oracle.plausible(states, parents)

    def keeps(self, states: States) -> Mask:
        """Return which stable states keep all margins that are demanded."""
        return self.oracle.keeps(states)


class CountingOracle:
    """Oracle wrapper that queries in batches of bounded size and counts."""

    def __init__(self, oracle: Oracle) -> None:
        """Bound the batches, so that an interruption never has to wait for a whole level."""
        self.oracle = oracle
        self.asked = 0
        self.rejected = 0
        self.undecided = 0
        self.sliding = 0
        self.forbidden: set[bytes] = set()
        """States at which a replay failed: counted as sliding without a verdict."""
        self.seconds = 0.0
        self.work = 0
        """What verdicts took: for each state the iterations of its solvers times the square of the parts that can move,
        and a share of its own. It tells cheap states from dear ones as processor time does, within a factor of two over
        searches from both ends of structures of 73 to 399 parts, but is the same on every machine. Where replays
        decide there is none."""
        self.replayed = False
        """Whether replays decide, so that `Oracle.plausible`, which rejects what falls by a cheap proof, is enough."""
        self.batch = 1024
        """States asked for at once at most."""

    def stable(self, states: States, parents: States) -> Mask:
        """Return whether each state is stable; sliding and undecided states count as not stable.

        Args:
            states: shape (batch, parts).
            parents: stable states one move away, shape (batch, parts).

        Returns:
            Shape (batch,).
        """
        begun = time.perf_counter()
        stable = np.zeros(len(states), dtype=bool)
        for rows in chunks(len(states), self.batch):
            if self.replayed:
                stable[rows] = self.oracle.plausible(states[rows], parents[rows])
            else:
                verdicts = self.oracle.verdicts(states[rows], near=parents[rows])
                stable[rows] = verdicts.stable
                self.sliding += int((verdicts.slides | verdicts.tips).sum())
                self.undecided += int(verdicts.undecided.sum())
                weight = np.where(verdicts.decided_by == Solver.EXACT, _EXACT, 1)
                free = (states[rows] == INSTALLED).sum(axis=1)
                self.work += int((_QUERY + free**2 * weight * verdicts.iterations).sum())
            if self.forbidden:
                fallen = np.array([state.tobytes() in self.forbidden for state in states[rows]], dtype=bool)
                self.sliding += int((stable[rows] & fallen).sum())
                stable[rows] &= ~fallen
        self.asked += len(states)
        self.rejected += int((~stable).sum())
        self.seconds += time.perf_counter() - begun
        return stable

    def unstable(self, states: States, parents: States) -> bool:
        """Return whether all of some states are proven unstable, however they are reached."""
        for rows in chunks(len(states), self.batch):
            found = self.oracle.verdicts(states[rows], near=parents[rows])
            self.asked += len(found)
            if not found.unstable.all():
                return False
        return True
