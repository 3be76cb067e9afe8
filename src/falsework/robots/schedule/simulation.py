"""Execution of a schedule under random delays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError, PlanError
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import event_times

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SimulationReport:
    """Results of simulated executions of one schedule under random delays."""

    makespans: Array
    """Seconds, shape (runs,)."""
    out_of_order: int
    """Number of runs in which the structure reached a state that is not in the plan, or in another order."""
    stuck: int
    """Number of runs that ended in a deadlock."""

    @property
    def good(self) -> bool:
        """Whether every run ended through the states of the plan in order."""
        return not (self.out_of_order or self.stuck)


def simulate(plan: RobotPlan, *, runs: int = 1000, most: float = 1.0, seed: int = 0) -> SimulationReport:
    """Simulate a schedule many times; each motion takes longer by a random share.

    Args:
        plan: robot plan with a schedule.
        runs: number of runs.
        most: largest share by which a motion takes longer; uniform from 0.
        seed: seed of the delays.

    Raises:
        PlanError: the plan has no schedule.
        InputError: a share that is negative or not finite, or no runs.
    """
    graph = plan.schedule
    if graph is None:
        raise PlanError("the robot plan has no schedule to simulate; plan again, or schedule it")
    if not 0 <= most < np.inf or runs < 1:
        raise InputError(f"cannot simulate {runs} runs with delays of up to {most:g}; give finite numbers above 0")
    rng = np.random.default_rng(seed)
    makespans = np.zeros(runs)
    out_of_order = stuck = 0
    for run in range(runs):
        stretch = 1.0 + most * rng.random(len(graph.nodes))
        makespans[run] = graph.finish(stretch)
        stuck += not np.isfinite(makespans[run])
        out_of_order += bool((np.diff(event_times(plan, graph, stretch)) < -1e-9).any())
    return SimulationReport(makespans, out_of_order, stuck)
