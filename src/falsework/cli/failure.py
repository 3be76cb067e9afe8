"""Reports on failed searches: proven or not, depth reached, and the motion at the failing states."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.cli.velocity_text import PartMotion, describe, motions_at

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.search.problem.result import SearchResult
    from falsework.stability.oracle import StabilityOracle

LOOKED_AT = 16
"""Largest number of unstable states whose motions are examined."""


@dataclass(frozen=True)
class Failure:
    """Report on a search without a plan."""

    proven: bool
    """Whether it is proven that no plan exists."""
    reached: int
    """Number of steps that the search completed."""
    steps: int
    """Steps of a whole plan."""
    backwards: bool
    """Whether the search began at the end of the assembly."""
    moving: list[PartMotion]
    """Motions in the states where the search ended, the most frequent first."""
    reason: str
    """Reason why the search proves nothing, or what proves that no plan exists where the search alone does not."""
    sliding: int
    """States that the search rejected because they slide."""
    cut: bool
    """Whether the search was stopped before its end, by the keyboard or a deadline."""
    there: str
    """What moves where the search ended, in words; empty if it was stopped."""

    @property
    def outcome(self) -> str:
        """Outcome of the command."""
        return "impossible" if self.proven else "not_found"

    @property
    def words(self) -> str:
        """What the search says about plans."""
        return "no plan exists" if self.proven else "no plan was found"

    @property
    def text(self) -> str:
        """Summary in one line."""
        parts = [text for text in (self.words, self.progress, self.there, self.reason) if text]
        if self.sliding:
            sliding = "1 state on the way slides" if self.sliding == 1 else f"{self.sliding} states on the way slide"
            parts.append(f"{sliding}; another robot or more friction may help")
        return "; ".join(parts)

    def in_which(self, condition: str) -> str:
        """Return a summary for a search that ended at states that are stable, but do not meet a condition."""
        return f"{self.words} in which {condition}; {self.progress}"

    @property
    def progress(self) -> str:
        """How far the search got."""
        from falsework.search.problem.result import progress_text

        return progress_text(self.reached, self.steps, backwards=self.backwards)

    def to_dict(self, assembly: Assembly) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {
            "interrupted": self.cut,
            "reached": self.reached,
            "steps": self.steps,
            "search_from": "end" if self.backwards else "beginning",
            "reason": self.reason,
            "sliding": self.sliding,
            "moving": [motion.to_dict(assembly) for motion in self.moving],
        }


def explain(assembly: Assembly, oracle: StabilityOracle, result: SearchResult) -> Failure:
    """Report why a search found nothing.

    Args:
        oracle: decides which parts move in the states where the search broke off.
    """
    from falsework.search.problem.result import Outcome
    from falsework.search.problem.task import Direction

    proven = result.outcome is Outcome.PROVED_IMPOSSIBLE
    backwards = result.direction is Direction.DISASSEMBLY
    # Motions cost verdicts, for which a search that was stopped has no time left.
    moving = [] if result.interrupted else common_motions(assembly, oracle, result.rejected[:LOOKED_AT])
    reason = "; ".join(result.notes) if proven else result.limit
    there = f"there {describe(assembly, moving, limit=3)}" if moving else ""
    if not moving and not result.interrupted:
        there = "there the rules allow no further step"
    cut = result.interrupted
    return Failure(proven, result.reached, result.steps, backwards, moving, reason, result.sliding, cut, there)


def common_motions(assembly: Assembly, oracle: StabilityOracle, states: States) -> list[PartMotion]:
    """Return the motions of parts in unstable states, one per part, the most frequent first."""
    if not len(states):
        return []
    verdicts = oracle.verdicts(states, require_certificate=True)
    count: Counter[int] = Counter()
    fastest: dict[int, PartMotion] = {}
    for index in np.flatnonzero(~verdicts.stable & ~verdicts.undecided):
        for motion in motions_at(assembly, verdicts, int(index)):
            count[motion.part] += 1
            if motion.part not in fastest or motion.speed > fastest[motion.part].speed:
                fastest[motion.part] = motion
    return [fastest[part] for part, _ in count.most_common()]
