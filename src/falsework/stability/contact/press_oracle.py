"""Verdicts on single states in which robots press: what stands from rest if held parts are pushed as they should be.

A state that slides from rest may stand if its robots press while its parts are let go of. From rest all of them are let
go of together: every part is held unstressed at first, then those that the state does not hold are released in
increments, while the others press. The wrench is chosen as in a replay, and must work with its errors too.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import HELD, INSTALLED, States, as_states
from falsework.errors import InputError
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import Press
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.state_memory import REMEMBERED
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts


class PressOracle:
    """Oracle that calls a state stable, too, if it stands from rest while its robots press the parts that they hold.

    Presses are sought on the CPU, state by state, and only where a state slides or tips and something is held. Each
    that counts is proven by `BuildVerifier`. How a state is reached is not taken into account; plans are replayed.
    """

    def __init__(self, oracle: StabilityOracle) -> None:
        """Take the verdicts without presses from an oracle.

        Raises:
            InputError: its criterion, or its robots, know no presses.
        """
        if oracle.replayer is None:
            raise InputError("robots press under the criterion contact alone; choose it, or leave presses out")
        if not oracle.settings.holds.presses:
            raise InputError("the robots of the settings never press; give them the mode force or hybrid, and a force")
        self.oracle = oracle
        self._replayer: Replayer = oracle.replayer
        self._known: dict[bytes, tuple[Press, ...] | None] = {}

    @property
    def holds_keep_stable(self) -> bool:
        """As of the oracle."""
        return self.oracle.holds_keep_stable

    @property
    def replayer(self) -> None:
        """None: how a state is reached is not taken into account."""
        return None

    @property
    def settings(self) -> StabilitySettings:
        """Settings of the verdicts."""
        return self.oracle.settings

    @property
    def premises(self) -> dict[str, Any]:
        """As of the oracle, and that robots press."""
        return {**self.oracle.premises, "presses": True}

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts, see `StabilityOracle.verdicts`; states for which robots press have no certificate."""
        verdicts = self.oracle.verdicts(states, near=near, require_certificate=require_certificate)
        for row in np.flatnonzero(verdicts.slides | verdicts.tips):
            if self.presses(states[row]):
                verdicts.verdict[row], verdicts.proof[row] = Verdict.STABLE, Proof.HISTORY
                verdicts.residual[row], verdicts.decided_by[row] = self.settings.tolerance, Solver.CPU
        return verdicts

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states are stable: without a replay, no other can be at rest. Shape (batch,)."""
        return self.verdicts(states, near=parents).stable

    def keeps(self, states: States) -> NDArray[np.bool_]:
        """As of the oracle."""
        return self.oracle.keeps(states)

    def presses(self, state: ArrayLike) -> tuple[Press, ...] | None:
        """Return with what robots press so that a state stands from rest; None if nothing was found.

        Args:
            state: shape (parts,). Empty where it stands without.
        """
        (here,) = as_states(state, self.oracle.assembly.boundary)
        key = here.tobytes()
        if key not in self._known:
            if len(self._known) >= REMEMBERED:
                self._known.clear()
            self._known[key] = self._find(here)
        return self._known[key]

    def _find(self, state: States) -> tuple[Press, ...] | None:
        assembly, replayer = self.oracle.assembly, self._replayer
        if not ((state == HELD) & ~assembly.immovable).any():
            return None
        whole = np.where(state == INSTALLED, HELD, state).astype(np.uint8)
        way = np.stack([whole, state])
        found = replayer.replay(way)
        if not found.good or replayer.first_tipping(way[1:], found.histories[1:]) is not None:
            return None
        claim = replace(replayer.settings.claim, holds=replayer.settings.holds)
        verifier = BuildVerifier(assembly, claim)
        proofs = [
            verifier.step(here, step) for here, step in zip(way, replayer.certificates(way, found.presses), strict=True)
        ]
        return found.presses[1] if all(proof.residual <= claim.tolerance for proof in proofs) else None


__all__ = ["PressOracle"]
