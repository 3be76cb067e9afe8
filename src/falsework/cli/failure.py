"""Reports on failed searches: proven or not, depth reached, and the motion at the failing states."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.cli.velocity_text import PartMotion, describe, motions

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.search.problem.result import SearchResult
    from falsework.stability import Stability

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
    disassembly: bool
    """Whether the search ran in the order of disassembly."""
    moving: list[PartMotion]
    """Motions in the states where the search ended, the most frequent first."""
    reason: str
    """Reason why the search proves nothing, or what proves that no plan exists where the search alone does not."""
    sliding: int
    """States that the search rejected because they slide."""
    cut: bool
    """Whether the search was stopped before its end, by the keyboard or a deadline."""
    text: str
    """Summary in one line."""

    def to_dict(self, assembly: Assembly) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {
            "plan": None,
            "outcome": "no plan exists" if self.proven else "no plan was found",
            "interrupted": self.cut,
            "reached": self.reached,
            "steps": self.steps,
            "direction": "disassembly" if self.disassembly else "assembly",
            "reason": self.reason,
            "sliding": self.sliding,
            "moving": [motion.to_dict(assembly) for motion in self.moving],
        }


def explain(assembly: Assembly, oracle: Stability, result: SearchResult) -> Failure:
    """Report why a search found nothing.

    Args:
        assembly: the structure.
        oracle: decides which parts move in the states where the search broke off.
        result: end of the search.
    """
    from falsework.search.problem.result import Outcome
    from falsework.search.problem.task import Direction

    proven = result.outcome is Outcome.PROVED_IMPOSSIBLE
    disassembly = result.direction is Direction.DISASSEMBLY
    # Motions cost verdicts, for which a search that was stopped has no time left.
    moving = [] if result.interrupted else common_motions(assembly, oracle, result.rejected[:LOOKED_AT])
    doing = "taking it apart" if disassembly else "putting it together"
    reason = "; ".join(result.notes) if proven else result.limit
    parts = ["no plan exists" if proven else "no plan was found"]
    parts.append(f"{doing}, the search reached step {result.reached} of {result.steps}")
    if moving:
        parts.append(f"there {describe(assembly, moving, limit=3)}")
    elif not result.interrupted:
        parts.append("there the rules allow no further step")
    if reason:
        parts.append(reason)
    if result.sliding:
        parts.append(f"{result.sliding} states on the way slide; another robot or more friction may help")
    text = "; ".join(parts)
    reached, cut = result.reached, result.interrupted
    return Failure(proven, reached, result.steps, disassembly, moving, reason, result.sliding, cut, text)


def common_motions(assembly: Assembly, oracle: Stability, states: States) -> list[PartMotion]:
    """Return the motions of parts in unstable states, one per part, the most frequent first."""
    if not len(states):
        return []
    from falsework.stability.motion import motion_of

    verdicts = oracle.check(states)
    count: Counter[int] = Counter()
    fastest: dict[int, PartMotion] = {}
    for index in np.flatnonzero(verdicts.unstable | verdicts.slides):
        moved = motion_of(assembly, verdicts, int(index))
        for motion in [] if moved is None else motions(assembly, moved):
            count[motion.part] += 1
            if motion.part not in fastest or motion.speed > fastest[motion.part].speed:
                fastest[motion.part] = motion
    return [fastest[part] for part, _ in count.most_common()]
