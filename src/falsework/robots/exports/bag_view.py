"""Joint states, frames, and meshes of arms, grippers and parts in a bag, for viewers to draw.

Topics: `/joint_states` (`sensor_msgs/JointState`) and `/tf` (`tf2_msgs/TFMessage`), `RATE` times a second, and
`/markers` (`visualization_msgs/MarkerArray`), a mesh in its frame for each link, gripper and part that is there. RViz
and the panels of Foxglove know these types by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.robots.cells.visuals import arm_frames, link_visuals, shapes_of
from falsework.robots.exports.ros2 import all_joint_names, duration
from falsework.robots.model.cell import Cell, CellRobot
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import Array, wxyz_of
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import activities_at, event_times, schedule_of

RATE = 20.0
"""Joint states and frames a second."""
WORLD = "world"
"""Frame of the cell."""
_TRIANGLES, _ADD, _DELETE = 11, 0, 2
"""Of markers: a list of triangles, and what becomes of it."""
_STONE = (0.86, 0.80, 0.70)
IDENTITY = {"orientation": {"w": 1.0}}

Write = Callable[[str, str, dict[str, Any], float], None]
"""Adds a message to a bag: topic, type, content and time."""


@dataclass(frozen=True, eq=False)
class PlacedParts:
    """Parts of a structure in a cell, whose shapes a bag then has."""

    shapes: PartShapes
    cell: Cell


def write_view(plan: RobotPlan, placed: PlacedParts, write: Write) -> None:
    """Write the topics of a robot plan."""
    graph = schedule_of(plan)
    starts, reached = graph.starts(), event_times(plan, graph)
    centers = np.array([mesh.bounds.mean(axis=0) for mesh in placed.shapes.meshes])
    names = all_joint_names(plan)
    markers = _arm_markers(plan, placed.cell)
    shown, moved = set[int](), set[int]()
    for now in np.arange(0.0, plan.makespan + 2.0 / RATE, 1.0 / RATE).tolist():  # the last sample shows the end
        values, frames, loads = [], list[tuple[str, Array]](), dict[int, Array]()
        for arm in activities_at(plan, starts, now):
            configuration = arm.at(np.array([now]))[0]
            values.append(configuration)
            entry = placed.cell.robots[arm.robot]
            frames += zip(_frames(plan, entry, arm.robot), arm_frames(entry, configuration), strict=True)
            if arm.load is not None:
                loads[arm.load.part] = arm.load.at(entry, configuration)
        row = int(np.searchsorted(reached, now, side="right"))
        state, loads = plan.states[row], dict(plan.keyframes[row].waits) | loads
        there = {*np.flatnonzero(state != REMOVED).tolist(), *loads}
        for part in sorted((there - shown) | (there & moved) | set(loads)):
            pose = loads.get(part, np.eye(4)).copy()
            pose[:3, 3] += pose[:3, :3] @ centers[part]
            frames.append((f"part_{plan.plan.part_names[part]}", pose))
        for part in sorted(there ^ shown):
            mesh = placed.shapes.meshes[part]
            corners = mesh.triangles.reshape(-1, 3) - centers[part] if part in there else np.zeros((0, 3))
            name = f"part_{plan.plan.part_names[part]}"
            markers.append(_marker(name, name, 0, corners, _STONE, _ADD if part in there else _DELETE))
        stamp = duration(now)
        joints = {"header": {"stamp": stamp}, "name": names, "position": np.concatenate(values)}
        write("/joint_states", "sensor_msgs/msg/JointState", joints, now)
        write("/tf", "tf2_msgs/msg/TFMessage", {"transforms": [_transform(*one, stamp) for one in frames]}, now)
        if markers:
            for marker in markers:
                marker["header"]["stamp"] = stamp
            write("/markers", "visualization_msgs/msg/MarkerArray", {"markers": markers}, now)
        shown, moved, markers = there, set(loads), []


def _frames(plan: RobotPlan, arm: CellRobot, robot: int) -> list[str]:
    """Return the names of the frames of the links of an arm, and of its flange."""
    return [f"{plan.robots[robot].name}_{link}" for link in (*arm.model.link_names, "tool0")]


def _arm_markers(plan: RobotPlan, cell: Cell) -> list[dict[str, Any]]:
    """Return the meshes of all links and grippers."""
    found = []
    for robot, (entry, about) in enumerate(zip(cell.robots, plan.robots, strict=True)):
        shapes = (*link_visuals(entry.model), shapes_of(entry.gripper.pieces))
        for frame, pieces in zip(_frames(plan, entry, robot), shapes, strict=True):
            for number, piece in enumerate(pieces):
                corners = piece.vertices[piece.faces].reshape(-1, 3)
                found.append(_marker(frame, about.name + "_" + frame, number, corners, piece.color, _ADD))
    return found


def _marker(
    frame: str, space: str, number: int, corners: Array, color: tuple[float, float, float], action: int
) -> dict[str, Any]:
    """Return triangles that move with a frame, three corners each."""
    return {
        "header": {"frame_id": frame},
        "ns": space,
        "id": number,
        "type": _TRIANGLES,
        "action": action,
        "pose": IDENTITY,
        "scale": dict.fromkeys("xyz", 1.0),
        "color": dict(zip("rgba", (*color, 1.0), strict=True)),
        "frame_locked": True,
        "points": [dict(zip("xyz", corner, strict=True)) for corner in corners.tolist()],
    }


def _transform(frame: str, pose: Array, stamp: dict[str, int]) -> dict[str, Any]:
    """Return where a frame is in the cell."""
    turn = dict(zip("wxyz", wxyz_of(pose[:3, :3]), strict=True))
    shift = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    return {
        "header": {"stamp": stamp, "frame_id": WORLD},
        "child_frame_id": frame,
        "transform": {"translation": shift, "rotation": turn},
    }
