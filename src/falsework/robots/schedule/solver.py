"""Schedule of a robot plan, from sequential motions to simultaneous ones: least makespan by constraint programming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import MotionNode, Precedence, TemporalPlanGraph
from falsework.robots.schedule.conflicts import Choice, Itineraries, choices, fixed_precedences
from falsework.utils.lazy import importing

_TICKS = 10_000
"""Time units of the solver per second."""
_SECONDS = 5.0
"""Time limit of the solver, s."""
_SEED = 1
"""Seed of the solver: the same schedule each time."""


def schedule_plan(
    plan: RobotPlan, assembly: AnyStructure, cell: AnyCell, *, parts: PartShapes | None = None
) -> RobotPlan:
    """Return a robot plan with a schedule in which its arms move at the same time.

    Paths and the order of the states stay as they are. Two arms execute segments of their motions at the same
    time only if all of one is proven to keep its distance from all of the other, whatever the delays.

    Args:
        plan: robot plan with sequential motions.
        assembly: the structure, or its name or path.
        cell: the robots, or the name or file of the cell.
        parts: the parts as bodies in the cell, if already available.

    Raises:
        PlanError: the plan is for another structure or cell.
        DependencyError: OR-Tools is missing.
    """
    assembly, cell = as_assembly(assembly), as_cell(cell)
    plan.check_identity(assembly, cell)
    world = CollisionWorld(cell, parts or place_parts(assembly, cell.placement))
    rows = Itineraries(plan, world)
    graph = solve(rows.nodes, fixed_precedences(rows), choices(rows), cell.robot_count)
    return replace(plan, schedule=graph)


def import_ortools():
    """Return the CP-SAT module of OR-Tools; DependencyError without it."""
    with importing(
        "scheduling arms that move at the same time needs OR-Tools; install it: pip install 'falsework[schedule]'"
    ):
        from ortools.sat.python import cp_model
    return cp_model


def solve(
    nodes: Sequence[MotionNode], fixed: Sequence[Precedence], choices: Sequence[Choice], robots: int
) -> TemporalPlanGraph:
    """Return the temporal plan graph of a schedule with the least makespan found, from the order of the plan on."""

    def chosen(orders: Sequence[int], bound: float) -> TemporalPlanGraph:
        edges = [*fixed, *(e for choice, k in zip(choices, orders, strict=True) for e in choice.orders[k] or ())]
        graph = TemporalPlanGraph(tuple(nodes), tuple(_needed(edges)), robots, 0.0)
        return replace(graph, lower_bound=min(bound, graph.makespan))

    cp = import_ortools()
    model = cp.CpModel()
    horizon = round(sum(node.seconds for node in nodes) * _TICKS) + len(nodes)
    begin = [model.new_int_var(0, horizon, "") for _ in nodes]
    makespan = model.new_int_var(0, horizon, "")
    for node, start in zip(nodes, begin, strict=True):
        model.add(makespan >= start + round(node.seconds * _TICKS))
    for edge in fixed:
        model.add(begin[edge.after] >= begin[edge.before] + round(edge.offset * _TICKS))
    flags = []
    for choice in choices:
        second = model.new_bool_var("")
        flags.append(second)
        for edges, literal in zip(choice.orders, (second.negated(), second), strict=True):
            if edges is None:
                model.add_bool_or([literal.negated()])
                continue
            for edge in edges:
                # At least a tick, or motions could wait for each other in a circle that takes no time.
                ready = begin[edge.before] + max(round(edge.offset * _TICKS), 1)
                model.add(begin[edge.after] >= ready).only_enforce_if(literal)
        model.add_hint(second, bool(choice.planned))
    planned = [choice.planned for choice in choices]
    for start, seconds in zip(begin, chosen(planned, 0.0).starts().tolist(), strict=True):
        model.add_hint(start, round(seconds * _TICKS))
    model.minimize(makespan)
    solver = cp.CpSolver()
    solver.parameters.max_time_in_seconds = _SECONDS
    solver.parameters.num_workers = 1  # two take more time, and depend on which of them is first
    solver.parameters.random_seed = _SEED
    status = solver.solve(model)
    bound = max(solver.best_objective_bound / _TICKS, 0.0)
    found = status in (cp.OPTIMAL, cp.FEASIBLE)
    return chosen([int(solver.value(flag)) for flag in flags] if found else planned, bound)


def _needed(edges: Sequence[Precedence]) -> list[Precedence]:
    """Return only the latest precedence between each two nodes."""
    longest: dict[tuple[int, int], Precedence] = {}
    for edge in sorted(edges, key=lambda edge: -edge.offset):
        longest.setdefault((edge.before, edge.after), edge)
    return [longest[key] for key in sorted(longest)]
