"""Loads of robots: parts in their grippers, in transits too, and parts put down to be gripped in another way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from falsework.assembly.state import HELD, INSTALLED, REMOVED
from falsework.robots.model.cell import CellRobot
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.problem.task import Direction

LoadKey = tuple[int, bytes, bytes]
_RIGID = 1e-6
"""Largest error of a rotation matrix."""


@dataclass(frozen=True, eq=False)
class Load:
    """Part that a robot carries, or has put down on the way."""

    part: int
    grip: Array | None
    """Configuration in which the robot grips the part at `pose`, shape (joints,); None: the part lies there."""
    pose: Array
    """Displacement of the part from its place in the structure, shape (4, 4)."""

    @property
    def lies(self) -> bool:
        """Whether the part is not in the gripper."""
        return self.grip is None

    def at(self, robot: CellRobot, values: Array) -> Array:
        """Return the displacement of the part when its robot has joint values of shape (joints,), shape (4, 4)."""
        from falsework.robots.kinematics.forward import tool_pose  # loads compiled code

        return self.pose if self.grip is None else tool_pose(robot, values) @ self.in_tool(robot)

    def in_tool(self, robot: CellRobot) -> Array:
        """Return the pose of the part in the tool frame of the robot that grips it, shape (4, 4)."""
        from falsework.robots.kinematics.forward import tool_pose

        assert self.grip is not None
        return inverse_pose(tool_pose(robot, self.grip)) @ self.pose

    def in_flange(self, robot: CellRobot) -> Array:
        """Return the pose of the part in the frame of the flange of the robot that grips it, shape (4, 4)."""
        from falsework.robots.kinematics.forward import flange_pose

        assert self.grip is not None
        return inverse_pose(flange_pose(robot.model, self.grip, robot.base)) @ self.pose

    @property
    def key(self) -> LoadKey:
        """Key that is equal for equal loads."""
        return self.part, b"" if self.grip is None else self.grip.tobytes(), self.pose.tobytes()


def load_of(plan: RobotPlan, step: int, motion: int | None, robot: int | None = None) -> Load | None:
    """Return the load of a robot in a motion of a step, None an action of its gripper; None without a load.

    The robot is by default that of the step, or another one that moves at the same instant.
    """
    entry = plan.steps[step]
    robot = entry.robot if robot is None else robot
    part = plan.part_of(step, robot)
    if entry.transit and motion is not None and (carried := entry.of(robot)[motion].part) is not None:
        if entry.gripped is not None:
            return Load(carried, entry.gripped, np.eye(4))
        return Load(carried, *taken_with(plan, step, robot, carried))
    if entry.transit and motion is None and (left := plan.keyframes[step].load(robot)) is not None:
        place = step if plan.direction is Direction.DISASSEMBLY else step - 1
        return Load(left, *taken_with(plan, place, robot, left))  # until the gripper opens
    if motion is None or part is None:
        return None
    apart = plan.direction is Direction.DISASSEMBLY
    lying = lying_motions(plan, step)
    if motion in lying:
        assert entry.put_down is not None
        return Load(part, None, entry.put_down)
    if entry.of(robot)[motion].part is None:
        return None
    if not lying or (motion < lying.start) == apart:
        return Load(part, *taken_with(plan, step, robot, part))
    assert entry.put_down is not None
    first, last = entry.trajectories[lying.start], entry.trajectories[lying.stop - 1]
    return Load(part, last.positions[-1] if apart else first.positions[0], entry.put_down)


def taken_with(plan: RobotPlan, step: int, robot: int, part: int) -> tuple[Array, Array]:
    """Return how a robot takes a part that it carries in a step, or in assembly lets go of it later.

    Returns:
        Its configuration, shape (joints,), and the displacement of the part from its place then, shape (4, 4).
    """
    apart, home = plan.direction is Direction.DISASSEMBLY, np.eye(4)
    frames = plan.keyframes[step::-1] if apart else plan.keyframes[step + 1 :]
    last = frames[0]
    for frame in frames:
        if frame.held[robot] == part:
            return frame.configurations[robot], home
        if frame.load(robot) != part:  # until then, or from then on, it waits
            return last.configurations[robot], dict(frame.waits).get(part, home)
        last = frame
    return frames[0].configurations[robot], home


def load_at_rest(
    plan: RobotPlan, robot: int, last: tuple[int, int | None] | None, following: tuple[int, int | None] | None
) -> Load | None:
    """Return the load of a robot that rests between two motions or actions of its gripper; None without one.

    `last` and `following` are a step and its trajectory, None an action of the gripper; None at the start, at the end.
    """
    if following is None:
        return None if last is None or plan.keyframes[-1].load(robot) is None else load_of(plan, *last, robot)
    on_way = last is not None and last[0] == following[0]
    carries = on_way or plan.keyframes[following[0]].load(robot) is not None
    return load_of(plan, *following, robot) if carries else None


def loads_at(plan: RobotPlan, keyframe: int) -> dict[int, Load]:
    """Return the parts that robots carry at a keyframe, by robot."""
    found = {}
    for robot in range(len(plan.robots)):
        if plan.keyframes[keyframe].load(robot) is None:
            continue
        own = [k for k, entry in enumerate(plan.steps) if robot in entry.robots and entry.trajectories]
        later = [(k, None if plan.grip(k) == "open" else 0) for k in own if k >= keyframe][:1]
        place = later or [(k, len(plan.steps[k].trajectories) - 1) for k in own][-1:]
        load = load_of(plan, *place[0], robot) if place else None
        if load is not None:
            found[robot] = load
    return found


def lying_motions(plan: RobotPlan, step: int) -> range:
    """Return the motions of a step in which its part lies where it was put down; empty where it is not put down."""
    entry = plan.steps[step]
    if entry.put_down is None:
        return range(0)
    empty = [number for number, trajectory in enumerate(entry.trajectories) if trajectory.part is None]
    return range(empty[0], empty[-1] + 1) if empty else range(0)


def step_fault(plan: RobotPlan, step: int) -> str:
    """Return why a step is not the hand-over, transit, or action with a part put down that it says; empty if it is."""
    faults = partner_fault, hand_over_fault, put_down_fault, transit_fault
    return next((found for fault in faults if (found := fault(plan, step))), "")


def partner_fault(plan: RobotPlan, step: int) -> str:
    """Return why several robots cannot move their parts at the same instant as a step says; empty if they can."""
    entry = plan.steps[step]
    here, there = plan.states[step : step + 2] != REMOVED
    aside = moved_aside(plan, step)
    parts = {*np.flatnonzero(here != there).tolist(), *aside.values()}
    if not entry.partners:
        return "" if len(parts) <= 1 else "it moves several parts with one robot"
    if entry.hands_over is not None or entry.put_down is not None or not parts:
        return "several robots move at the same instant although no parts leave the structure or come to it"
    if len(set(entry.robots)) < len(entry.robots):
        return "a robot moves twice at the same instant"
    if {aside.get(robot, plan.part_of(step, robot)) for robot in entry.robots} != parts:
        return "its robots do not move one each of the parts that leave or come"
    for partner in entry.partners:
        if [*map(_clock, partner.trajectories)] != [*map(_clock, entry.trajectories)]:
            return (
                f"{plan.robots[partner.robot].name} does not move at the same times as {plan.robots[entry.robot].name}"
            )
    if any(leg.kind != "line" for robot in entry.robots for leg in entry.of(robot)):
        return "its robots move at the same instant although they are clear of the structure"
    return ""


def moved_aside(plan: RobotPlan, step: int) -> dict[int, int]:
    """Return the parts of the structure that a transit moves from their places, on, or back, by robot."""
    entry, parts = plan.steps[step], {**plan.aside(step), **plan.aside(step + 1)}
    if plan.grip(step) is not None:
        return {}
    return {robot: parts[robot] for robot in entry.robots if entry.transit and robot in parts}


def _clock(trajectory: Trajectory) -> list[float]:
    return np.round(trajectory.times, 9).tolist()


def hand_over_fault(plan: RobotPlan, step: int) -> str:
    """Return why a step is not half of a hand-over, though it says so; empty if it is one, or does not say so."""
    entry, part = plan.steps[step], plan.steps[step].hands_over
    if part is None:
        return ""
    name, before, after = plan.plan.part_names[part], plan.keyframes[step].held, plan.keyframes[step + 1].held
    if plan.states[step][part] != HELD or part not in before:
        return f"{name} is handed over although it is not held"
    mine, others = before[entry.robot], sum(held == part for held in before) - (before[entry.robot] == part)
    if mine is not None and mine != part:
        return f"{name} is handed over to a robot that holds {plan.plan.part_names[mine]}"
    if not others:
        return f"{name} is left before another robot holds it"
    others_stay = all(k == entry.robot or old == new for k, (old, new) in enumerate(zip(before, after, strict=True)))
    if after[entry.robot] != (part if mine is None else None) or not others_stay:
        return f"one robot must take {name} over or leave it, and no other held part change"
    # The other half: left at once after it was taken over, and taken over just before it is left.
    other = step + 1 if mine is None else step - 1
    if not 0 <= other < len(plan.steps) or plan.steps[other].hands_over != part:
        return f"{name} is held by two robots other than between the two steps of a hand-over"
    if plan.steps[other].robot == entry.robot or others > 1:
        return f"{name} is not left by the robot that held it before"
    return ""


def put_down_fault(plan: RobotPlan, step: int) -> str:
    """Return why the part of a step cannot be put down as the step says; empty if it can, or is not.

    Whether it is at rest there, and where the grippers are, needs the cell; see `check_robot_plan`.
    """
    entry, part = plan.steps[step], int(plan.actions[step]) - len(plan.plan.boundary)
    pose, lying = entry.put_down, lying_motions(plan, step)
    if pose is None:
        return ""
    if part < 0 or entry.hands_over is not None:
        return "a part is put down although it neither leaves the structure nor comes to it"
    name = plan.plan.part_names[part]
    if not is_rigid(pose):
        return f"{name} is put down with a pose that is not rigid"
    motions = entry.trajectories
    if len(lying) < 2 or lying.start == 0 or lying.stop == len(motions):
        return f"{name} is put down, but its robot does not carry it, leave it and carry it on"
    if any(motions[k].part is not None for k in lying):
        return f"{name} is put down more than once"
    if any(motions[k].kind != "line" or motions[k].touches != part for k in (lying.start, lying.stop - 1)):
        return f"the gripper must leave {name}, and take it again, on a line on which it may touch it"
    if any(motions[k].kind != "line" for k in (lying.start - 1, lying.stop)):
        return f"{name} must be put down, and lifted again, on a line"
    return ""


def is_rigid(pose: Array) -> bool:
    """Return whether a matrix of shape (4, 4) is a rotation and a displacement."""
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() <= _RIGID and np.linalg.det(turn) > 0
    return bool(rigid and np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)))


def waiting_fault(plan: RobotPlan, step: int) -> str:
    """Return why parts cannot wait as the keyframes around a step say, nor a robot take or let go of one in it."""
    entry, names, robot = plan.steps[step], plan.plan.part_names, plan.steps[step].robot
    before, after = (dict(plan.keyframes[k].waits) for k in (step, step + 1))
    for k, waits in ((step, before), (step + 1, after)):
        for part, pose in waits.items():
            there = plan.states[k][part] != REMOVED and not plan.plan.immovable[part] and plan.plan.waiting
            if not there or part in plan.in_hand(k) or not is_rigid(pose):
                return f"{names[part]} cannot wait half way out as a keyframe says"
    changed = {
        part
        for part in before | after
        if not (part in before and part in after and (before[part] == after[part]).all())
    }
    if not entry.transit or plan.grip(step) is None:
        if not changed:
            return ""
        return f"{names[min(changed)]} comes to wait, or goes on, although no gripper takes it or lets go of it"
    closes, hands = plan.grip(step) == "close", (plan.in_hand(step), plan.in_hand(step + 1))
    part, line = hands[closes][robot], entry.trajectories[-1 if closes else 0] if entry.trajectories else None
    others = any(a != b for k, (a, b) in enumerate(zip(*hands, strict=True)) if k != robot)
    bare = not entry.partners and entry.gripped is None and all(leg.part is None for leg in entry.trajectories)
    if others or not bare or changed - {part} or line is None or (line.kind, line.touches) != ("line", part):
        return "a part that waits is taken, or let go of, otherwise than on a line of the one robot that touches it"
    return ""


def transit_fault(plan: RobotPlan, step: int) -> str:
    """Return why a step is no transit, though it says so, or carries a part otherwise than the keyframes say."""
    entry, before, after = plan.steps[step], plan.keyframes[step], plan.keyframes[step + 1]
    for robot in range(len(plan.robots)):
        old, new = before.load(robot), after.load(robot)
        if old != new and robot not in entry.robots:
            return f"{plan.robots[robot].name} comes to carry another part without a motion"
        for k, part in ((step, old), (step + 1, new)):
            if part is None:
                continue
            fixed = (plan.states[k][part] == INSTALLED and not plan.plan.waiting) or plan.plan.immovable[part]
            if fixed or plan.keyframes[k].held[robot] is not None:
                return f"{plan.robots[robot].name} carries a part that is in place, or holds another one"
    if fault := waiting_fault(plan, step):
        return fault
    removal, ends, parts = int(plan.actions[step]) >= len(plan.plan.boundary), (None, None), list[int | None]()
    if entry.transit and plan.grip(step) is not None:
        return ""
    for robot in entry.robots[::-1]:  # the first one last: of a transit more is said below
        ends, parts = (before.load(robot), after.load(robot)), [leg.part for leg in entry.of(robot)]
        if ends != (None, None) and not (entry.transit or removal):
            return "a robot that carries a part can neither hold nor release one"
        if any(end is not None and part != end for end, part in zip(ends, (*parts[:1], *parts[-1:]), strict=False)):
            return "the part that its robot carries at the keyframe is not in its gripper in the motion"
    if not entry.transit:
        return "" if entry.gripped is None else "it has a grip of a part although it is no transit"
    carried = {part for part in (*parts, *ends) if part is not None}
    if entry.hands_over is not None or entry.put_down is not None or not parts:
        return "a transit is motions only, without a part handed over or put down"
    if aside := moved_aside(plan, step):
        lines = [(leg.kind, leg.part) for robot in entry.robots for leg in entry.of(robot)]
        kept = plan.in_hand(step) == plan.in_hand(step + 1) and entry.gripped is None
        if kept and lines == [("line", aside.get(robot)) for robot in entry.robots]:
            return ""
        return "a held part is moved aside, or back, otherwise than in one line of the robot that holds it"
    if before.held != after.held or before.held[entry.robot] is not None:
        return "its robot must hold no part, and no held part change"
    if len(carried) > 1 or (entry.gripped is None) == bool(carried):
        return "a transit carries one part with a grip, or none without"
    if any(leg.part is not None and leg.kind == "line" for leg in entry.trajectories):
        return "a part is carried on a line although it is neither inserted nor removed"
    return ""
