"""Numbers of queries to a stability oracle."""

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
    """Number of states answered by monotonicity: the proof of another state holds for them too."""
    cpu: int = 0
    """Number of states decided by the CPU solver."""
    gpu: int = 0
    """Number of states decided by the GPU solver."""
    exact: int = 0
    """Number of states decided by the exact solver."""
    undecided: int = 0
    """Number of states left undecided by all solvers."""
    rejected: int = 0
    """Number of proofs of the fast solver that the checker rejected; the exact solver then decided."""
    warm: int = 0
    """Number of states solved with a warm start from the forces or the displacement of a parent."""

    def to_dict(self) -> dict[str, int]:
        """Return plain numbers for reports."""
        return asdict(self)
