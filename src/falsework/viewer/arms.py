"""Poses of arms, grippers and carried parts at any time of a robot plan, in the frame of the structure.

A cell may build a structure at another size and place; here everything is taken back to the structure as it is, so
that arms can be drawn beside parts that never move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD
from falsework.geometry.arrays import apply, box_around
from falsework.robots.cells.visuals import VisualShape, arm_frames, link_visuals, shapes_of
from falsework.robots.plans.timeline import activities_at, waiting_at
from falsework.search.plans.steps import NO_ROBOT
from falsework.search.problem.task import Direction
from falsework.viewer.appearance import Appearance
from falsework.viewer.clock import Clock
from falsework.viewer.palette import INSTALLED, robot_color, unit_rgb
from falsework.viewer.pictures.render import ColoredSolid

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.model.cell import Cell, CellRobot
    from falsework.robots.plans.robot_plan import RobotPlan

Array = NDArray[np.float64]

TINT = 0.22
"""Share of the colour of a robot in that of its links; its gripper has the whole of it."""


@dataclass(frozen=True, eq=False)
class Link:
    """One rigid piece of a robot."""

    robot: int
    frame: int
    """Link of the robot, 0 for the base; the gripper comes after the last."""
    vertices: Array
    """In its own frame, in lengths of the structure, shape (vertices, 3)."""
    faces: NDArray[np.int64]
    """Shape (faces, 3)."""
    color: tuple[float, float, float]
    """Red, green, blue from 0 to 1."""


@dataclass(frozen=True, eq=False)
class CarriedPart:
    """Part on its way in a gripper, or put down on the way, or waiting there."""

    part: int
    robot: int
    """Robot that carries it, or has put it down; `NO_ROBOT` of one that waits."""
    pose: Array
    """From the place of the part to where it is, shape (4, 4)."""

    @property
    def color(self) -> str:
        """Colour of that robot."""
        return INSTALLED if self.robot == NO_ROBOT else robot_color(self.robot)


@dataclass(frozen=True, eq=False)
class ArmPoses:
    """Poses of all arms at one time."""

    poses: Array
    """Of every link in the frame of the structure, rotation and translation, shape (links, 4, 4)."""
    carried: tuple[CarriedPart, ...] = ()


class Arms:
    """All robots of a robot plan, moving with its steps."""

    def __init__(self, robot_plan: RobotPlan, cell: Cell, direction: Direction) -> None:
        """Prepare the links."""
        self.cell = cell
        self.direction = direction
        self.plan = robot_plan if robot_plan.direction is direction else robot_plan.reverse()
        """The plan in the order shown."""
        scale = cell.placement.scale
        self._to_structure = _similar(cell.placement.pose, scale)
        self.scale = scale
        self.clock = Clock.from_plan(self.plan)
        """Times in the order shown."""
        self.links = [link for number, robot in enumerate(cell.robots) for link in links_of(number, robot, 1 / scale)]

    @property
    def differs(self) -> str:
        """What the cell changes of the structure that forces and masses are shown of; empty if nothing."""
        placement = self.cell.placement
        changes = [f"at {placement.scale:g} of its size"] if placement.scale != 1 else []
        changes += [f"with {placement.density:g} kg/m3"] if placement.density is not None else []
        what = "Forces and masses are of the structure as modelled; the cell builds it"
        return f"{what} {' '.join(changes)}." if changes else ""

    def turned(self, direction: Direction) -> Arms:
        """Return the same in the other order."""
        return self if direction is self.direction else Arms(self.plan, self.cell, direction)

    def holders(self) -> NDArray[np.int64]:
        """Return robot that holds each part in each state of the plan; shape (steps + 1, parts)."""
        plan, frames = self.plan, [(row, self.plan.in_hand(k)) for k, row in enumerate(self.plan.rows.tolist())]
        states, actions = plan.plan.states, plan.plan.actions
        who = np.full(states.shape, NO_ROBOT, dtype=np.int64)
        for row, held in frames if self.direction is Direction.DISASSEMBLY else reversed(frames):
            who[row] = NO_ROBOT  # of the keyframes around a hand-over the first in assembly counts
            for robot, part in enumerate(held):
                if part is not None:
                    who[row, part] = robot
        first, last = len(plan.before), len(plan.plan) - len(plan.after)
        for row, robot in zip(reversed(range(first)), reversed(plan.before), strict=True):
            part = actions[row] % states.shape[1]
            who[row], who[row, part] = who[row + 1], robot if states[row, part] == HELD else NO_ROBOT
        for row, robot in enumerate(plan.after, last + 1):
            part = actions[row - 1] % states.shape[1]
            who[row], who[row, part] = who[row - 1], robot if states[row, part] == HELD else NO_ROBOT
        return who

    def at_time(self, seconds: float) -> ArmPoses:
        """Return the poses at a time of the plan in the order shown."""
        configurations, carried = [], []
        for arm in activities_at(self.plan, self.clock.starts, seconds):
            values = arm.at(np.array([seconds]))[0]
            configurations.append(values)
            if arm.load is not None:
                pose = arm.load.at(self.cell.robots[arm.robot], values)
                carried.append(CarriedPart(arm.load.part, arm.robot, self._seen(pose)))
        for load in waiting_at(self.plan, seconds):
            if all(other.part != load.part for other in carried):
                carried.append(CarriedPart(load.part, NO_ROBOT, self._seen(load.pose)))
        return ArmPoses(self._poses(configurations), tuple(carried))

    def at(self, position: float) -> ArmPoses:
        """Return the poses where a place in the plan is reached, in steps of assembly done."""
        return self.at_time(self.clock.seconds(position))

    def _seen(self, pose: Array) -> Array:
        """Return a displacement in the cell, shape (4, 4), as one in the structure."""
        return self._to_structure @ pose @ np.linalg.inv(self._to_structure)

    def _poses(self, configurations: Sequence[Array]) -> Array:
        frames = [arm_frames(robot, values) for robot, values in zip(self.cell.robots, configurations, strict=True)]
        made = self._to_structure @ np.array([frames[link.robot][link.frame] for link in self.links])
        made[:, :3, :3] *= self.scale  # vertices are in lengths of the structure already
        return made


def appearance_with_arms(look: Appearance, arm_poses: ArmPoses) -> Appearance:
    """Return the parts without those that are carried."""
    opacity = look.opacity.copy()
    opacity[[carried.part for carried in arm_poses.carried]] = 0.0
    return replace(look, opacity=opacity)


def solids_of_arms(arms: Arms, arm_poses: ArmPoses, assembly: Assembly) -> list[ColoredSolid]:
    """Return arms, and the parts that they carry, as meshes."""
    solids = [
        ColoredSolid(apply(pose, link.vertices), link.faces, link.color)
        for link, pose in zip(arms.links, arm_poses.poses, strict=True)
    ]
    for carried in arm_poses.carried:
        mesh = assembly.meshes[carried.part]
        solids.append(ColoredSolid(apply(carried.pose, mesh.vertices), mesh.faces, unit_rgb(carried.color)))
    return solids


def bounds_with_arms(arms: Arms, box: Array) -> Array:
    """Return the bounds of the structure and of the robots at the first keyframe, shape (2, 3)."""
    links = zip(arms.links, arms.at(0.0).poses, strict=True)
    return box_around(np.concatenate([box, *(apply(pose, link.vertices) for link, pose in links)]))


def _similar(pose: Array, scale: float) -> Array:
    """Return the transform from the world of the cell to the frame of the structure, shape (4, 4)."""
    made = np.eye(4)
    made[:3, :3] = pose[:3, :3].T / scale
    made[:3, 3] = -pose[:3, :3].T @ pose[:3, 3] / scale
    return made


def links_of(number: int, robot: CellRobot, size: float = 1.0) -> list[Link]:
    """Return what a robot looks like, base first, gripper last; a link of several colours is several pieces."""
    own = np.array(unit_rgb(robot_color(number)))

    def link(frame: int, shape: VisualShape, share: float) -> Link:
        red, green, blue = ((1 - share) * np.array(shape.color) + share * own).tolist()
        return Link(number, frame, shape.vertices * size, shape.faces, (red, green, blue))

    found = [link(frame, shape, TINT) for frame, shapes in enumerate(link_visuals(robot.model)) for shape in shapes]
    return found + [link(robot.model.joints + 1, shape, 1.0) for shape in shapes_of(robot.gripper.pieces)]
