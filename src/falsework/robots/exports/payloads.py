"""Loads that tools and carried parts are for their arms, and how programs state them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from falsework.assembly.model import Assembly
from falsework.geometry.arrays import apply
from falsework.robots.model.cell import Cell, Gripper
from falsework.robots.model.part_shapes import placed_mass
from falsework.robots.model.shapes import Array, Pieces, inverse_pose, principal_axes, wxyz_of
from falsework.robots.plans.loads import load_of
from falsework.robots.plans.robot_plan import RobotPlan

_LEAST_MASS = 0.001
"""Mass of a tool without one, kg: that of `tool0`, since RAPID accepts no zero."""


@dataclass(frozen=True, eq=False)
class ToolLoad:
    """Load of an arm, in the frame of the flange."""

    mass: float
    """kg."""
    center: Array
    """Centre of mass, metres, shape (3,)."""
    inertia: Array
    """About the centre of mass, kg m2, shape (3, 3); zero where it is unknown."""


PartLoads = dict[tuple[int, int, int], ToolLoad]
"""Load of the part in the gripper, in the frame of the flange, by step of the plan, robot and motion of the step."""


def tool_load(gripper: Gripper) -> ToolLoad:
    """Return the load of a gripper; the centre of mass of its shapes, of one density, stands in for a missing one."""
    center = gripper.center_of_mass if gripper.center_of_mass is not None else _centroid(gripper.pieces)
    inertia = np.zeros((3, 3)) if gripper.inertia is None else gripper.inertia
    return ToolLoad(gripper.mass, center, inertia)


def rapid_load(load: ToolLoad) -> str:
    """Return a load as RAPID's `loaddata`: kg, mm, axes of the moments of inertia as a quaternion, kg m2."""
    moments, axes = principal_axes(load.inertia)
    if np.array_equal(load.inertia, np.diag(np.diag(load.inertia))):
        moments, axes = np.diag(load.inertia), np.eye(3)
    center = ",".join(f"{round(1000 * value, 3) + 0.0:.3f}" for value in load.center)
    turn = ",".join(map(_plain, wxyz_of(axes)))
    return f"[{max(load.mass, _LEAST_MASS):.4f},[{center}],[{turn}],{','.join(map(_plain, moments.tolist()))}]"


def _plain(value: float) -> str:
    """Return a number without an exponent, to the seventh digit after the point."""
    return f"{round(value, 7) + 0.0:.7f}".rstrip("0").rstrip(".")


def ur_payload(load: ToolLoad) -> str:
    """Return the URScript command that sets a load: kg, m, kg m2."""
    center = ", ".join(f"{round(value, 6) + 0.0:.6f}" for value in load.center)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = load.inertia.tolist()
    inertia = ", ".join(map(_plain, (xx, yy, zz, xy, xz, yz)))
    return f"set_target_payload({load.mass:.4f}, [{center}], [{inertia}])"


def part_loads(plan: RobotPlan, assembly: Assembly, cell: Cell) -> PartLoads:
    """Return the loads of all motions that carry a part, in a cell that may scale the structure and its density."""
    placement, own = cell.placement, assembly.mass
    mass = placed_mass(assembly, placement)
    inertia = own.inertia * (mass / own.mass * placement.scale**2)[:, None, None]
    center = apply(placement.pose, placement.scale * own.center)
    found: PartLoads = {}
    for step, entry in enumerate(plan.steps):
        for number, motion in itertools.product(entry.robots, range(len(entry.trajectories))):
            load = load_of(plan, step, motion, number)
            if load is None or load.grip is None:
                continue
            part, to_flange = load.part, load.in_flange(cell.robots[number])
            turn = to_flange[:3, :3] @ placement.pose[:3, :3]
            place = apply(to_flange, center[part][None])[0]
            found[step, number, motion] = ToolLoad(float(mass[part]), place, turn @ inertia[part] @ turn.T)
    return found


def in_tool(load: ToolLoad, tool: Array) -> ToolLoad:
    """Return a load in the frame of a tool, which is given in the frame of the flange, shape (4, 4)."""
    back = inverse_pose(tool)
    turn = back[:3, :3]
    return ToolLoad(load.mass, apply(back, load.center[None])[0], turn @ load.inertia @ turn.T)


def together(first: ToolLoad, second: ToolLoad) -> ToolLoad:
    """Return the load of two bodies that move as one."""
    mass = first.mass + second.mass
    center = (first.mass * first.center + second.mass * second.center) / max(mass, 1e-12)
    inertia = np.zeros((3, 3))
    for load in (first, second):
        away = load.center - center
        inertia += load.inertia + load.mass * (away @ away * np.eye(3) - np.outer(away, away))
    return ToolLoad(mass, center, inertia)


def _centroid(pieces: Pieces) -> Array:
    """Return the centroid of convex pieces, shape (3,); overlaps count twice."""
    from trimesh.convex import convex_hull

    hulls = [convex_hull(piece) for piece in pieces]
    if not hulls:
        return np.zeros(3)
    return np.average([hull.center_mass for hull in hulls], axis=0, weights=[hull.volume for hull in hulls])
