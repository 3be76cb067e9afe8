"""Progress of a search for a robot plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class HybridProgress:
    """Progress of a running search."""

    reached: int
    """Steps of the longest plan so far."""
    steps: int
    attempt: int
    dead_ends: int
    seconds: float


Progress = Callable[[HybridProgress], None]
