"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from falsework.errors import InputError
from falsework.search.problem.task import Direction
from falsework.utils.quantity import check_seed

EDGES = "edges"
"""Name of the strategy that closes free edges first (see `EdgeGuide`); others are named after their direction."""

_BOTH = (Direction.ASSEMBLY, Direction.DISASSEMBLY)
_FIRST_SHARE = 8
"""Verdicts for each part of the structure that each strategy may ask for in the first round, and twice as many in each
further one. Searches without dead ends take half as many."""
_TRIAL_WIDTH = 4
"""Widest beam for a plan with missing parts later: independent of the width for the first plan."""
_NOVEL_WIDTHS = 4, 16
"""Narrowest and widest beam for a plan unlike others: one state a level leaves no choice."""


@dataclass(frozen=True)
class Portfolio:
    """Strategies of one search, each a beam from one end, which take turns."""

    strategies: tuple[str, ...]
    """Names in the order of their turns: `EDGES`, or a direction."""
    narrowest: int
    """Width of beams to begin with."""
    widest: int
    """Width up to which they restart."""
    share: int | None = None
    """Verdicts of the first turn of each; each further turn has twice as many. None: until it gives up."""

    def allowance(self, round: int) -> float:
        """Return the verdicts that a strategy may ask for up to and with a round, counted from 0."""
        return np.inf if self.share is None else self.share * (2.0 ** (round + 1) - 1.0)


def direction_of(strategy: str) -> Direction:
    """Return the direction in which a strategy searches."""
    return Direction.ASSEMBLY if strategy == EDGES else Direction(strategy)


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

    def portfolio(self, stage: str, parts: int, *, edges: bool = False) -> Portfolio:
        """Return the strategies of a search.

        Args:
            stage: `plan`, `postpone` or `alternatives`.
            parts: of the structure.
            edges: in stage `plan`, begin with a beam that closes free edges first.
        """
        names = [direction.value for direction in self.directions]
        if stage == "postpone":
            return Portfolio(tuple(names), 1, min(_TRIAL_WIDTH, self.width))
        if stage == "alternatives":
            # Disassembly leaves more freedom in the order of removal than assembly.
            names.sort(key=lambda name: name != Direction.DISASSEMBLY)
            narrowest, widest = (min(width, self.width) for width in _NOVEL_WIDTHS)
            return Portfolio(tuple(names), narrowest, widest)
        if edges and Direction.ASSEMBLY in self.directions:
            names.insert(0, EDGES)
        return Portfolio(tuple(names), 1, self.width, _FIRST_SHARE * parts)
