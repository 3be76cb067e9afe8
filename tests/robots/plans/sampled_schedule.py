"""Schedules, nominal or delayed, checked at sampled instants: what the proof for any delays is compared with."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import REMOVED
from falsework.errors import PlanError
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker, PreparedQuery
from falsework.robots.model.cell import Cell
from falsework.robots.model.shapes import Array
from falsework.robots.plans.loads import Load
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import ArmActivity, activities_at, event_times

INTERVAL = 0.01
"""Longest time between two samples, seconds."""
_SHORTEST = 1e-9
"""Duration below which a time interval counts as an instant."""


def check_schedule(
    plan: RobotPlan,
    cell: Cell,
    judge: PinocchioCollisionChecker,
    *,
    step: float = 0.01,
    stretch: ArrayLike | None = None,
) -> tuple[list[PlanProblem], int]:
    """Check a schedule, nominal or delayed; return its problems and the number of checked instants.

    Args:
        step: largest motion of a joint between two samples, rad or m; samples are at most `INTERVAL` apart.
        stretch: factor on the duration of each motion, shape (nodes,); 1 by default.

    Raises:
        PlanError: the plan has no schedule.
    """
    graph = plan.schedule
    if graph is None:
        raise PlanError("the robot plan has no schedule to check; plan again, or schedule it")
    factor = np.ones(len(graph.nodes)) if stretch is None else np.asarray(stretch, dtype=np.float64)
    events = event_times(plan, graph, stretch)
    problems = [
        PlanProblem(
            k + 1, plan.robots[plan.steps[k + 1].robot].name, "it comes before the previous step", seconds=moment
        )
        for k, moment in enumerate(events[:-1].tolist())
        if events[k + 1] < moment - 1e-6
    ]
    starts, samples = graph.starts(stretch), 0
    prepared: dict[tuple[object, ...], PreparedQuery] = {}
    cuts = np.unique(np.concatenate([starts, starts + factor * graph.durations]))
    for begin, end in pairwise(cuts.tolist()):
        if end - begin <= _SHORTEST:
            continue
        middle = (begin + end) / 2
        state = int((events < middle).sum())
        present = plan.states[state] != REMOVED
        doing = list(activities_at(plan, starts, middle, factor))
        moments = _moments(doing, begin, end, step)
        values = np.concatenate([arm.at(moments) for arm in doing], axis=1)
        samples += len(moments)
        for arm in doing:
            if arm.trajectory is None:
                continue
            loads = {other.robot: other.load for other in doing if other is not arm and other.load is not None}
            key = (arm.robot, id(arm.trajectory), state, *((k, load.key) for k, load in loads.items()))
            if key not in prepared:
                prepared[key] = _prepare(plan, judge, arm, present, loads)
            pair = _first_hit(prepared[key], values)
            if pair is not None:
                row, names = pair
                what, name = f"{names[0]} collides with {names[1]}", cell.robots[arm.robot].name
                problems.append(PlanProblem(arm.step, name, what, pair=names, seconds=float(moments[row])))
    return problems, samples


def _moments(doing: list[ArmActivity], begin: float, end: float, step: float) -> Array:
    """Return times from begin to end, so close that no joint moves farther than `step` from one to the next."""
    count = max(int(np.ceil((end - begin) / INTERVAL)), 1)
    while True:
        found = np.linspace(begin, end, count + 1)
        far = max(float(np.abs(np.diff(arm.at(found), axis=0)).max()) for arm in doing)
        if far <= step:
            return found
        count = int(np.ceil(count * max(far / step, 1.1)))


def _prepare(
    plan: RobotPlan,
    judge: PinocchioCollisionChecker,
    arm: ArmActivity,
    present: NDArray[np.bool_],
    loads: dict[int, Load],
) -> PreparedQuery:
    trajectory = arm.trajectory
    assert trajectory is not None
    return judge.prepare(
        arm.robot,
        plan.keyframes[0].configurations,
        present,
        load=arm.load,
        touches=trajectory.touches,
        at_place=arm.load is not None and trajectory.kind == "line",
        loads=loads,
    )


def _first_hit(query: PreparedQuery, values: Array) -> tuple[int, tuple[str, str]] | None:
    for row, entry in enumerate(values):
        query.values[:] = entry
        pair = query.hits(entry[query.slots[query.robot]])
        if pair is not None:
            return row, pair
    return None
