"""Counters of a stability oracle."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass
class Counters:
    """Numbers of queries to the oracle, by the solver that answered."""

    asked: int = 0
    """Number of requested states, repetitions included."""
    cached: int = 0
    """Number of states answered from the cache."""
    by_monotonicity: int = 0
    """Answered because a proof of another state holds for this one."""
    cpu: int = 0
    """Decided by the solver on the processor."""
    gpu: int = 0
    """Decided by the solver on the GPU."""
    exact: int = 0
    """Decided by the exact solver."""
    undecided: int = 0
    """Left open by all solvers."""
    rejected: int = 0
    """Proofs of the fast solver that the checker did not accept; the exact solver then decided."""
    warm: int = 0
    """Solved from the forces or the displacement of a parent."""

    def to_dict(self) -> dict[str, int]:
        """Plain numbers for reports."""
        return asdict(self)
