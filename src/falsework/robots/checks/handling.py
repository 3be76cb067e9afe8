"""Check of where parts change hands: a robot takes or leaves a part at its place in the structure or one of the cell.

Between these places it carries the part. One that is put down on the way lies free and at rest on the floor, where
its robot has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from shapely import MultiPoint, Point, Polygon

from falsework.geometry.arrays import apply
from falsework.robots.checks.grips import GripChecker
from falsework.robots.model.cell import LONGEST_APPROACH, LONGEST_WITHDRAWAL, Cell
from falsework.robots.model.part_shapes import placed_move
from falsework.robots.model.shapes import Array, inverse_pose
from falsework.robots.plans.loads import Load, load_of, loads_at, lying_motions, moved_aside
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.trajectory import line_fault, move_fault
from falsework.robots.plans.ways import moves_of_steps
from falsework.search.problem.task import Direction
from falsework.utils.quantity import format_quantity

_PLACE_DISTANCE = 0.001
"""Largest distance of a tool frame from a place of the cell, metres."""
_PLACE_TILT = 0.01
"""Largest angle between z of both, rad; about it a part may be turned in any way."""
_AWAY = 0.001
"""Distance by which a part that has left its place is at least displaced, metres."""
_HEAVIER = 1e-6
"""Share by which a rounded mass may exceed a payload."""
_NEAR = 0.001
"""Largest distance of a part from the floor, and from where its robot has it, metres."""
_STEADY = 0.05
"""Least distance of a centre of mass from the edges of the face that a part stands on, in square roots of its area."""


class HandlingChecker:
    """Places, payloads and lines of the parts that the robots of a plan move."""

    def __init__(self, plan: RobotPlan, cell: Cell, grips: GripChecker) -> None:
        self.plan, self.cell, self.grips = plan, cell, grips
        self.names, self.mass = grips.judge.parts.names, grips.judge.parts.mass
        self._moves, self.wrong = moves_of_steps(plan)
        """Moves of each step in the structure's frame, and what is wrong with those of some steps."""

    def faults(self, index: int) -> list[str]:
        """Return what is wrong with how a step moves its part, where it takes and leaves it, and with its lines."""
        checks = self._places, self._payload, self._lines
        found = [what for step, what in self.wrong if step == index]
        robots = self.plan.steps[index].robots
        return [*found, *(fault for robot in robots for check in checks for fault in check(index, robot))]

    def _places(self, index: int, robot: int) -> list[str]:
        """Return where a part comes into or leaves the gripper although neither the structure nor the cell has it."""
        plan, legs = self.plan, self.plan.steps[index].of(robot)
        part, before, after = self._ends(index, robot)
        if part is None:
            return []
        has = [before, *(leg.part is not None for leg in legs), after]
        where = [leg.positions[0] for leg in legs] + [plan.keyframes[index + 1].configurations[robot]]
        lying, faults = lying_motions(plan, index), []
        if plan.part_of(index, robot) is not None and self._stays(index, robot, part):
            faults.append(f"{self.names[part]} does not {'leave' if before else 'come to'} its place")
        for change, (old, new) in enumerate(pairwise(has)):
            if old == new or (lying and change in (lying.start, lying.stop)):
                continue
            fault = self._no_place(robot, where[change])
            if fault:
                does = "comes into the gripper" if new else "is let go of"
                faults.append(f"{self.names[part]} {does} {fault}, which is no place of the cell")
        return faults

    def _ends(self, index: int, robot: int) -> tuple[int | None, bool, bool]:
        """Return the part that a robot moves, and whether it is in the gripper before and after the step."""
        plan, step = self.plan, self.plan.steps[index]
        before, after = (plan.keyframes[k].load(robot) for k in (index, index + 1))
        moved = plan.part_of(index, robot)
        if moved is not None:  # in place it is in the gripper
            apart = plan.direction is Direction.DISASSEMBLY
            return moved, apart or before is not None, not apart or after is not None
        if aside := moved_aside(plan, index):
            return aside.get(robot), True, True
        if step.transit and plan.grip(index) is not None:  # where the part stands, or waits
            return None, False, False
        carried = [part for part in (before, *(leg.part for leg in step.trajectories), after) if part is not None]
        return (carried[0] if carried and step.transit else None), before is not None, after is not None

    def _stays(self, index: int, robot: int, part: int) -> bool:
        """Return whether the part of a removal, or an insertion, is at its place before as well as after the step."""
        plan = self.plan
        flanges = [self.grips.judge.flange(robot, plan.keyframes[k].configurations[robot]) for k in (index, index + 1)]
        corners = self.grips.judge.parts.meshes[part].vertices
        moved = apply(flanges[1] @ inverse_pose(flanges[0]), corners)
        return float(np.linalg.norm(moved - corners, axis=1).max()) <= _AWAY

    def _no_place(self, robot: int, configuration: Array) -> str:
        """Return where a tool is if that is not at a place of its robot; empty if it is."""
        tool, places = self.grips.tool(robot, configuration), self.cell.robots[robot].places
        far = np.linalg.norm(places[:, :3, 3] - tool[:3, 3], axis=1)
        tilt = np.arccos(np.clip(places[:, :3, 2] @ tool[:3, 2], -1.0, 1.0))
        if ((far <= _PLACE_DISTANCE) & (tilt <= _PLACE_TILT)).any():
            return ""
        at = ", ".join(f"{value:.3f}" for value in tool[:3, 3])
        nearest = f" ({1000 * far.min():.0f} mm from the nearest)" if len(far) else ""
        return f"with the tool at {at}{nearest}"

    def _payload(self, index: int, robot: int) -> list[str]:
        part, payload = self._ends(index, robot)[0], self.cell.robots[robot].payload
        if part is None or self.mass[part] <= payload * (1 + _HEAVIER):
            return []
        return [
            f"{self.names[part]} weighs {format_quantity(self.mass[part], 'mass', 4)}, the payload is "
            f"{format_quantity(payload, 'mass', 4)}"
        ]

    def _lines(self, index: int, robot: int) -> list[str]:
        """Return which motions are called lines and are not, or are where no line may be."""
        step, margin, faults = self.plan.steps[index], self.cell.margins.approach, []
        legs, at_place, run = step.of(robot), place_lines(self.plan, index, robot), 0.0
        grip, last = self.plan.grip(index), len(legs) - 1
        lying = lying_motions(self.plan, index)
        moves = [placed_move(move, self.cell.placement) for move in self._moves.get(index, ())]
        if len(moves) > len(at_place):
            faults.append(f"its way out has {len(moves)} moves, and its part is on {len(at_place)} lines")
        for order, leg in enumerate(legs):
            if leg.kind != "line":
                continue
            _, samples = leg.dense(0.01)
            tools = np.array([self.grips.tool(robot, values) for values in samples])
            carries = leg.part is not None
            number = order if self.plan.direction is Direction.DISASSEMBLY else last - order
            if carries and number < len(moves):  # on a move of its way, the last of which may end early
                way = tools if self.plan.direction is Direction.DISASSEMBLY else tools[::-1]
                if fault := move_fault(way, moves[number], whole=step.transit or number + 1 < len(moves)):
                    faults.append(f"motion {order + 1} {fault}, which is move {number + 1} of its way")
                continue
            longest = margin * (LONGEST_WITHDRAWAL if carries else LONGEST_APPROACH)
            if fault := line_fault(tools, longest if carries or leg.touches is not None else np.inf):
                faults.append(f"motion {order + 1} {fault}")
            if leg.part is not None and order not in at_place:
                name = self.names[leg.part]
                faults.append(f"motion {order + 1} is a line on which {name} neither leaves a place nor reaches one")
            if carries and order in at_place and not (lying and order in (lying.start - 1, lying.stop)):
                run += float(np.linalg.norm(tools[-1, :3, 3] - tools[0, :3, 3]))
            ends = {"close": {last}, "open": {0}}.get(grip or "", {0, last} if step.transit else set())
            ends |= {lying.start, lying.stop - 1} if lying else set()
            if leg.touches is not None and order not in ends:
                name = self.names[leg.touches]
                faults.append(f"motion {order + 1} touches {name} and neither ends at it nor begins there")
        if run > margin * LONGEST_WITHDRAWAL + 0.001:
            faults.append(
                f"its part is on lines for {1000 * run:.0f} mm, which is more than its way to or from a place"
            )
        return faults


def place_lines(plan: RobotPlan, index: int, robot: int) -> frozenset[int]:
    """Return the motions of a robot on which its part leaves or reaches its place, or the floor where it is put down.

    These are lines: the first ones of a removal up to its first other motion, in an insertion the last ones, those
    before and after the part lies on the floor, and those on which a part is moved aside, on, or back.
    """
    if robot in moved_aside(plan, index):
        return frozenset(range(len(plan.steps[index].of(robot))))
    if plan.part_of(index, robot) is None:
        return frozenset()
    apart, legs = plan.direction is Direction.DISASSEMBLY, plan.steps[index].of(robot)
    found = set()
    for order in range(len(legs)) if apart else reversed(range(len(legs))):
        if legs[order].kind != "line" or legs[order].part is None:
            break
        found.add(order)
    lying = lying_motions(plan, index)
    found |= {lying.start - 1, lying.stop} if lying else set()
    return frozenset(order for order in found if load_of(plan, index, order, robot) is not None)


def hand_faults(plan: RobotPlan, index: int, grips: GripChecker) -> Iterator[str]:
    """Yield why a robot does not take a part that stands or waits, or let go of it, where a step has it do so."""
    closes, robot = plan.grip(index) == "close", plan.steps[index].robot
    with_it, without = (index + 1, index) if closes else (index, index + 1)
    part, values = plan.in_hand(with_it)[robot], plan.keyframes[with_it].configurations[robot]
    assert part is not None
    pose = dict(plan.keyframes[without].waits).get(part)
    if fault := grips.fault(robot, values, part, pose):
        yield f"{fault}, which it should take or let go of"
    load, there = loads_at(plan, with_it).get(robot), np.eye(4)
    if load is not None and load.grip is not None:
        there = grips.judge.flange(robot, values) @ inverse_pose(grips.judge.flange(robot, load.grip)) @ load.pose
    yield from _displaced(grips, part, there, np.eye(4) if pose is None else pose, "waits")


def _displaced(grips: GripChecker, part: int, there: Array, pose: Array, does: str) -> Iterator[str]:
    """Yield that a part is not where its robot has it, if it is not."""
    corners, name = grips.judge.parts.meshes[part].vertices, grips.judge.parts.names[part]
    far = float(np.linalg.norm(apply(there, corners) - apply(pose, corners), axis=1).max())
    if far > _NEAR:
        yield f"{name} {does} {1000 * far:.1f} mm away from where its robot has it"


def put_down_faults(
    plan: RobotPlan, index: int, grips: GripChecker, present: NDArray[np.bool_]
) -> Iterator[tuple[str, tuple[str, str] | None]]:
    """Yield why the part of a step does not lie free and at rest on the floor within reach, and which bodies collide.

    Robots beside it are checked with the motions meanwhile.
    """
    step, lying, judge = plan.steps[index], lying_motions(plan, index), grips.judge
    part, pose = int(plan.actions[index]) - len(plan.plan.boundary), step.put_down
    assert pose is not None
    robot, name, apart = step.robot, judge.parts.names[part], plan.direction is Direction.DISASSEMBLY
    ends = step.trajectories[lying.start].positions[0], step.trajectories[lying.stop - 1].positions[-1]
    for values in ends:
        if fault := grips.fault(robot, values, part, pose):
            yield f"{fault}, which lies on the floor", None
    # In the grip in which the part is in its place, it must come to lie there, or be lifted from there.
    there = judge.flange(robot, ends[0 if apart else 1])
    gripped = plan.keyframes[index if apart else index + 1].configurations[robot]
    carried = there @ inverse_pose(judge.flange(robot, gripped))
    corners = judge.parts.meshes[part].vertices
    yield from ((fault, None) for fault in _displaced(grips, part, carried, pose, "lies"))
    other = judge.obstructs(Load(part, None, pose), present)
    if other is not None:
        yield f"{name} is put down in {other}", (f"part {name}", other)
    why = unrest(apply(pose, corners), apply(pose, judge.parts.center[part : part + 1])[0], grips.cell.floor)
    if why:
        yield f"{name} does not rest where it is put down: {why}", None


def unrest(corners: Array, center: Array, floor: float | None) -> str:
    """Return why a part would not rest on a floor at a height, which may be None; empty if it stands on a face."""
    if floor is None:
        return "the cell has no floor"
    gap = float(corners[:, 2].min()) - floor
    if abs(gap) > _NEAR:
        return f"it is {1000 * abs(gap):.1f} mm {'above' if gap > 0 else 'below'} the floor"
    base = MultiPoint(corners[corners[:, 2] < floor + _NEAR, :2]).convex_hull
    if not isinstance(base, Polygon) or base.area <= 0:
        return "it stands on an edge or a corner"
    inside = base.contains(Point(center[:2]))
    if not inside or base.exterior.distance(Point(center[:2])) < _STEADY * np.sqrt(base.area):
        return "its centre of mass is not well above the face that it stands on"
    return ""
