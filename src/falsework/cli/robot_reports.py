"""Records and sentences about robot plans and their checks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.model.cell import Cell
    from falsework.robots.plans.check import CheckReport
    from falsework.robots.plans.grip_loads import GripLoad
    from falsework.robots.plans.plan_problem import PlanProblem
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.robots.schedule.simulation import SimulationReport

_NO_GAIN = 0.05
"""A schedule that saves no more than this is none, seconds."""


def times_record(plan: RobotPlan) -> dict[str, Any]:
    """Return the duration of a plan, and how each arm spends it."""
    from falsework.robots.plans.timeline import arm_shares, schedule_of

    graph, proven = schedule_of(plan), plan.schedule is not None
    return {
        "makespan": round(graph.makespan, 3),
        "sequential": round(graph.sequential, 3),
        "lower_bound": round(graph.lower_bound, 3) if proven else None,
        "gap": round(graph.gap, 4) if proven else None,
        "arms": [
            {
                "robot": share.robot,
                "moves": round(share.moves, 4),
                "holds": round(share.holds, 4),
                "waits": round(share.waits, 4),
            }
            for share in arm_shares(plan, graph)
        ],
    }


def schedule_text(plan: RobotPlan) -> str:
    """Return what a schedule saves, in one sentence."""
    graph = plan.schedule
    assert graph is not None
    if graph.makespan > graph.sequential - _NO_GAIN:
        return f"no two motions can take place at the same time: the plan stays sequential, {graph.sequential:.0f} s"
    share = graph.makespan / graph.sequential
    return (
        f"with robots moving at the same time: {graph.makespan:.0f} s, {share:.0%} of the time of one robot at a time; "
        f"no schedule of these motions takes less than {graph.lower_bound:.0f} s, a gap of {graph.gap:.0%}"
    )


def check_record(report: CheckReport) -> dict[str, Any]:
    """Return the record of the motions of a plan."""
    delays = report.delays
    return {
        "samples": report.samples,
        "timed_samples": report.timed_samples,
        "delays": None
        if delays is None
        else {
            "overlaps": delays.overlaps,
            "early": delays.early,
            "ranges": delays.ranges,
            "distances": delays.distances,
            "seconds": delays.seconds,
        },
        "trajectories": report.trajectories,
        "largest_step": report.largest_step,
        "largest_join": report.largest_join,
        "velocity_share": report.velocity_share,
        "acceleration_share": report.acceleration_share,
        "tolerance": report.tolerance,
        "links": report.links,
        "problems": [
            {
                "step": problem.step,
                "robot": problem.robot,
                "what": problem.what,
                "pair": problem.pair,
                "seconds": problem.seconds,
                "configuration": problem.configuration,
                "distance": problem.distance,
            }
            for problem in report.problems
        ],
        "seconds": report.seconds,
    }


def runs_record(runs: SimulationReport, longest_delay: float) -> dict[str, Any]:
    """Return the record of delayed runs."""
    least, median, most = runs.spread
    return {
        "runs": len(runs.makespans),
        "longest_delay": longest_delay,
        "out_of_order": runs.out_of_order,
        "stuck": runs.stuck,
        "outside": runs.outside,
        "makespan": {"least": round(least, 3), "median": round(median, 3), "most": round(most, 3)},
    }


def runs_text(runs: SimulationReport, longest_delay: float) -> str:
    """Return how delayed runs ended, in one sentence."""
    what = f"{len(runs.makespans)} runs with motions up to {longest_delay:.0%} longer"
    if not runs.good:
        return (
            f"of {what} {runs.out_of_order} reach states in another order, {runs.stuck} end in a deadlock, and "
            f"{runs.outside} leave the checked positions"
        )
    least, median, most = runs.spread
    return f"{what} take {least:.1f} to {most:.1f} s, median {median:.1f} s"


def overloads_of(plan: RobotPlan, assembly: Assembly, cell: Cell) -> list[PlanProblem]:
    """Return the holds of a plan that take more than a gripper bears; nothing is computed for a cell without limits."""
    from falsework.robots.plans.grip_loads import grip_loads, overloads

    if not any(robot.gripper.has_limits for robot in cell.robots):
        return []
    return overloads(grip_loads(plan, assembly, cell), plan, cell)


def holds_record(loads: list[GripLoad], plan: RobotPlan, cell: Cell) -> list[dict[str, Any]]:
    """Return the largest force and moment that each robot bears for a part that it holds."""
    from falsework.robots.plans.grip_loads import heaviest

    records = []
    for number, robot in enumerate(cell.robots):
        found = heaviest(loads, number)
        if found is None:
            continue
        force, moment = found
        limits = {"force": robot.gripper.force, "moment": robot.gripper.moment, "payload_kg": robot.payload}
        records.append(
            {
                "robot": robot.name,
                "force_n": force.force_n,
                "force_part": plan.plan.part_names[force.part],
                "moment_nm": moment.moment_nm,
                "moment_part": plan.plan.part_names[moment.part],
                "limits": {key: None if value == float("inf") else value for key, value in limits.items()},
            }
        )
    return records


def holds_text(record: dict[str, Any]) -> str:
    """Return what `holds_record` has of one robot as a sentence."""
    limits = record["limits"]
    said = [
        f"{value:.4g} {unit}" for key, unit in (("force", "N"), ("moment", "Nm")) if (value := limits[key]) is not None
    ]
    payload = "" if limits["payload_kg"] is None else f", payload {limits['payload_kg']:.3g} kg"
    return (
        f"{record['robot']} bears up to {record['force_n']:.4g} N (holding {record['force_part']}) and "
        f"{record['moment_nm']:.3g} Nm at its tool (holding {record['moment_part']}); limits of its gripper: "
        f"{' and '.join(said) or 'not given'}{payload}"
    )
