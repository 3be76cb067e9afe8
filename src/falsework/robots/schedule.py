"""From paths to timed motions: the robot plan along a chain of edges of the keyframe graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.robots.cell import Cell
from falsework.robots.keyframes import Edge, Leg, Node
from falsework.robots.model import RobotModel
from falsework.robots.robot_plan import Keyframe, RobotPlan, Step, Trajectory, cell_identity, records_of
from falsework.robots.timing import time_path
from falsework.search.find import plan_of
from falsework.search.result import Route
from falsework.search.task import Task
from falsework.stability.oracle import Stability

Array = NDArray[np.float64]

_STILL = 1e-7
"""A path that goes no farther takes no time, rad or m."""


def make_robot_plan(
    assembly: Assembly,
    cell: Cell,
    task: Task,
    oracle: Stability,
    route: Route,
    root: Node,
    chain: Sequence[Edge],
    *,
    forces: bool = False,
) -> RobotPlan:
    """Prove the states of a route and time the motions along it.

    Args:
        assembly: the structure.
        cell: the robots.
        task: what was planned.
        oracle: proves the states.
        route: states and actions.
        root: the first keyframe.
        chain: an edge for every action.
        forces: keep the contact forces in the plan.

    Raises:
        PlanError: a state that cannot be proved stable.
    """
    abstract = plan_of(route, assembly, task, oracle, forces=forces)
    steps = []
    for edge in chain:
        model = cell.robots[edge.robot].model
        timed = (timed_leg(model, leg, cell.speed) for leg in edge.legs)
        steps.append(Step(edge.robot, tuple(trajectory for trajectory in timed if trajectory is not None)))
    nodes = (root, *(edge.node for edge in chain))
    return RobotPlan(
        plan=abstract,
        keyframes=tuple(Keyframe(node.configurations, node.held) for node in nodes),
        steps=tuple(steps),
        robots=records_of(cell),
        cell_name=cell.name,
        cell_identity=cell_identity(cell),
    )


def timed_leg(model: RobotModel, leg: Leg, speed: float) -> Trajectory | None:
    """A path as fast as the limits of the arm allow, at a share of them; None if it leads nowhere."""
    if np.abs(np.diff(leg.path, axis=0)).sum() < _STILL:
        return None
    timed = time_path(model, leg.path, speed)
    kind = "line" if leg.kind == "line" else "free"
    return Trajectory(kind, timed.times, timed.positions, timed.velocities, leg.part, leg.touches)
