"""Time of a robot plan and the states that the structure reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.robots.plans.timeline import event_times, schedule_of
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
    """Times at which the structure reaches the states after the first, seconds, ascending, shape (moved steps,)."""
    first: int
    """Steps that are executed before time begins."""
    steps: int
    """Steps of the plan."""
    makespan: float
    """Time at which the last motion ends, seconds."""
    direction: Direction
    """Order in which the motions are executed."""

    @classmethod
    def from_plan(cls, plan: RobotPlan) -> Clock:
        """Return the clock of a plan; without a schedule, one motion comes after the other."""
        graph = schedule_of(plan)
        events = np.maximum.accumulate(event_times(plan, graph))[np.diff(plan.rows) != 0]
        return cls(graph.starts(), events, int(plan.done[0]), len(plan.plan), plan.makespan, plan.direction)

    def position(self, seconds: float) -> float:
        """Return the place in the plan at a time: steps of assembly done, and the share of the time to the next."""
        reached = int(np.searchsorted(self.events, seconds, side="right"))
        if reached == len(self.events):
            return self._turned(float(self.first + reached))
        before = self.events[reached - 1] if reached else 0.0
        share = min(float((seconds - before) / (self.events[reached] - before)), _BEFORE)
        return self._turned(self.first + reached + share)

    def seconds(self, position: float) -> float:
        """Return the time at which a place in the plan is reached; the last one is the end of all motions."""
        position = max(self._turned(position) - self.first, 0.0)
        if position >= len(self.events):
            return self.makespan
        return float(np.interp(position, np.arange(len(self.events) + 1), [0.0, *self.events]))

    def _turned(self, position: float) -> float:
        """Return steps executed from steps of assembly done, or the other way round."""
        return position if self.direction is Direction.ASSEMBLY else self.steps - position
