"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass, replace

from falsework.errors import InputError
from falsework.search.problem.task import Direction
from falsework.utils.quantity import check_seed

COMPACT, EDGES = "compact", "edges"
"""Names of the beam in which robots work in one place (see `BeamSettings`), and of the one that closes free edges first
(see `EdgeGuide`); others are named after their direction."""

_BOTH = (Direction.ASSEMBLY, Direction.DISASSEMBLY)
_FIRST_WIDTH = 1
"""Beams grow to this width from one end before the other end is tried, which is often easier ..."""
_WIDENING = 4
"""... and then to widths this many times larger, in turn."""
_OTHER_WIDTH = 16
"""Widest beam for a plan unlike others."""
_TRIAL_WIDTH = 4
"""Widest beam for a plan with missing parts later: independent of the width for the first plan."""
_EDGE_DEATHS = 128
"""Deaths of the beam that closes free edges first before the beam that is first elsewhere begins. In large shells it
dies in most rows (22 times in 30 rows of 3,998 parts), and passes after backtracking."""
_FREE_DEATHS = 16
"""Times that this one dies before one is tried in which robots work in one place ..."""
_COMPACT_DEATHS = 64
"""... and times that this one dies before the first goes on."""


@dataclass(frozen=True)
class Attempt:
    """Search with beams up to a width from one end."""

    direction: Direction
    """Which end to begin at."""
    width: int
    """Widest beam."""
    beam: str
    """Name of the beam; attempts with the same name go on with it."""
    deaths: int | None = None
    """Times that the beam dies before the next attempt; another attempt may go on with it."""


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
    judge: bool = False
    """Deliver a plan that discrete elements build too, with its presses, under the true friction; where none is found,
    the one that they build farthest (`PlanReplay.judgement`)."""

    def __post_init__(self) -> None:
        if self.width < 1:
            raise InputError(f"a beam of width {self.width} keeps nothing; give at least 1")
        if not self.directions:
            raise InputError("no direction to search in; give assembly, disassembly or both")
        if self.alternatives < 1:
            raise InputError(f"{self.alternatives} alternatives is not a number of plans; ask for at least 1")
        if self.judge and self.alternatives > 1:
            raise InputError("the judge takes minutes for alternatives; ask for one plan, or leave the judge out")
        check_seed(self.seed)

    def attempts(self, stage: str = "plan", *, compact: bool = False, edges: bool = False) -> tuple[Attempt, ...]:
        """Return attempts in their order.

        Args:
            stage: `plan`, `postpone` or `alternatives`.
            compact: in stage `plan`, have a beam in which robots work in one place try early on.
            edges: in stage `plan`, begin with a beam that closes free edges first.
        """
        first = {"plan": _FIRST_WIDTH, "postpone": _TRIAL_WIDTH, "alternatives": _OTHER_WIDTH}[stage]
        widths = [min(first, self.width)]
        while widths[-1] < self.width and stage == "plan":
            widths.append(min(widths[-1] * _WIDENING, self.width))
        directions = self.directions
        if stage == "alternatives":
            # Disassembly leaves more freedom in the order of removal than assembly.
            directions = tuple(sorted(directions, key=lambda direction: direction is not Direction.DISASSEMBLY))
        attempts = [Attempt(direction, width, direction.value) for width in widths for direction in directions]
        if stage == "plan" and Direction.ASSEMBLY in directions:
            free = directions.index(Direction.ASSEMBLY)
            first_beam = replace(attempts[free], deaths=_FREE_DEATHS)
            if compact:
                attempts[free:free] = [first_beam, replace(first_beam, beam=COMPACT, deaths=_COMPACT_DEATHS)]
            if edges:
                attempts[:0] = [replace(first_beam, beam=EDGES, deaths=_EDGE_DEATHS)]
        return tuple(attempts)
