"""Forces and moments of the robots of a plan: what they press, when, and what their grippers bear for held parts.

Robots press in assembly, while another robot lets go of its part. All exports read the presses from here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD
from falsework.errors import PlanError
from falsework.geometry.arrays import apply
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import CellScale
from falsework.robots.model.shapes import Array
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.robot_plan import RobotPlan, acts
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import event_times
from falsework.search.plans.plan import Plan
from falsework.search.problem.task import Direction
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, Press
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import format_quantity


@dataclass(frozen=True, eq=False)
class TimedPress:
    """Press of one robot in the world frame of the cell."""

    step: int
    """Step of the robot plan in which another robot lets go of its part."""
    robot: int
    part: int
    wrench: Array
    """Wrench that the robot adds: force in N, and moment about the part's centre of mass in Nm, shape (6,)."""
    center: Array
    """Centre of mass of the part, shape (3,)."""
    tool: Array
    """Pose of the tool frame, shape (4, 4)."""
    stiffness: float
    """Stiffness of the robot while it presses, N/m; in hybrid mode along the force, across which it keeps its pose."""
    turning: Array
    """Stiffness against turning about the centre of mass, Nm/rad, shape (3, 3)."""
    mode: HoldMode
    """Whether the robot controls the whole wrench, or the force along its direction and the pose across it."""
    start: float
    """Time at which the other robot opens its gripper, seconds; the wrench must act then."""
    end: float
    """Time at which the other robot has withdrawn, or this one does its next action, seconds."""

    @property
    def force(self) -> float:
        """Size of the force, N."""
        return float(np.linalg.norm(self.wrench[:3]))

    def wrench_in(self, frame: Array) -> Array:
        """Return the wrench in a frame, with the moment about its origin, N and Nm, (4, 4) to (6,)."""
        force, moment = self.wrench[:3], self.wrench[3:]
        moment = moment + np.cross(self.center - frame[:3, 3], force)
        return np.concatenate([force @ frame[:3, :3], moment @ frame[:3, :3]])

    @property
    def offset(self) -> Array:
        """Displacement of the set point of the tool frame that adds the wrench, along and about its axes, m and rad.

        Shape (6,).
        """
        angle = np.linalg.solve(self.turning, self.wrench[3:])
        shift = self.wrench[:3] / self.stiffness + np.cross(angle, self.tool[:3, 3] - self.center)
        return np.concatenate([shift @ self.tool[:3, :3], angle @ self.tool[:3, :3]])


def has_presses(plan: RobotPlan) -> bool:
    """Return whether robots press when they carry out a plan."""
    return plan.direction is Direction.ASSEMBLY and any(plan.plan.presses)


def presses_in(plan: RobotPlan, step: int) -> tuple[Press, ...]:
    """Return the presses of a step as it is done in assembly, in the structure's units."""
    presses = plan.plan.presses
    return presses[plan.number(step) - 1] if presses and acts(plan.steps[step]) else ()


def pressing_robot(plan: RobotPlan, step: int, part: int) -> int | None:
    """Return the robot that holds a part before and after a step; None without one."""
    pairs = zip(plan.keyframes[step].held, plan.keyframes[step + 1].held, strict=True)
    return next((robot for robot, held in enumerate(pairs) if held == (part, part)), None)


def press_fault(plan: RobotPlan, step: int) -> str:
    """Return why the presses of a step cannot be carried out; empty if they can."""
    apart = plan.direction is Direction.DISASSEMBLY
    for press in presses_in(plan, step):
        name = plan.plan.part_names[press.part]
        if plan.grip(step) != ("close" if apart else "open"):
            return f"{name} is pressed while no other part is let go of"
        if pressing_robot(plan, step, press.part) is None:
            return f"{name} is pressed, but no robot holds it all the time"
    return ""


def timed_presses(plan: RobotPlan, assembly: Assembly, cell: Cell, graph: TemporalPlanGraph) -> tuple[TimedPress, ...]:
    """Return the presses of a plan in the order of its steps; none for disassembly, in which robots do not press.

    PlanError if the plan is for another structure or cell, or its presses cannot be carried out.
    """
    if not has_presses(plan):
        return ()
    plan.check_identity(assembly, cell)
    scale, placement, holds = CellScale.from_cell(assembly, cell), cell.placement, plan.plan.claim.holds
    turn, centers = placement.pose[:3, :3], apply(placement.pose, placement.scale * assembly.mass.center)
    stiffness = scale.stiffness * min(holds.stiffness, PRESS_STIFFNESS)
    starts, released = graph.starts(), event_times(plan, graph)
    found = []
    for step in range(len(plan)):
        if fault := press_fault(plan, step):
            raise PlanError(f"step {step + 1} of the robot plan: {fault}; plan again")
        for press in presses_in(plan, step):
            robot = pressing_robot(plan, step, press.part)
            assert robot is not None
            wrench, inertia = np.array(press.wrench), assembly.mass.inertia[press.part]
            own = inertia / assembly.mass.mass[press.part] * placement.scale**2
            withdrawn = max(
                start + node.seconds for start, node in zip(starts, graph.nodes, strict=True) if node.step == step
            )
            following = (starts[node] for node in graph.of_robot(robot) if graph.nodes[node].step > step)
            found.append(
                TimedPress(
                    step,
                    robot,
                    press.part,
                    np.concatenate([scale.force * turn @ wrench[:3], scale.moment * turn @ wrench[3:]]),
                    centers[press.part],
                    tool_pose(cell.robots[robot], plan.keyframes[step].configurations[robot]),
                    stiffness,
                    stiffness * turn @ own @ turn.T,
                    holds.mode,
                    float(released[step]),
                    float(min(withdrawn, next(following, np.inf))),
                )
            )
    return tuple(found)


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
    presses: bool = False
    """Whether this is the wrench alone that the robot adds to the part when it presses."""

    @property
    def force_n(self) -> float:
        """Magnitude of the force, N."""
        return float(np.linalg.norm(self.force))

    @property
    def moment_nm(self) -> float:
        """Magnitude of the moment, Nm."""
        return float(np.linalg.norm(self.moment))

    def fault(self, plan: RobotPlan, cell: Cell) -> str:
        """Return what the gripper does not bear; empty if it bears the load, as far as the cell gives limits."""
        gripper, name = cell.robots[self.robot].gripper, plan.plan.part_names[self.part]
        does = "pressing" if self.presses else "holding"
        for what, value, limit in (("force", self.force_n, gripper.force), ("moment", self.moment_nm, gripper.moment)):
            if value > limit:
                takes, bears = format_quantity(value, what), format_quantity(limit, what)
                return f"{does} {name} takes a {what} of {takes}; its gripper bears {bears}"
        return ""


def grip_loads(plan: RobotPlan, assembly: Assembly, cell: Cell) -> list[GripLoad]:
    """Return the load on each gripper at each keyframe at which it holds a part in a stable state, and each press.

    Under `contact` the load is what the robot bears in the state as built, with what it has pressed until then: the
    larger force, and the larger moment, of those with the reserve and under the true friction, as in `Plan.loads`. When
    settings change otherwise, searches keep the limits of the grippers about the centre of mass; what arms bear then is
    not listed. Under `equilibrium` it is the weight of the part and the forces of its neighbours in one of possibly
    many sets. In a hand-over each of both grippers is taken to bear all of it. A press is listed at the keyframe after
    its step, alone. Forces grow with the cube of the structure's scale in the cell, and moments with its fourth power.
    """
    plan.check_identity(assembly, cell)
    placement, scale = cell.placement, CellScale.from_cell(assembly, cell)
    turn, center = placement.pose[:3, :3], apply(placement.pose, placement.scale * assembly.mass.center)

    def load(keyframe: int, robot: int, part: int, *wrenches: Array, **more: bool) -> GripLoad:
        tool = tool_pose(cell.robots[robot], plan.keyframes[keyframe].configurations[robot])[:3, 3]
        forces = [scale.force * turn @ wrench[:3] for wrench in wrenches]
        moments = [
            scale.moment * turn @ wrench[3:] + np.cross(center[part] - tool, force)
            for wrench, force in zip(wrenches, forces, strict=True)
        ]
        return GripLoad(keyframe, robot, part, _largest(forces), _largest(moments), **more)

    cases, loads = _borne(plan.plan, assembly), []
    for number, (frame, row) in enumerate(zip(plan.keyframes, plan.rows.tolist(), strict=True)):
        held = [(robot, part) for robot, part in enumerate(frame.held) if part is not None]
        known = [(robot, part) for robot, part in held if all(part in borne[row] for borne in cases)]
        loads += [load(number, robot, part, *(borne[row][part] for borne in cases)) for robot, part in known]
        for press in presses_in(plan, number - 1) if number else ():
            robot = pressing_robot(plan, number - 1, press.part)
            if robot is not None:
                loads.append(load(number, robot, press.part, np.array(press.wrench), presses=True))
    return loads


def _largest(vectors: list[Array]) -> Array:
    return max(vectors, key=lambda vector: float(np.linalg.norm(vector)))


_Borne = list[dict[int, Array]]
"""For each stable state the wrench that a robot bears on each held part, about its centre of mass, (6,)."""


def _borne(plan: Plan, assembly: Assembly) -> list[_Borne]:
    """Return what robots bear with the reserve of a plan and, where it has one, under the true friction."""
    states, settings = plan.states, StabilitySettings.from_claim(plan.claim)
    if settings.criterion == "equilibrium":
        found = StabilityOracle(assembly, settings).margins(states, ("held",))
        return [[{load.part: np.concatenate([load.force, load.moment]) for load in state.held} for state in found]]
    cases = [replace(settings, reserve=reserve) for reserve in sorted({settings.reserve, 1.0})]
    return [_built(plan, assembly, case) for case in cases]


def _built(plan: Plan, assembly: Assembly, settings: StabilitySettings) -> _Borne:
    """Return what robots bear as a plan is built under some settings, up to where it does not come to rest."""
    verifier, borne = BuildVerifier(assembly, settings.claim), [dict[int, Array]() for _ in plan.states]
    steps = Replayer(assembly, settings).certificates(plan.states, plan.presses_before)
    for row, (state, step) in enumerate(zip(plan.states, steps, strict=False)):
        wrenches = verifier.step(state, step).wrenches
        parts = np.flatnonzero((state == HELD) & ~assembly.immovable).tolist()
        borne[row] = {part: wrenches[part] for part in parts}
    return borne


def overloads(loads: list[GripLoad], plan: RobotPlan, cell: Cell) -> list[PlanProblem]:
    """Return the loads beyond the force or moment that a gripper bears, and holds whose load is unknown there."""
    problems, known = [], {(load.keyframe, load.robot) for load in loads if not load.presses}
    for number, frame in enumerate(plan.keyframes):
        for robot, part in enumerate(frame.held):
            if part is not None and cell.robots[robot].gripper.has_limits and (number, robot) not in known:
                said = f"what holding {plan.plan.part_names[part]} takes is unknown: the state is not stable"
                problems.append(PlanProblem(max(number - 1, 0), cell.robots[robot].name, said))
    for load in loads:
        if fault := load.fault(plan, cell):
            problems.append(PlanProblem(max(load.keyframe - 1, 0), cell.robots[load.robot].name, fault))
    return problems


def heaviest(loads: list[GripLoad], robot: int) -> tuple[GripLoad, GripLoad] | None:
    """Return the loads of a robot with the largest force and the largest moment; None if it holds nothing."""
    mine = [load for load in loads if load.robot == robot and not load.presses]
    if not mine:
        return None
    return max(mine, key=lambda load: load.force_n), max(mine, key=lambda load: load.moment_nm)
