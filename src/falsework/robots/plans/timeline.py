"""Timeline of a robot plan: nodes of its temporal plan graph, its states, and the activity of each arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.state import States
from falsework.errors import PlanError
from falsework.robots.model.shapes import Array
from falsework.robots.plans.loads import Load, load_at_rest, load_of, moved_aside
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import MotionNode, Precedence, TemporalPlanGraph
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.problem.task import Direction


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
        free, held = 0.0, plan.in_hand(0)[robot]
        for index in graph.of_robot(robot):
            node = graph.nodes[index]
            if held is not None and starts[index] > free:
                found.append(Bar(robot, free, starts[index], "holds", held))
            free = starts[index] + node.seconds
            if node.trajectory is not None:
                part = plan.steps[node.step].of(robot)[node.trajectory].part
                found.append(Bar(robot, starts[index], free, "moves" if part is None else "carries", part))
                held = None
            if node.trajectory is None or node.trajectory == len(plan.steps[node.step].trajectories) - 1:
                held = plan.in_hand(node.step + 1)[robot]
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

    A part leaves its place when the motion that carries it begins, and is in place when that motion ends, moved aside
    and back too. A hold begins, and ends, at an instant of its own: an arm may wait with its gripper at the part.
    """
    nodes: list[MotionNode] = []
    events = []
    apart = plan.direction is Direction.DISASSEMBLY
    for index, step in enumerate(plan.steps):
        others = step.robots[1:]
        moves = [MotionNode(step.robot, index, k, t.seconds, others) for k, t in enumerate(step.trajectories)]
        grip = plan.grip(index)
        first = apart if grip is None else grip == "open"
        if moved_aside(plan, index):
            first = not bool((plan.standing[index + 1] & ~plan.standing[index]).any())
        if grip is not None or not moves:
            moves.insert(0 if first else len(moves), MotionNode(step.robot, index, None, 0.0))
        at_end = not first and moves[-1].trajectory is not None
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
    """Return the time of the event of each step, at which its state is reached, seconds, shape (steps,)."""
    factor = np.ones(len(graph.nodes)) if stretch is None else np.asarray(stretch, dtype=np.float64)
    starts = graph.starts(stretch)
    ends = starts + factor * graph.durations
    return np.array([(ends if event.at_end else starts)[event.node] for event in nodes_of(plan)[1]])


@lru_cache(maxsize=8)
def _events(plan: RobotPlan) -> Array:
    """Return `event_times` without delays, for what is asked at every frame."""
    return event_times(plan, schedule_of(plan))


@dataclass(frozen=True, eq=False)
class Segment:
    """Motion of an arm, or its rest between two nodes of the schedule."""

    robot: int
    step: int
    """Step of the plan that it belongs to, or that precedes the rest."""
    begun: int | None
    """Node of the graph begun last; None before the first."""
    count: int
    """Number of nodes of the arm that have begun."""
    trajectory: Trajectory | None
    """None: a rest."""
    rest: Array
    """Configuration at its end, shape (joints,)."""
    load: Load | None
    frames: frozenset[int]
    """Steps in the middle of which the arm rests there."""

    @property
    def high(self) -> float:
        """Progress at its end, of which a rest before motion i is 2 i, and the motion 2 i + 1 to 2 i + 2."""
        return 2.0 * self.count

    @property
    def low(self) -> float:
        """Progress at its beginning."""
        return self.high - (self.trajectory is not None)


@lru_cache(maxsize=8)
def segments_of(plan: RobotPlan) -> tuple[tuple[Segment, ...], ...]:
    """Return rests and motions of each arm of a plan in turn, a rest first and last and around each grip."""
    nodes = nodes_of(plan)[0]
    return tuple(tuple(_segments(plan, nodes, robot)) for robot in range(len(plan.robots)))


def _segments(plan: RobotPlan, nodes: Sequence[MotionNode], robot: int) -> Iterator[Segment]:
    values, last = plan.keyframes[0].configurations[robot], None
    own = [index for index, node in enumerate(nodes) if robot in node.robots]
    for count, index in enumerate((*own, None)):
        places = [None if k is None else (nodes[k].step, nodes[k].trajectory) for k in (last, index)]
        step, load = 0 if last is None else nodes[last].step, load_at_rest(plan, robot, *places)
        on_way = last is not None and index is not None and nodes[index].step == step
        yield Segment(robot, step, last, count, None, values, load, frozenset({step} if on_way else ()))
        if index is None:
            return
        last, step, number = index, nodes[index].step, nodes[index].trajectory
        if number is not None:
            trajectory = plan.steps[step].of(robot)[number]
            values, load = trajectory.positions[-1], load_of(plan, step, number, robot)
            yield Segment(robot, step, index, count + 1, trajectory, values, load, frozenset({step}))


@dataclass(frozen=True, eq=False)
class ArmActivity(Segment):
    """Motion or rest of one arm at an instant of a schedule."""

    begin: float
    """Time at which it begins, seconds."""
    stretch: float
    """Factor on its nominal duration."""

    def at(self, seconds: Array) -> Array:
        """Return joint values at given times, shape (samples, joints)."""
        if self.trajectory is None:
            return np.repeat(self.rest[None], len(seconds), axis=0)
        return self.trajectory.sample((seconds - self.begin) / self.stretch)


def activities_at(plan: RobotPlan, starts: Array, moment: float, factor: Array | None = None) -> Iterator[ArmActivity]:
    """Yield the activity of each arm at an instant, seconds, of a schedule with start times as of its graph.

    The durations of motions have factors, shape (nodes,); 1 by default.
    """
    graph = schedule_of(plan)
    factor = np.ones(len(graph.nodes)) if factor is None else factor
    ends = starts + factor * graph.durations
    for segments in segments_of(plan):
        now = segments[0]
        for entry in segments[1:]:
            assert entry.begun is not None
            if (starts if entry.trajectory is not None else ends)[entry.begun] > moment:
                break
            now = entry
        begin, late = (0.0, 1.0) if now.begun is None else (float(starts[now.begun]), float(factor[now.begun]))
        yield ArmActivity(**vars(now), begin=begin, stretch=late)


def waiting_at(plan: RobotPlan, moment: float) -> list[Load]:
    """Return the parts that wait half way out, in no gripper, at an instant, seconds."""
    if not plan.plan.waiting:
        return []
    row = int((_events(plan) <= moment).sum())
    return [Load(part, None, pose) for part, pose in plan.keyframes[row].waits]


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

    So are those that follow until nothing is left half way: until parts that were moved aside are back in place, a part
    has made all moves of its way, and one that is put down has been delivered, or is in place.

    Args:
        plan: the robot plan; without a schedule its motions come one after the other.
        seconds: time from its start.

    Raises:
        PlanError: a part is aside to the end.
    """
    graph, events = schedule_of(plan), nodes_of(plan)[1]
    starts = graph.starts()
    while True:
        begun = starts <= seconds
        row = int(sum(begun[event.node] for event in events))  # a motion begins after the events before its own
        aside = bool(plan.aside(row) or plan.keyframes[row].waits)
        left = [
            k
            for k, node in enumerate(graph.nodes)
            if not begun[k] and ((aside and node.step <= row) or (begun[k - 1] and _leads_on(plan, graph, k)))
        ]
        if not left:
            break
        seconds = float(starts[left].max())
    if aside:
        raise PlanError("a part that is moved aside never comes back, so the plan cannot be continued")
    held, configurations, grips = list(plan.keyframes[row].held), [], []
    for robot, segments in enumerate(segments_of(plan)):
        rest = [one for one in segments if one.trajectory is None and (one.begun is None or begun[one.begun])][-1]
        configurations.append(rest.rest)
        grips.append(None if rest.load is None else rest.load.grip)
        held[robot] = held[robot] if rest.load is None else rest.load.part
    return Interruption(plan.states[row], tuple(configurations), tuple(held), tuple(grips), int(plan.done[row]))


def _leads_on(plan: RobotPlan, graph: TemporalPlanGraph, index: int) -> bool:
    """Return whether a robot cannot stop before a node: in its step a part is put down, or it is between two moves."""
    node, former = graph.nodes[index], graph.nodes[index - 1]
    if not index or former.step != node.step:
        return False
    step, number = plan.steps[node.step], node.trajectory
    moves = step.trajectories[number - 1 : number + 1] if number else ()
    on_way = bool(moves) and all(leg.kind == "line" and leg.part is not None for leg in moves)
    return on_way or step.put_down is not None
