"""Verification of robot plans: motions sampled finely and checked by libraries that share no code with the planner."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED
from falsework.errors import CellError, InputError
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.cells.validate import check_bases
from falsework.robots.checks.delays import DelayReport, check_delays
from falsework.robots.checks.descriptions import description_fault
from falsework.robots.checks.grips import GripChecker
from falsework.robots.checks.handling import HandlingChecker, hand_faults, place_lines, put_down_faults
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import CellScale
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import Array
from falsework.robots.plans.loads import load_of, loads_at, moved_aside, step_fault
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.robot_forces import GripLoad, grip_loads, overloads, press_fault
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.trajectory import JOINS, OUTSIDE, check_limits
from falsework.search.plans.plan_report import PlanReport
from falsework.search.problem.task import Direction
from falsework.utils.quantity import counted, format_number

Progress = Callable[[int, int], None]


_OVERLAP = 0.001
"""Allowed overlap of a part with its neighbours as it leaves or reaches its place, metres; where the structure's
own meshes overlap by more at that place, this is doubled until they do not."""
_MAX_PROBLEMS = 20
"""Number of problems after which the check stops."""


@dataclass(frozen=True)
class CheckReport:
    """Result of a check."""

    problems: tuple[PlanProblem, ...]
    samples: int
    """Number of configurations that were checked for collisions."""
    trajectories: int
    largest_step: float
    """Largest difference of a joint between neighbouring samples, rad or m."""
    largest_join: float
    """Largest jump of a joint between the end of one motion and the start of the next, rad or m."""
    velocity_share: float
    """Largest speed of a joint as a share of the limit in the cell."""
    acceleration_share: float
    tolerance: float
    """Largest amount by which a part was shrunk where it leaves or arrives, metres."""
    links: dict[str, Literal["meshes", "convex pieces"]]
    """Geometry that the links of each robot were checked with: the meshes of its description, or the convex pieces of a
    built-in arm."""
    seconds: float
    """Duration of the check."""
    delays: DelayReport | None = None
    """Check of the schedule under any delays; None without a schedule, or where the check had stopped before."""
    loads: tuple[GripLoad, ...] | None = None
    """Loads on grippers that hold parts in place; None in a cell whose grippers have no limits of force and moment."""
    lower_bound: float | None = None
    """Proven lower bound on the makespan, the work of the busiest arm, seconds; None without a schedule. That of the
    plan itself may be larger, and is not checked."""

    states: PlanReport | None = None
    """Check of the stability of the states, where it was made."""

    def __repr__(self) -> str:
        unstable = "" if self.states is None else self.states.reason
        fine = f"no problem in {counted(self.samples, 'configuration')}"
        return f"<CheckReport: {self.problems[0] if self.problems else unstable or fine}>"

    @property
    def good(self) -> bool:
        """Whether no problem was found."""
        return not self.problems and (self.states is None or self.states.good)


class _Checker:
    """Walk through a plan that collects problems."""

    def __init__(self, plan: RobotPlan, assembly: Assembly, cell: Cell, resolution: float) -> None:
        self.plan, self.cell, self.resolution = plan, cell, resolution
        parts = place_parts(assembly, cell.placement)
        self.judge = PinocchioCollisionChecker(cell, parts, _OVERLAP)
        self.grips = GripChecker(cell, self.judge)
        self.handling = HandlingChecker(plan, cell, self.grips)
        self.boundary = assembly.boundary
        self.problems: list[PlanProblem] = []
        self.samples = self.trajectories = 0
        self.largest_step = self.largest_join = self.velocity = self.acceleration = 0.0

    def full(self) -> bool:
        return len(self.problems) >= _MAX_PROBLEMS

    def say(self, step: int, robot: int, what: str, **more) -> None:
        self.problems.append(PlanProblem(step, self.cell.robots[robot].name, what, **more))

    def keyframe(self, index: int) -> None:
        """Check that the robots hold exactly the held parts of the state, and touch them."""
        state, frame = self.plan.states[index], self.plan.keyframes[index]
        step = min(index, len(self.plan) - 1)
        held = [part for part in self.plan.in_hand(index) if part is not None]
        if 0 < index < len(self.plan):
            handed = self.plan.steps[index - 1].hands_over
            if handed is not None and held.count(handed) == 2 and handed == self.plan.steps[index].hands_over:
                held.remove(handed)  # between the two steps of a hand-over two robots hold the part
        wanted = {*np.flatnonzero((state == HELD) & ~self.boundary).tolist()} - dict(frame.waits).keys()
        wanted |= {part for part in self.plan.aside(index).values() if state[part] == INSTALLED}  # of which ways know
        if sorted(held) != sorted(wanted):
            self.say(step, 0, f"the robots hold parts {sorted(held)}, the state has {sorted(wanted)} held")
        for robot, part in enumerate(frame.held):
            if part is None:
                continue
            if fault := self.grips.fault(robot, frame.configurations[robot], part):
                self.say(step, robot, f"{fault}, which it should hold")

    def surroundings(self) -> None:
        """Check that bases stand free, and that robots are those that their descriptions describe."""
        try:
            check_bases(self.cell, self.judge.parts)
        except CellError as error:
            self.say(0, 0, str(error))
        for robot, entry in enumerate(self.cell.robots):
            if fault := description_fault(entry.model):
                self.say(0, robot, fault)

    def limits(self) -> bool:
        """Check limits and durations of all motions by arithmetic; return whether all of them may be sampled."""
        bounded = True
        for index, robot, trajectory in self.plan.moves():
            found = check_limits(trajectory, self.cell.robots[robot].model, self.cell.speed)
            self.velocity = max(self.velocity, found.velocity_share)
            self.acceleration = max(self.acceleration, found.acceleration_share)
            bounded &= found.bounded
            for fault in found.faults if not self.full() else ():
                self.say(index, robot, fault)
        return bounded

    def step(self, index: int) -> None:
        """Check one action: contents, continuity, limits, collisions."""
        before, after = self.plan.keyframes[index], self.plan.keyframes[index + 1]
        step = self.plan.steps[index]
        robot, present = step.robot, self.plan.resting(index)
        if fault := step_fault(self.plan, index):
            self.say(index, robot, fault)
            if step.transit or step.partners:
                return
        elif step.gripped is not None:
            self._gripped(index, step.gripped)
        elif step.put_down is not None:
            for fault, pair in put_down_faults(self.plan, index, self.grips, present):
                self.say(index, robot, fault, pair=pair)
        if fault := press_fault(self.plan, index):
            self.say(index, robot, fault)
        takes = step.transit and self.plan.grip(index) is not None
        if takes:
            for fault in hand_faults(self.plan, index, self.grips):
                self.say(index, robot, fault)
        for fault in self.handling.faults(index):
            self.say(index, robot, fault)
        hands = self.plan.in_hand(index), self.plan.in_hand(index + 1)
        for other, (old, new) in enumerate(zip(*hands, strict=True)):
            if (old != new) != (other in step.robots and (takes or not step.transit)):
                self.say(index, other, "its held part does not change according to the action")
        values = [*before.configurations]
        for order in range(len(step.trajectories)):
            for robot in step.robots:
                if self.full():
                    return
                trajectory = step.of(robot)[order]
                self._content(index, order, robot)
                self._joins(index, robot, values[robot], trajectory.positions[0])
                values[robot] = trajectory.positions[-1]
                self._collisions(index, order, robot, present)
        for robot, (here, there) in enumerate(zip(values, after.configurations, strict=True)):
            self._joins(index, robot, here, there)

    def at_rest(self, index: int, when: str) -> None:
        """Check that the configurations of the first or the last keyframe are within limits, and free of collisions."""
        frame, present = self.plan.keyframes[index], self.plan.standing[index]
        loads = loads_at(self.plan, index)
        for robot, values in enumerate(frame.configurations):
            if not self.cell.robots[robot].model.within_limits(values, OUTSIDE):
                self.say(min(index, len(self.plan) - 1), robot, f"at the {when} a joint is outside its limits")
            others = {other: load for other, load in loads.items() if other != robot}
            given = {"touches": frame.held[robot], "load": loads.get(robot), "loads": others}
            move = self.judge.prepare(robot, frame.configurations, present, **given, waits=dict(frame.waits))
            pair = move.hits(values)
            if pair is not None:
                step = min(index, len(self.plan) - 1)
                self.say(step, robot, f"at the {when} {pair[0]} collides with {pair[1]}", pair=pair)

    def _content(self, index: int, order: int, robot: int) -> None:
        """Check that a removal always carries its part, and a hold carries none and touches it only on the line.

        A part that was put down is not carried, and may be touched on the lines too.
        """
        step, action, moved = self.plan.steps[index], int(self.plan.actions[index]), self.plan.part_of(index, robot)
        trajectory, load = step.of(robot)[order], load_of(self.plan, index, order, robot)
        if step.transit:  # of which `step_fault` has checked the parts
            if trajectory.touches is not None and trajectory.kind != "line":
                self.say(index, robot, f"motion {order + 1} may not touch part {trajectory.touches}")
            return
        removes = moved is not None and (load is None or not load.lies)
        part = action if moved is None else moved
        wanted = part if removes else None
        if trajectory.part != wanted:
            self.say(index, robot, f"motion {order + 1} carries part {trajectory.part}, the action needs {wanted}")
        if trajectory.touches is not None and (removes or trajectory.touches != part or trajectory.kind != "line"):
            self.say(index, robot, f"motion {order + 1} may not touch part {trajectory.touches}")

    def _gripped(self, index: int, values: Array) -> None:
        """Check that the gripper is at a part that it carries in a transit."""
        robot = self.plan.steps[index].robot
        part = next(leg.part for leg in self.plan.steps[index].trajectories if leg.part is not None)
        if fault := self.grips.fault(robot, values, part):
            self.say(index, robot, f"{fault}, which it should carry")

    def _joins(self, index: int, robot: int, here: Array, there: Array) -> None:
        far = float(np.abs(here - there).max())
        self.largest_join = max(self.largest_join, far)
        if far > JOINS:
            self.say(index, robot, f"it jumps by {format_number(far, 4)} rad between two motions")

    def _collisions(self, index: int, order: int, robot: int, present: NDArray[np.bool_]) -> None:
        step, at_place = self.plan.steps[index], order in place_lines(self.plan, index, robot)
        trajectory, load = step.of(robot)[order], load_of(self.plan, index, order, robot)
        moments, samples = trajectory.dense(self.resolution)
        beside = [other for other in step.robots if other != robot]
        if beside:  # sampled where any of them has a sample
            moments = np.unique(np.concatenate([step.of(r)[order].dense(self.resolution)[0] for r in step.robots]))
            samples = trajectory.sample(moments)
        with_them = {other: step.of(other)[order].sample(moments) for other in beside}
        self.samples += len(samples)
        self.trajectories += 1
        if len(samples) > 1:
            self.largest_step = max(self.largest_step, float(np.abs(np.diff(samples, axis=0)).max()))
        model = self.cell.robots[robot].model
        outside = ~model.within_limits(samples, OUTSIDE)
        if outside.any():
            row = int(np.argmax(outside))
            beyond = np.maximum(samples[row] - model.upper, model.lower - samples[row])
            what = f"{model.joint_names[int(np.argmax(beyond))]} is outside its limits"
            self.say(index, robot, what, seconds=float(moments[row]), configuration=tuple(samples[row].tolist()))
        loads = {other: held for other, held in loads_at(self.plan, index).items() if other not in step.robots}
        loads |= {other: held for other in beside if (held := load_of(self.plan, index, order, other)) is not None}
        given = {"load": load, "touches": trajectory.touches, "loads": loads, "waits": self.plan.waiting(index)}
        rest = self.plan.keyframes[index].configurations
        move = self.judge.prepare(robot, rest, present, at_place=at_place, **given)
        tried = [(move, row) for row in range(len(samples))]
        apart = self.plan.direction is Direction.DISASSEMBLY
        last = len(step.trajectories) - 1 if apart else 0
        if at_place and order == last and not moved_aside(self.plan, index):
            # Beyond its last line a part has its full size; so it has where it leaves the gripper, or waits in it.
            tried.append((self.judge.prepare(robot, rest, present, **given), len(samples) - 1 if apart else 0))
        for query, row in tried:
            pair = query.hits(samples[row], {other: values[row] for other, values in with_them.items()})
            if pair is not None:
                what = f"{pair[0]} collides with {pair[1]}"
                place = tuple(samples[row].tolist())
                self.say(index, robot, what, pair=pair, seconds=float(moments[row]), configuration=place)
                return


def check_robot_plan(
    plan: RobotPlan, assembly: AnyStructure, cell: AnyCell, *, step: float = 0.01, progress: Progress | None = None
) -> CheckReport:
    """Check all motions of a plan with Pinocchio (kinematics) and Coal (collisions).

    Parts are their meshes, and so are the links of arms from URDF files; links of built-in arms, grippers and obstacles
    are the convex pieces that they are described by.

    Each step moves one robot, or several by one clock. All that moves is checked against all that is fixed, and against
    what moves at the same instant, with these exceptions and no others.
    A schedule is then checked as a whole: all positions that any delays, or none, can lead to, parts carried by other
    robots included, and the order of the states, as `check_delays` describes. In a hand-over the second robot must hold
    the part before the first leaves it; that is part of the order, whatever the delays.

    - neighbouring links, and the pairs that the robot description excludes;
    - a gripper and the last two links of its arm, and a part in a gripper and the last link and the gripper;
    - on an approach or a retreat, the gripper may press into the part that it grips, by `Gripper.press_depth`;
    - on the lines on which a part leaves or reaches its place, is moved aside or back, or put down on the floor on the
      way, the part is shrunk by the tolerance, since it touches its neighbours and the floor. Everywhere else it has
      its full size; while it lies on the floor it is not checked against the floor, on which it must stand on a face.

    Robots, their tools and places, payloads and limits are those of the cell, which the plan must name as they are; the
    facts that are checked are listed in `docs/robot-plan-checks.md`. The stability of the states is not checked here;
    `validate_plan(plan.plan, ...)` does that.

    Args:
        step: largest motion of a joint between two samples, rad or m.
        progress: callback `(done, total)` with numbers of steps.
    """
    if not 0 < step <= 0.5:
        raise InputError(f"a step of {step:g} rad is not positive or too coarse; give up to 0.5, such as 0.01")
    assembly, cell = as_assembly(assembly), as_cell(cell)
    plan.check_identity(assembly, cell)
    CellScale.from_cell(assembly, cell)  # which refuses a cell in which other states are stable
    began = time.perf_counter()
    checker = _Checker(plan, assembly, cell, step)
    checker.surroundings()
    if not len(plan):
        checker.say(0, 0, "the plan has no steps, so that nothing is checked")
    bounded = checker.limits()
    if bounded:
        checker.at_rest(0, "start")
    for index in range(len(plan)) if bounded else ():
        if checker.full():
            break
        checker.keyframe(index)
        checker.step(index)
        if progress is not None:
            progress(index + 1, len(plan))
    loads = None
    if bounded:
        checker.keyframe(len(plan))
        checker.at_rest(len(plan), "end")
        if any(robot.gripper.has_limits for robot in cell.robots):
            loads = tuple(grip_loads(plan, assembly, cell))
            checker.problems += overloads(list(loads), plan, cell)
    delays = None
    in_step = not any(step.partners and step_fault(plan, index) for index, step in enumerate(plan.steps))
    if plan.schedule is not None and bounded and in_step and not checker.full():
        delays = check_delays(plan, checker.judge, most=_MAX_PROBLEMS)
        checker.problems += delays.problems
    return CheckReport(
        tuple(checker.problems),
        checker.samples,
        checker.trajectories,
        checker.largest_step,
        checker.largest_join,
        checker.velocity,
        checker.acceleration,
        checker.judge.slack,
        {robot.name: "convex pieces" if robot.model.meshes is None else "meshes" for robot in cell.robots},
        time.perf_counter() - began,
        delays,
        loads,
        None if plan.schedule is None else plan.schedule.busiest,
    )
