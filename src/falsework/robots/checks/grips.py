"""Check of grips: a cup meets a face of its part, flat and not deeper; jaws close on two opposite faces."""

from __future__ import annotations

import numpy as np

from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.model.cell import GRIP_DEPTH, GRIP_DISTANCE, GRIP_TILT, Cell, Gripper
from falsework.robots.model.shapes import Array

_RINGS = ((0.0, 1), (0.5, 8), (1.0, 16))
"""Points of a cup at which the surface is measured: shares of its radius, and their numbers."""
_PINCHES = 9
"""Points along the contact length of jaws at which the part between them is measured."""
_HELD_SHARE = 1 / 3
"""Share of the contact length on which jaws must have the part between them."""
_EDGE = 1e-7
"""Share of a triangle by which a ray may miss it at its edge."""


class GripChecker:
    """Grips of the robots of a cell, measured on the exact surfaces of the parts."""

    def __init__(self, cell: Cell, judge: PinocchioCollisionChecker) -> None:
        self.cell, self.judge = cell, judge

    def tool(self, robot: int, configuration: Array) -> Array:
        """Return the pose of a tool frame in the world, shape (4, 4)."""
        return self.judge.flange(robot, configuration) @ self.cell.robots[robot].gripper.tool

    def fault(self, robot: int, configuration: Array, part: int, pose: Array | None = None) -> str:
        """Return why a robot does not grip a part that is at its place, or displaced by a pose; empty if it does."""
        name, gripper = self.judge.parts.names[part], self.cell.robots[robot].gripper
        far = self.judge.grip_distance(robot, configuration, part, pose)
        if far > gripper.grip_distance:
            return f"the gripper is {1000 * far:.1f} mm away from {name}"
        if self.judge.is_pierced(robot, configuration, part, pose):
            return f"the gripper is inside {name}"
        tool = self.tool(robot, configuration)
        if pose is not None:  # seen from the part at its place
            tool = np.linalg.inv(pose) @ tool
        triangles = self.judge.parts.surface(part).triangles
        return surface_fault(gripper, tool, triangles, name)


def surface_fault(gripper: Gripper, tool: Array, triangles: Array, name: str) -> str:
    """Return why a gripper at a tool frame does not meet the surface of a part as it must; empty if it does."""
    return (_cup_fault if gripper.kind == "suction" else _jaw_fault)(gripper, tool, triangles, name)


def _cup_fault(gripper: Gripper, tool: Array, triangles: Array, name: str) -> str:
    x, y, z, at = tool[:3].T
    radius = max(gripper.cup, GRIP_DEPTH)
    flat, heights = [], []
    for share, count in _RINGS:
        for angle in 2 * np.pi * np.arange(count) / count:
            u, v = share * radius * np.cos(angle), share * radius * np.sin(angle)
            height, normal = _cast(triangles, at + u * x + v * y, z)
            outside = normal @ z < 0  # surfaces that face the cup
            if not outside.any():
                return f"the cup is not wholly on a face of {name}"
            flat.append((u, v, 1.0))
            heights.append(float(height[outside][np.argmin(np.abs(height[outside]))]))
    plane, *_ = np.linalg.lstsq(np.array(flat), np.array(heights), rcond=None)
    tilt = float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))
    if tilt > GRIP_TILT:
        return f"the cup is tilted by {tilt:.0f} degrees to the face of {name}"
    uneven = float(np.abs(np.array(flat) @ plane - heights).max())
    if uneven > radius * np.tan(np.radians(GRIP_TILT)):
        return f"the cup is not wholly on a face of {name}: the surface is uneven by {1000 * uneven:.1f} mm"
    if heights[0] < -GRIP_DEPTH:
        return f"the cup is {1000 * -heights[0]:.1f} mm deep in {name}"
    if heights[0] > GRIP_DISTANCE:
        return f"the cup is {1000 * heights[0]:.1f} mm away from {name}"
    return ""


def _jaw_fault(gripper: Gripper, tool: Array, triangles: Array, name: str) -> str:
    """Return why jaws do not close on a part: along their contact length, from the tool frame back, they must do so."""
    x, z, at = tool[:3, 0], tool[:3, 2], tool[:3, 3]
    faults = [
        _pinch_fault(gripper, triangles, at - share * gripper.depth * z, x, name)
        for share in np.linspace(0, 1, _PINCHES)
    ]
    bad = [fault for fault in faults if fault]
    return "" if len(bad) <= (1 - _HELD_SHARE) * _PINCHES else bad[0]


def _pinch_fault(gripper: Gripper, triangles: Array, at: Array, x: Array, name: str) -> str:
    height, normal = _cast(triangles, at, x)
    sides = []
    for sign in (1.0, -1.0):
        ahead = (sign * height > 0) & (sign * (normal @ x) > 0)
        if not ahead.any():
            return f"{name} is not between the jaws"
        nearest = int(np.argmin(np.where(ahead, np.abs(height), np.inf)))
        if sign * float(normal[nearest] @ x) < np.cos(np.radians(GRIP_TILT)):
            return f"the jaws do not close flat on {name}"
        sides.append(abs(float(height[nearest])))
    if sum(sides) > gripper.opening or max(sides) > gripper.opening / 2 + GRIP_DISTANCE:
        return f"{name} is {1000 * sum(sides):.1f} mm wide, the jaws open to {1000 * gripper.opening:.1f} mm"
    return ""


def _cast(triangles: Array, origin: Array, way: Array) -> tuple[Array, Array]:
    """Return where a line meets triangles: coordinates along it, shape (hits,), and unit normals, shape (hits, 3)."""
    a, b, c = triangles[:, 0] - origin, triangles[:, 1] - origin, triangles[:, 2] - origin
    # Signed volumes with the direction of the line: of one sign where it passes inside all three edges.
    u, v, w = np.cross(b, c) @ way, np.cross(c, a) @ way, np.cross(a, b) @ way
    whole = u + v + w
    slack = _EDGE * np.abs(whole)
    hit = (np.abs(whole) > 1e-18) & (
        ((u >= -slack) & (v >= -slack) & (w >= -slack)) | ((u <= slack) & (v <= slack) & (w <= slack))
    )
    a, b, c, whole = a[hit], b[hit], c[hit], whole[hit]
    points = (u[hit, None] * a + v[hit, None] * b + w[hit, None] * c) / whole[:, None]
    normals = np.cross(b - a, c - a)
    return points @ way, normals / np.linalg.norm(normals, axis=1)[:, None]
