"""Timeline of a robot plan: nodes of its temporal plan graph, its states, and the activity of each arm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import States
from falsework.robots.plans.loads import Load, load_at_rest, load_of
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.temporal_graph import MotionNode, Precedence, TemporalPlanGraph
from falsework.search.problem.task import Direction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArmShares:
    """Shares of the makespan that one arm spends in each activity."""

    robot: str
    moves: float
    holds: float
    """Rests while holding a part in place."""
    waits: float


@dataclass(frozen=True)
class Bar:
    """Activity of one arm during an interval of its plan."""

    robot: int
    begin: float
    end: float
    """Seconds from the start of the plan."""
    does: Literal["moves", "carries", "holds"]
    part: int | None


def bars_of(plan: RobotPlan) -> list[Bar]:
    """Return the activities of the arms of a plan; between two bars of an arm it waits.

    A plan without a schedule is shown one motion after the other.
    """
    graph = schedule_of(plan)
    starts, found = graph.starts().tolist(), []
    for robot in range(len(plan.robots)):
        free, held = 0.0, plan.keyframes[0].held[robot]
        for index in graph.of_robot(robot):
            node = graph.nodes[index]
            if held is not None and starts[index] > free:
                found.append(Bar(robot, free, starts[index], "holds", held))
            free = starts[index] + node.seconds
            if node.trajectory is not None:
                part = plan.steps[node.step].trajectories[node.trajectory].part
                found.append(Bar(robot, starts[index], free, "moves" if part is None else "carries", part))
                held = None
            if node.trajectory is None or node.trajectory == len(plan.steps[node.step].trajectories) - 1:
                held = plan.keyframes[node.step + 1].held[robot]
        if held is not None and plan.makespan > free:
            found.append(Bar(robot, free, plan.makespan, "holds", held))
    return found


def arm_shares(plan: RobotPlan) -> list[ArmShares]:
    """Return the shares of time that every arm of a plan spends in each activity."""
    total, spent = max(plan.makespan, 1e-12), np.zeros((len(plan.robots), 2))
    for bar in bars_of(plan):
        spent[bar.robot, int(bar.does == "holds")] += (bar.end - bar.begin) / total
    return [
        ArmShares(record.name, float(moves), float(holds), max(0.0, float(1 - moves - holds)))
        for record, (moves, holds) in zip(plan.robots, spent, strict=True)
    ]


@dataclass(frozen=True)
class Event:
    """Instant at which the structure changes its state, or a part its robot: the beginning or the end of a node."""

    node: int
    at_end: bool


def nodes_of(plan: RobotPlan) -> tuple[tuple[MotionNode, ...], tuple[Event, ...]]:
    """Return the nodes of a plan in its own order, and the event of each of its steps.

    A part leaves its place when the motion that carries it begins, and is in place when that motion ends. A hold
    begins, and ends, at an instant of its own: an arm may wait with its gripper at the part.
    """
    nodes: list[MotionNode] = []
    events = []
    apart = plan.direction is Direction.DISASSEMBLY
    for index, step in enumerate(plan.steps):
        moves = [MotionNode(step.robot, index, k, t.seconds) for k, t in enumerate(step.trajectories)]
        grip = plan.grip(index)
        first = apart if grip is None else grip == "open"
        if grip is not None or not moves:
            moves.insert(0 if first else len(moves), MotionNode(step.robot, index, None, 0.0))
        at_end = not (apart or first or moves[-1].trajectory is None)
        events.append(Event(len(nodes) + (0 if first else len(moves) - 1), at_end))
        nodes += moves
    return tuple(nodes), tuple(events)


def schedule_of(plan: RobotPlan) -> TemporalPlanGraph:
    """Return the schedule of a plan, or one in which every motion waits for the previous one."""
    if plan.schedule is not None:
        return plan.schedule
    nodes, _ = nodes_of(plan)
    edges = tuple(Precedence(k, nodes[k].seconds, k + 1, "state") for k in range(len(nodes) - 1))
    return TemporalPlanGraph(nodes, edges, len(plan.robots), 0.0)


def event_times(plan: RobotPlan, graph: TemporalPlanGraph, stretch: ArrayLike | None = None) -> Array:
    """Return the time of the event of each step, at which its state is reached, seconds, shape (steps,).

    Args:
        plan: the robot plan.
        graph: its schedule.
        stretch: as for `TemporalPlanGraph.starts`.
    """
    factor = np.ones(len(graph.nodes)) if stretch is None else np.asarray(stretch, dtype=np.float64)
    starts = graph.starts(stretch)
    ends = starts + factor * graph.durations
    return np.array([(ends if event.at_end else starts)[event.node] for event in nodes_of(plan)[1]])


@dataclass(frozen=True, eq=False)
class ArmActivity:
    """Motion or rest of one arm at an instant of a schedule."""

    robot: int
    step: int
    trajectory: Trajectory | None
    """None: the arm rests."""
    begin: float
    stretch: float
    rest: Array
    """Configuration of rest, shape (joints,)."""
    load: Load | None

    def at(self, seconds: Array) -> Array:
        """Return joint values at given times, shape (samples, joints)."""
        if self.trajectory is None:
            return np.repeat(self.rest[None], len(seconds), axis=0)
        return self.trajectory.sample((seconds - self.begin) / self.stretch)


def activities_at(plan: RobotPlan, starts: Array, moment: float, factor: Array | None = None) -> Iterator[ArmActivity]:
    """Yield the activity of each arm at an instant of the schedule of a plan.

    Args:
        plan: the robot plan; without a schedule its motions come one after the other.
        starts: start time of each node, as `TemporalPlanGraph.starts` returns it.
        moment: seconds from the start of the schedule.
        factor: factor on the duration of each motion, shape (nodes,); 1 by default.
    """
    graph = schedule_of(plan)
    factor = np.ones(len(graph.nodes)) if factor is None else factor
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
        before, after = (
            None if k is None else (graph.nodes[k].step, graph.nodes[k].trajectory) for k in (last, following)
        )
        at, number = (0, None) if before is None else before
        trajectory = plan.steps[at].trajectories[number] if running and number is not None else None
        load = load_of(plan, at, number) if running else load_at_rest(plan, robot, before, after)
        begin, late = (0.0, 1.0) if last is None else (float(starts[last]), float(factor[last]))
        yield ArmActivity(robot, at, trajectory, begin, late, rest, load)


@dataclass(frozen=True, eq=False)
class Interruption:
    """Structure and arms where a plan was interrupted between motions."""

    state: States
    """What stands, and is held; shape (parts,)."""
    configurations: tuple[Array, ...]
    """Joint values of every arm."""
    held: tuple[int | None, ...]
    """The part that each arm holds in place, or carries."""
    gripped: tuple[Array | None, ...]
    """For each arm that carries a part, the configuration in which it would hold it at its place."""
    done: int
    """Actions of the plan that are done."""


def interruption(plan: RobotPlan, seconds: float) -> Interruption:
    """Return where a plan stands that is interrupted at a time; motions that have begun then are finished.

    Args:
        plan: the robot plan; without a schedule its motions come one after the other.
        seconds: time from its start.
    """
    graph = schedule_of(plan)
    begun = graph.starts() <= seconds
    row = int(sum(begun[event.node] for event in nodes_of(plan)[1]))  # a motion begins after the events before its own
    frame = plan.keyframes[row]
    configurations, held = list(frame.configurations), list(frame.held)
    grips: list[Array | None] = [None] * graph.robots
    for robot in range(graph.robots):
        mine = graph.of_robot(robot)
        last = next((k for k in reversed(mine) if begun[k]), None)
        following = next((k for k in mine if not begun[k]), None)
        moved = [k for k in mine if begun[k] and graph.nodes[k].trajectory is not None]
        configurations[robot] = plan.keyframes[0].configurations[robot]
        if moved:
            node = graph.nodes[moved[-1]]
            assert node.trajectory is not None
            configurations[robot] = plan.steps[node.step].trajectories[node.trajectory].positions[-1]
        places = (None if k is None else (graph.nodes[k].step, graph.nodes[k].trajectory) for k in (last, following))
        load = load_at_rest(plan, robot, *places)
        if load is not None:
            held[robot], grips[robot] = load.part, load.grip
    return Interruption(plan.states[row], tuple(configurations), tuple(held), tuple(grips), int(plan.done[row]))
