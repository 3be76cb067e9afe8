"""Settings of the planner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from falsework.errors import InputError
from falsework.search.problem.task import Direction
from falsework.utils.quantity import check_counts, check_seed

_BOTH = (Direction.ASSEMBLY, Direction.DISASSEMBLY)


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
    """Try plans under sixteen changes of settings in place of four, and those without a reserve too
    (`PlanReplay.varied`)."""
    judge: bool = False
    """Deliver a plan that discrete elements build too, with its presses, under the true friction; where none is found,
    the one that they build farthest (`PlanReplay.judgement`)."""
    patience: float = 2.0
    """Verdicts for each part of the structure that each strategy may ask for in its first turn without getting farther,
    and twice as many in each further one."""
    bound_after: float = 10.0
    """Seconds of processor time without a plan after which `find_plans` pauses to try to prove that robots are too few,
    for half as many seconds at most."""

    def __post_init__(self) -> None:
        check_counts(self, "width", "alternatives")
        given = (self.directions,) if isinstance(self.directions, str) else self.directions
        object.__setattr__(self, "directions", tuple(map(Direction, given)))
        if not self.directions:
            raise InputError("no direction to search in; give assembly, disassembly or both")
        if not (self.patience > 0 and self.bound_after >= 0):
            raise InputError("the patience of a search must be above 0, and the seconds before a bound not below 0")
        check_seed(self.seed)

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return vars(self) | {"directions": [direction.value for direction in self.directions]}
