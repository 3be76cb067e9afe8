"""Execution of a schedule under random delays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from falsework.errors import InputError, PlanError
from falsework.robots.model.shapes import Array
from falsework.robots.plans.reachable_positions import ReachablePositions
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.utils.quantity import check_seed


@dataclass(frozen=True, eq=False)
class SimulationReport:
    """Results of simulated executions of one schedule under random delays."""

    makespans: Array
    """Seconds, shape (runs,)."""
    out_of_order: int
    """Number of runs in which the structure reached a state that is not in the plan, or in another order."""
    outside: int
    """Number of runs through positions that the check of all delays takes for impossible, and does not check."""

    @property
    def spread(self) -> tuple[float, float, float]:
        """Least, median and largest makespan, seconds."""
        least, median, most = np.quantile(self.makespans, (0.0, 0.5, 1.0)).tolist()
        return least, median, most

    @property
    def good(self) -> bool:
        """Whether every run ended through the states of the plan in order, and through checked positions only."""
        return not (self.out_of_order or self.outside)


def simulate(plan: RobotPlan, *, runs: int = 1000, most: float = 1.0, seed: int = 0) -> SimulationReport:
    """Simulate a schedule many times; each motion takes longer by a random share.

    No run ends in a deadlock, since motions of a schedule never wait for each other in a cycle (`TemporalPlanGraph`).
    Collisions are not looked for in the runs: `check_robot_plan` checks all positions that any delays can lead to, and
    every run is compared with these.

    Args:
        plan: robot plan with a schedule.
        most: largest share by which a motion takes longer; uniform from 0.

    Raises:
        PlanError: the plan has no schedule.
        InputError: a share that is negative or not finite, no runs, or a negative seed.
    """
    graph = plan.schedule
    if graph is None:
        raise PlanError("the robot plan has no schedule to simulate; plan again, or schedule it")
    if not 0 <= most < np.inf or runs < 1:
        raise InputError(
            f"cannot simulate {runs} runs with delays of up to {most:g} times each motion; give at least 1 run and a "
            "finite share, not negative"
        )
    check_seed(seed)
    reachable, rng = ReachablePositions(plan), np.random.default_rng(seed)
    node = np.array([event.node for event in reachable.events], dtype=np.int64)
    at_end = np.array([event.at_end for event in reachable.events])
    makespans = np.zeros(runs)
    out_of_order = outside = 0
    for run in range(runs):
        stretch = 1.0 + most * rng.random(len(graph.nodes))
        starts = graph.starts(stretch)
        ends = starts + stretch * graph.durations
        makespans[run] = ends.max(initial=0.0)
        out_of_order += bool((np.diff(np.where(at_end, ends[node], starts[node])) < -1e-9).any())
        outside += not reachable.contains(starts, stretch)
    return SimulationReport(makespans, out_of_order, outside)
