"""Records and sentences about robot plans and their checks."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.cli.planning import replay_text
from falsework.utils.quantity import counted, format_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.robots.checks.check import CheckReport
    from falsework.robots.model.cell import Cell
    from falsework.robots.plans.plan_problem import PlanProblem
    from falsework.robots.plans.robot_forces import GripLoad
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.robots.schedule.simulation import SimulationReport
    from falsework.search.plans.plan_report import PlanReport

_AT_HOME = 1e-6
"""Joint values that differ by no more are equal, rad or m."""
_CHECKED = (
    *((name, "") for name in ("samples", "trajectories", "links", "seconds")),
    *((name, "") for name in ("velocity_share", "acceleration_share")),
    *(("largest_step", "_rad"), ("largest_join", "_rad"), ("tolerance", "_m"), ("lower_bound", "_s")),
)
"""Fields of a check that are recorded, and their units."""
_NO_GAIN = 0.05
"""A schedule that saves no more than this is none, seconds."""


def can_schedule(output: Output) -> bool:
    """Return whether motions can be scheduled; say so where the package for it is missing."""
    from falsework.errors import DependencyError
    from falsework.robots.schedule.solver import import_ortools

    try:
        import_ortools()
    except DependencyError as error:
        output.note(f"falsework: one robot moves at a time: {error}")
        return False
    return True


def times_record(plan: RobotPlan) -> dict[str, Any]:
    """Return the duration of a plan, and how each arm spends it."""
    from falsework.robots.plans.timeline import arm_shares, schedule_of

    graph, proven = schedule_of(plan), plan.schedule is not None
    return {
        "makespan_s": round(graph.makespan, 3),
        "sequential_s": round(graph.sequential, 3),
        "lower_bound_s": round(graph.lower_bound, 3) if proven else None,
        "gap": round(graph.gap, 4) if proven else None,
        "arms": [
            {name: round(value, 4) if isinstance(value, float) else value for name, value in asdict(share).items()}
            for share in arm_shares(plan)
        ],
    }


def found_texts(plan: RobotPlan, name: str, statistics: dict[str, Any]) -> list[str]:
    """Return what is known of a plan that was found, in sentences."""
    found = [
        f"{name}: {counted(plan.executed, 'step')} for {counted(len(plan.robots), 'robot')}, {plan.seconds:.0f} s of "
        f"motion, every state proven {plan.plan.claim.proves} (criterion {plan.plan.claim.criterion}, "
        f"{statistics['seconds']:.1f} s)"
    ]
    done = len(plan.done_by)
    if done:
        last = int(plan.rows[-1])
        what = f"{done + 1} to {last}" if plan.before else f"{len(plan.plan) - done} down to {last + 1}"
        found.append(f"{counted(done, 'step')} of the plan are done; the motions are of its steps {what}")
    if plan.plan.replay is not None:
        found.append(replay_text(plan.plan))
    if plan.schedule is not None:
        found.append(schedule_text(plan))
    if statistics.get("search") == "sequential":
        found.append("no plan with short approaches was found; this one has the approaches of one arm at a time")
    return found


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
    record = {f"{name}{unit}": getattr(report, name) for name, unit in _CHECKED}
    for name in ("velocity_share", "acceleration_share"):  # which may overflow
        record[name] = record[name] if np.isfinite(record[name]) else None
    names, delays = ("overlaps", "early", "ranges", "distances", "seconds"), report.delays
    record["delays"] = None if delays is None else {name: getattr(delays, name) for name in names}
    return record | {"problems": [problem_record(problem) for problem in report.problems]}


def problem_record(problem: PlanProblem) -> dict[str, Any]:
    """Return the record of a problem that a check found."""
    names = {"distance": "distance_m"}
    return {names.get(name, name): value for name, value in asdict(problem).items()}


def check_texts(name: str, report: CheckReport, states: PlanReport | None) -> list[str]:
    """Return what the check of a good plan has established, in sentences.

    Args:
        states: check of its states; None if they were not checked.
    """
    stable = "" if states is None else f", all {states.states} states are {states.claim.proves}"
    links = ", ".join(f"{robot} as {shapes}" for robot, shapes in report.links.items())
    found = [
        f"{name}: no collision in {report.samples} configurations of {report.trajectories} motions (links of "
        f"{links}), all within limits{stable}"
    ]
    if report.delays is not None:
        found.append(
            f"whatever the delays, states keep their order and arms keep apart: {report.delays.overlaps} pairs of "
            "motions and rests can coincide, and are free of collisions between samples too"
        )
    return found


def runs_record(runs: SimulationReport, longest_delay: float) -> dict[str, Any]:
    """Return the record of delayed runs."""
    spread = zip(("least", "median", "most"), runs.spread, strict=True)
    record = {name: getattr(runs, name) for name in ("out_of_order", "outside")}
    record |= {"runs": len(runs.makespans), "longest_delay": longest_delay}
    return {**record, "makespan_s": {name: round(value, 3) for name, value in spread}}


def runs_text(runs: SimulationReport, longest_delay: float) -> str:
    """Return how delayed runs ended, in one sentence."""
    what = f"{len(runs.makespans)} runs with motions up to {longest_delay:.0%} longer"
    if not runs.good:
        return (
            f"of {what} {runs.out_of_order} reach states in another order, and {runs.outside} leave the checked "
            "positions"
        )
    least, median, most = runs.spread
    return f"{what} take {least:.1f} to {most:.1f} s, median {median:.1f} s"


def scope_record(plan: RobotPlan, assembly: Assembly, cell: Cell, place: str) -> dict[str, Any]:
    """Return what a robot plan was checked against."""
    states, first = plan.states, plan.keyframes[0].configurations
    pairs = zip(cell.robots, first, strict=True)
    elsewhere = [robot.name for robot, values in pairs if np.abs(robot.home - values).max() > _AT_HOME]
    return {
        "structure": assembly.name,
        "structure_identity": assembly.identity,
        "cell": cell.name,
        "cell_file": place,
        "cell_identity": plan.cell_identity,
        "robots": [robot.name for robot in cell.robots],
        "not_at_home": elsewhere,
        "criterion": plan.plan.claim.criterion,
        "direction": plan.direction.value,
        "steps": plan.executed,
        "start": "".join(map(str, states[0].tolist())),
        "end": "".join(map(str, states[-1].tolist())),
    }


def scope_text(plan: RobotPlan, assembly: Assembly, cell: Cell, place: str) -> str:
    """Return what a robot plan was checked against, in one sentence."""
    record = scope_record(plan, assembly, cell, place)
    first, last = (int((state != 0).sum()) for state in plan.states[[0, -1]])
    starts = f"; {' and '.join(record['not_at_home'])} not at home at the start" if record["not_at_home"] else ""
    return (
        f"{plan.direction.value} of {assembly.name} ({assembly.identity[:12]}) in "
        f"{counted(plan.executed, 'step')} from "
        f"{first} to {last} parts, in cell {cell.name} of {place} ({plan.cell_identity[:12]}) with "
        f"{', '.join(record['robots'])}, criterion {record['criterion']}{starts}"
    )


def unverified(plan: RobotPlan, report: CheckReport, *, states: bool) -> list[str]:
    """Return the claims of a robot plan that its check does not establish.

    Args:
        states: whether the stability of its states was checked.
    """
    found = []
    if not states:
        found.append("the stability of the states, and the forces that robots bear where grippers have no limits")
    holds = plan.plan.claim.holds
    if plan.plan.claim.criterion == "contact":
        stiff = (
            "rigidly"
            if holds.stiffness in (None, np.inf)
            else f"with a stiffness of {format_quantity(holds.stiffness, 'stiffness')}"
        )
        found.append(f"that robots hold parts {stiff}, in units of the structure")
    if plan.plan.proof_arrays() is not None:
        found.append("the certificates in the file; those of the check are computed anew")
    if plan.plan.margins is not None:
        found.append("the margins that the plan records")
    if plan.plan.replay is not None:
        found.append("that a replay of the plan succeeds")
    if plan.schedule is not None and report.lower_bound is not None:
        bound, proven = plan.schedule.lower_bound, report.lower_bound
        if bound > proven + _NO_GAIN:
            found.append(
                f"that no schedule of these motions takes less than {bound:.1f} s, as the plan says; the busiest arm "
                f"alone moves for {proven:.1f} s"
            )
    return found


def overloads_of(plan: RobotPlan, assembly: Assembly, cell: Cell) -> list[PlanProblem]:
    """Return the holds of a plan that take more than a gripper bears; nothing is computed for a cell without limits."""
    from falsework.robots.plans.robot_forces import grip_loads, overloads

    if not any(robot.gripper.has_limits for robot in cell.robots):
        return []
    return overloads(grip_loads(plan, assembly, cell), plan, cell)


def holds_record(loads: list[GripLoad], plan: RobotPlan, cell: Cell) -> list[dict[str, Any]]:
    """Return the largest force and moment that each robot bears for a part that it holds, and its largest press."""
    from falsework.robots.plans.robot_forces import heaviest

    records, names = [], plan.plan.part_names
    for number, robot in enumerate(cell.robots):
        found = heaviest(loads, number)
        if found is None:
            continue
        force, moment = found
        limits = {"force_n": robot.gripper.force, "moment_nm": robot.gripper.moment, "payload_kg": robot.payload}
        record: dict[str, Any] = {"robot": robot.name, "force_n": force.force_n, "moment_nm": moment.moment_nm}
        record |= {f"{kind}_part": names[load.part] for kind, load in (("force", force), ("moment", moment))}
        presses = [load.force_n for load in loads if load.presses and load.robot == number]
        record["press_n"] = max(presses, default=None)
        limits = {key: None if value == float("inf") else value for key, value in limits.items()}
        records.append(record | {"limits": limits})
    return records


def holds_text(record: dict[str, Any]) -> str:
    """Return what `holds_record` has of one robot as a sentence."""
    limits = record["limits"]
    kinds = (("force_n", "force"), ("moment_nm", "moment"))
    said = [format_quantity(limits[key], kind) for key, kind in kinds if limits[key] is not None]
    payload = "" if limits["payload_kg"] is None else f", payload {format_quantity(limits['payload_kg'], 'mass')}"
    presses = "" if record["press_n"] is None else f", presses with up to {format_quantity(record['press_n'], 'force')}"
    return (
        f"{record['robot']} bears up to {format_quantity(record['force_n'], 'force')} (holding "
        f"{record['force_part']}) and {format_quantity(record['moment_nm'], 'moment')} at its tool (holding "
        f"{record['moment_part']}){presses}; limits of its gripper: {' and '.join(said) or 'not given'}{payload}"
    )
