"""Time of a scheduled robot plan and the states that the structure reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.robots.plans.timeline import event_times
from falsework.search.problem.task import Direction

if TYPE_CHECKING:
    from falsework.robots.plans.robot_plan import RobotPlan

_BEFORE = 1 - 1e-9
"""Largest share of a step at which the state after it is not reached yet."""


@dataclass(frozen=True, eq=False)
class Clock:
    """Seconds from the start of a schedule, and places in the plan: steps of assembly that are done."""

    starts: NDArray[np.float64]
    """Start time of each motion, seconds, shape (nodes,)."""
    events: NDArray[np.float64]
    """Time at which the structure reaches each state but the first, seconds, ascending, shape (steps,)."""
    makespan: float
    """Time at which the last motion ends, seconds."""
    direction: Direction
    """Order in which the motions are executed."""

    @classmethod
    def from_plan(cls, plan: RobotPlan) -> Clock | None:
        """Return the clock of a plan; None without a schedule."""
        if plan.schedule is None:
            return None
        events = np.maximum.accumulate(event_times(plan, plan.schedule))[np.diff(plan.rows) != 0]
        return cls(plan.schedule.starts(), events, plan.makespan, plan.direction)

    def position(self, seconds: float) -> float:
        """Return the place in the plan at a time: steps of assembly done, and the share of the time to the next."""
        reached = int(np.searchsorted(self.events, seconds, side="right"))
        if reached == len(self.events):
            return self._turned(float(reached))
        before = self.events[reached - 1] if reached else 0.0
        return self._turned(reached + min(float((seconds - before) / (self.events[reached] - before)), _BEFORE))

    def seconds(self, position: float) -> float:
        """Return the time at which a place in the plan is reached; the last one is the end of all motions."""
        position = self._turned(position)
        if position >= len(self.events):
            return self.makespan
        return float(np.interp(position, np.arange(len(self.events) + 1), [0.0, *self.events]))

    def _turned(self, position: float) -> float:
        """Return steps executed from steps of assembly done, or the other way round."""
        return position if self.direction is Direction.ASSEMBLY else len(self.events) - position
