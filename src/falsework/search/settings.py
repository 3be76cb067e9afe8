"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass

from falsework.errors import InputError
from falsework.search.problem.task import Direction

_BOTH = (Direction.ASSEMBLY, Direction.DISASSEMBLY)
_FIRST_WIDTH = 1
"""Beams grow to this width from one end before the other end is tried, which is often easier ..."""
_WIDENING = 4
"""... and then to widths this many times larger, in turn."""
_OTHER_WIDTH = 16
"""Widest beam for a plan unlike others."""
_TRIAL_WIDTH = 4
"""Widest beam for a plan with missing parts later: independent of the width for the first plan."""


@dataclass(frozen=True)
class PlannerSettings:
    """Effort of a search for plans."""

    width: int = 64
    """Widest beam that is tried before giving up, except for some levels where a beam died out."""
    directions: tuple[Direction, ...] = _BOTH
    """Ends from which to search, in turn."""
    alternatives: int = 1
    """Number of requested plans."""
    seed: int = 0
    """Same seed, same machine, same result."""
    robust: bool = False
    """Deliver only plans whose replay succeeds under other settings too: stiffness ratios, release increments, damping
    and random initial friction states."""

    def __post_init__(self) -> None:
        if self.width < 1:
            raise InputError(f"a beam of width {self.width} keeps nothing; give at least 1")
        if not self.directions:
            raise InputError("no direction to search in; give assembly, disassembly or both")
        if self.alternatives < 1:
            raise InputError(f"{self.alternatives} alternatives is not a number of plans; ask for at least 1")

    def attempts(self, stage: str = "plan") -> tuple[tuple[Direction, int], ...]:
        """Return the ends to search from and the maximum beam widths, in the order of the attempts.

        Args:
            stage: `plan`, `postpone` or `alternatives`.
        """
        first = {"plan": _FIRST_WIDTH, "postpone": _TRIAL_WIDTH, "alternatives": _OTHER_WIDTH}[stage]
        widths = [min(first, self.width)]
        while widths[-1] < self.width and stage == "plan":
            widths.append(min(widths[-1] * _WIDENING, self.width))
        directions = self.directions
        if stage == "alternatives":
            # Disassembly leaves more freedom in the order of removal than assembly.
            directions = tuple(sorted(directions, key=lambda direction: direction is not Direction.DISASSEMBLY))
        return tuple((direction, width) for width in widths for direction in directions)
