"""Forces and moments that robots bear for the parts that they hold, at their tools, against the limits of grippers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.shapes import move
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.stability.oracle import Stability
from falsework.stability.settings import StabilitySettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GripLoad:
    """Load on a gripper that holds a part in place, in the world frame."""

    keyframe: int
    robot: int
    part: int
    force: Array
    """Force of the gripper on the part, N, shape (3,)."""
    moment: Array
    """Moment about the origin of the tool frame, Nm, shape (3,)."""

    @property
    def force_n(self) -> float:
        """Magnitude of the force, N."""
        return float(np.linalg.norm(self.force))

    @property
    def moment_nm(self) -> float:
        """Magnitude of the moment, Nm."""
        return float(np.linalg.norm(self.moment))


def grip_loads(plan: RobotPlan, assembly: Assembly, cell: Cell) -> list[GripLoad]:
    """Return the load on each gripper at each keyframe at which it holds a part in a stable state.

    The load is the weight of the part and the forces of its neighbours, as the certificate of the state under the
    criterion of the plan has them; under `equilibrium` they are one of possibly many sets. In a hand-over each of both
    grippers is taken to bear all of it. Forces grow with the cube of the structure's scale in the cell, and moments
    with its fourth power.

    Args:
        plan: the robot plan.
        assembly: its structure.
        cell: its cell.

    Raises:
        PlanError: the plan is for another structure or cell.
    """
    plan.check_identity(assembly, cell)
    placement = cell.placement
    if placement.density is not None:
        assembly = assembly.replace(density=placement.density)
    oracle = Stability(assembly, StabilitySettings(criterion=plan.plan.claim.criterion))
    found = oracle.margins(plan.plan.states, ("held",))
    turn, volume = placement.pose[:3, :3], placement.scale**3
    center = move(placement.pose, placement.scale * assembly.mass.center)
    loads = []
    for number, (frame, row) in enumerate(zip(plan.keyframes, plan.rows.tolist(), strict=True)):
        borne = {load.part: load for load in found[row].held}
        for robot, part in enumerate(frame.held):
            if part is None or part not in borne:
                continue
            force = volume * turn @ borne[part].force
            moment = volume * placement.scale * turn @ borne[part].moment
            tool = tool_pose(cell.robots[robot], frame.configurations[robot])[:3, 3]
            loads.append(GripLoad(number, robot, part, force, moment + np.cross(center[part] - tool, force)))
    return loads


def overloads(loads: list[GripLoad], plan: RobotPlan, cell: Cell) -> list[PlanProblem]:
    """Return the loads beyond the force or moment that a gripper bears, as far as the cell gives them.

    A hold without a load, since its state is not stable, is a problem where the gripper has limits.
    """
    problems, known = [], {(load.keyframe, load.robot) for load in loads}
    for number, frame in enumerate(plan.keyframes):
        for robot, part in enumerate(frame.held):
            if part is not None and cell.robots[robot].gripper.has_limits and (number, robot) not in known:
                said = f"what holding {plan.plan.part_names[part]} takes is unknown: the state is not stable"
                problems.append(PlanProblem(max(number - 1, 0), cell.robots[robot].name, said))
    for load in loads:
        entry, name = cell.robots[load.robot], plan.plan.part_names[load.part]
        for what, value, limit, unit in (
            ("force", load.force_n, entry.gripper.force, "N"),
            ("moment", load.moment_nm, entry.gripper.moment, "Nm"),
        ):
            if value > limit:
                said = f"holding {name} takes a {what} of {value:.4g} {unit}; its gripper bears {limit:.4g} {unit}"
                problems.append(PlanProblem(max(load.keyframe - 1, 0), entry.name, said))
    return problems


def heaviest(loads: list[GripLoad], robot: int) -> tuple[GripLoad, GripLoad] | None:
    """Return the loads of a robot with the largest force and the largest moment; None if it holds nothing."""
    mine = [load for load in loads if load.robot == robot]
    if not mine:
        return None
    return max(mine, key=lambda load: load.force_n), max(mine, key=lambda load: load.moment_nm)
