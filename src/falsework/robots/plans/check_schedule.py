"""Verification of a schedule: all arms at their places at every moment, checked by Pinocchio and Coal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import REMOVED
from falsework.errors import PlanError
from falsework.robots.model.cell import Cell
from falsework.robots.plans.pinocchio_checker import PinocchioCollisionChecker, PreparedQuery
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import event_times
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]

INTERVAL = 0.01
"""Longest time between two samples, seconds."""
_SHORTEST = 1e-9
"""Stretches of time that are no longer are moments."""


@dataclass(frozen=True)
class ScheduleProblem:
    """Something wrong at a moment of a schedule."""

    step: int
    robot: str
    what: str
    seconds: float
    """From the start of the schedule."""
    pair: tuple[str, str] | None = None


@dataclass(frozen=True, eq=False)
class _Doing:
    """One arm during an interval."""

    robot: int
    step: int
    trajectory: Trajectory | None
    """None: it rests."""
    begin: float
    stretch: float
    rest: Array
    """Where it rests, shape (joints,)."""
    load: tuple[int, Array] | None
    """The part that it carries, and the configuration in which the part is at its place."""

    def at(self, seconds: Array) -> Array:
        """Return joint values at some times, shape (samples, joints)."""
        if self.trajectory is None:
            return np.repeat(self.rest[None], len(seconds), axis=0)
        return self.trajectory.sample((seconds - self.begin) / self.stretch)


def check_schedule(
    plan: RobotPlan,
    cell: Cell,
    judge: PinocchioCollisionChecker,
    *,
    step: float = 0.01,
    stretch: ArrayLike | None = None,
) -> tuple[list[ScheduleProblem], int]:
    """Check a schedule, as it is or delayed, and return its problems and the number of moments that were looked at.

    Args:
        plan: with a schedule.
        cell: the cell that it is for.
        judge: the cell and the parts as Pinocchio and Coal see them.
        step: no joint moves farther between two samples, rad or m; they are at most `INTERVAL` apart.
        stretch: by what factor each motion takes longer, shape (nodes,); 1 if not given.

    Raises:
        PlanError: the plan has no schedule.
    """
    graph = plan.schedule
    if graph is None:
        raise PlanError("the robot plan has no schedule to check; plan again, or schedule it")
    factor = np.ones(len(graph.nodes)) if stretch is None else np.asarray(stretch, dtype=np.float64)
    events = event_times(plan, graph, stretch)
    problems = [
        ScheduleProblem(k + 1, plan.robots[plan.steps[k + 1].robot].name, "it comes before the step before", moment)
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
        present = plan.plan.states[state] != REMOVED
        doing = list(_doing(plan, graph, starts, factor, middle))
        moments = _moments(doing, begin, end, step)
        values = np.concatenate([arm.at(moments) for arm in doing], axis=1)
        samples += len(moments)
        for arm in doing:
            if arm.trajectory is None:
                continue
            loads = {other.robot: other.load for other in doing if other is not arm and other.load is not None}
            key = (arm.robot, id(arm.trajectory), state, *((k, load[0]) for k, load in loads.items()))
            if key not in prepared:
                prepared[key] = _prepare(plan, judge, arm, present, loads)
            pair = _first_hit(prepared[key], values)
            if pair is not None:
                row, names = pair
                what, name = f"{names[0]} meets {names[1]}", cell.robots[arm.robot].name
                problems.append(ScheduleProblem(arm.step, name, what, float(moments[row]), names))
    return problems, samples


def _doing(plan: RobotPlan, graph: TemporalPlanGraph, starts: Array, factor: Array, moment: float) -> Iterator[_Doing]:
    """Yield what each arm does at a moment."""
    apart = plan.direction is Direction.DISASSEMBLY
    for robot in range(graph.robots):
        mine = graph.of_robot(robot)
        past = [k for k in mine if starts[k] <= moment]
        rest = plan.keyframes[0].configurations[robot]
        for k in past:
            number = graph.nodes[k].trajectory
            if number is not None:
                rest = plan.steps[graph.nodes[k].step].trajectories[number].positions[-1]
        last = past[-1] if past else None
        running = last is not None and moment < starts[last] + factor[last] * graph.nodes[last].seconds
        following = next((k for k in mine if starts[k] > moment), None)
        # An arm that rests carries its part if it rests between two motions of one step.
        on_way = last is not None and following is not None and graph.nodes[last].step == graph.nodes[following].step
        source = last if running else following if on_way else None
        load, trajectory, at = None, None, 0 if last is None else graph.nodes[last].step
        if source is not None:
            at, number = graph.nodes[source].step, graph.nodes[source].trajectory
            moved = None if number is None else plan.steps[at].trajectories[number]
            if moved is not None and moved.part is not None:
                load = (moved.part, plan.keyframes[at + (0 if apart else 1)].configurations[robot])
            trajectory = moved if running else None
        begin, late = (0.0, 1.0) if last is None else (float(starts[last]), float(factor[last]))
        yield _Doing(robot, at, trajectory, begin, late, rest, load)


def _moments(doing: list[_Doing], begin: float, end: float, step: float) -> Array:
    """Return times from begin to end, so close that no joint moves farther than a step from one to the next."""
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
    arm: _Doing,
    present: NDArray[np.bool_],
    loads: dict[int, tuple[int, Array]],
) -> PreparedQuery:
    trajectory = arm.trajectory
    assert trajectory is not None
    carried, grip = (None, None) if arm.load is None else arm.load
    return judge.prepare(
        arm.robot,
        plan.keyframes[0].configurations,
        present,
        carried=carried,
        grip=grip,
        touches=trajectory.touches,
        at_place=carried is not None and trajectory.kind == "line",
        loads=loads,
    )


def _first_hit(query: PreparedQuery, values: Array) -> tuple[int, tuple[str, str]] | None:
    for row, entry in enumerate(values):
        query.values[:] = entry
        pair = query.hits(entry[query.slot])
        if pair is not None:
            return row, pair
    return None
