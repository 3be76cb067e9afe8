"""Stability oracle protocol, and a wrapper that splits and counts queries."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from falsework.assembly.state import Mask, States
from falsework.stability.verdict import Verdicts


class Oracle(Protocol):
    """Stability oracle for batches of states; `falsework.stability.StabilityOracle` is one."""

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts on states.

        Args:
            states: shape (batch, parts).
            near: for each state a stable one that is one move away; solvers may start from its forces.
            require_certificate: return certificates too, if the oracle has any.
        """
        ...


Screen = Callable[[States, States], Mask]
"""Test of states, given stable ones that are one move away; see `StabilityOracle.plausible`."""


class CountingOracle:
    """Oracle wrapper that queries in batches of bounded size and counts."""

    def __init__(self, oracle: Oracle, *, batch: int = 1024) -> None:
        """Bound the batches, so that an interruption never has to wait for a whole level."""
        self.oracle = oracle
        self.asked = 0
        self.rejected = 0
        self.undecided = 0
        self.sliding = 0
        self.forbidden: set[bytes] = set()
        """States at which a replay failed: counted as sliding without a verdict."""
        self.seconds = 0.0
        self.screen: Screen | None = None
        """Test that takes the place of verdicts where a replay decides: it rejects what falls by a cheap proof."""
        self._batch = batch

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
        for begin in range(0, len(states), self._batch):
            rows = slice(begin, begin + self._batch)
            if self.screen is not None:
                stable[rows] = self.screen(states[rows], parents[rows])
            else:
                verdicts = self.oracle.verdicts(states[rows], near=parents[rows])
                stable[rows] = verdicts.stable
                self.sliding += int((verdicts.slides | verdicts.tips).sum())
                self.undecided += int(verdicts.undecided.sum())
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
        for begin in range(0, len(states), self._batch):
            rows = slice(begin, begin + self._batch)
            found = self.oracle.verdicts(states[rows], near=parents[rows])
            self.asked += len(found)
            if not found.unstable.all():
                return False
        return True
