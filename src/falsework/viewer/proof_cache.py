"""Proofs of the states that a page has shown, of which the last ones are kept."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from falsework.assembly.state import States
from falsework.stability.oracle import StabilityOracle
from falsework.viewer.proof import BuildProofs, StateProof, proof_of_state

if TYPE_CHECKING:
    from falsework.search.plans.plan import Plan

_PROOFS = 64
"""Number of proofs that are kept."""


class ProofCache:
    """Proofs of states: of a plan as they are reached in assembly, under `contact`; of others from rest."""

    def __init__(self, *, contact: bool) -> None:
        """Begin with none.

        Args:
            contact: whether the criterion is `contact`.
        """
        self._contact = contact
        self._proofs: OrderedDict[int | bytes, StateProof] = OrderedDict()
        self._plan: Plan | None = None
        self._build: BuildProofs | None = None

    def find(self, plan: Plan | None, row: int, state: States) -> StateProof | None:
        """Return a proof that is known; the arguments are those of `prove`."""
        return self._proofs.get(self._key(plan, row, state))

    def prove(self, oracle: StabilityOracle, plan: Plan | None, row: int, state: States) -> StateProof:
        """Return the proof of a state.

        Args:
            plan: whose state it is; None for a state that no plan has reached.
            state: shape (parts,).
        """
        key = self._key(plan, row, state)
        proof = self._proofs.get(key)
        if proof is None:
            if plan is not None and self._contact:
                self._build = self._build or BuildProofs(plan, oracle)
                proof = self._build.at(row)
            else:
                proof = proof_of_state(oracle, state)
            self._proofs[key] = proof
            while len(self._proofs) > _PROOFS:
                self._proofs.popitem(last=False)
        return proof

    def _key(self, plan: Plan | None, row: int, state: States) -> int | bytes:
        """Return the row of a state of a plan under `contact`, else the state; another plan begins anew."""
        if plan is None or not self._contact:
            return state.tobytes()
        if plan is not self._plan:
            self._plan, self._build = plan, None
            self._proofs.clear()
        return row
