"""Schedule of a robot plan: from sequential motions to simultaneous ones."""

from __future__ import annotations

from dataclasses import replace

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.schedule.conflicts import choices, fixed_precedences
from falsework.robots.schedule.itinerary import Itineraries
from falsework.robots.schedule.solver import ScheduleSettings, solve


def schedule_plan(
    plan: RobotPlan,
    assembly: AnyStructure,
    cell: AnyCell,
    settings: ScheduleSettings = ScheduleSettings(),
    *,
    parts: PartShapes | None = None,
) -> RobotPlan:
    """Return a robot plan with a schedule in which its arms move at the same time.

    Paths and the order of the states stay as they are. Two arms execute segments of their motions at the same
    time only if all of one is proven to keep its distance from all of the other, whatever the delays.

    Args:
        plan: robot plan with sequential motions.
        assembly: the structure, or its name or path.
        cell: the robots, or the name or file of the cell.
        settings: limits of the search for the shortest schedule.
        parts: the parts as bodies in the cell, if already available.

    Raises:
        PlanError: the plan is for another structure or cell.
        DependencyError: OR-Tools is missing.
    """
    assembly, cell = as_assembly(assembly), as_cell(cell)
    plan.check_identity(assembly, cell)
    world = CollisionWorld(cell, parts or place_parts(assembly, cell.placement))
    rows = Itineraries(plan, world)
    graph = solve(rows.nodes, fixed_precedences(rows), choices(rows), cell.robot_count, settings)
    return replace(plan, schedule=graph)
