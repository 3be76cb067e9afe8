"""Commands of each arm of a robot plan, with the waits that keep the order across arms whatever the delays.

Each arm counts the motions that it has finished, and others wait for its count. A motion that the schedule starts
during another arm's motion starts at its end here: that adds waiting and keeps the order of all motions. An arm that
presses begins before another one opens its gripper, and goes on until it is open.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from falsework.robots.plans.loads import lying_motions, moved_aside
from falsework.robots.plans.robot_forces import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import nodes_of, schedule_of
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.problem.task import Direction

COUNT_FROM = 3
"""Count of an arm that has not finished any motion; 1 and 2 are handshake values before all arms are ready."""


@dataclass(frozen=True)
class Wait:
    """Command to wait until another arm reaches a count."""

    robot: int
    count: int


@dataclass(frozen=True)
class Grip:
    """Command to close or open the gripper."""

    close: bool


@dataclass(frozen=True)
class PublishCount:
    """Command to publish the count of this arm."""

    count: int


@dataclass(frozen=True)
class Begin:
    """Command that begins a step of the plan."""

    step: int


@dataclass(frozen=True)
class AtOnce:
    """Command to begin the next motion at the same instant as other arms, which have this command before theirs."""

    robots: tuple[int, ...]
    """All of them."""


@dataclass(frozen=True, eq=False)
class Pressing:
    """Command to begin a press, or to end it and stay there."""

    press: TimedPress
    begins: bool


Command = Wait | Grip | PublishCount | Begin | AtOnce | Pressing | Trajectory
Task = int | Pressing
"""Node of the schedule, by its index, or the beginning or end of a press."""


def events_of(plan: RobotPlan, step: int, robot: int | None = None) -> Iterator[Trajectory | Grip]:
    """Yield the motions of a robot, by default the first, in a step and the gripper actions around them, in time."""
    robot = plan.steps[step].robot if robot is None else robot
    grip, apart, moves = plan.grip(step), plan.direction is Direction.DISASSEMBLY, plan.steps[step].of(robot)
    before, after = plan.keyframes[step].load(robot) is not None, plan.keyframes[step + 1].load(robot) is not None
    if moved_aside(plan, step):
        yield from moves
        return
    if plan.steps[step].transit:
        has = [before or grip == "open", *(leg.part is not None for leg in moves), after or grip == "close"]
        for k, leg in enumerate((*moves, None)):
            if has[k] != has[k + 1]:
                yield Grip(has[k + 1])
            if leg is not None:
                yield leg
        return
    # Disassembly: hold = approach, close; release = open, retreat; remove = leave, carry, open. Assembly mirrors it.
    # A hand-over is a hold by one robot, then a release by the other. A part put down is gripped again on the way.
    # A part that is carried at a keyframe was gripped before, or stays in the gripper.
    first = not apart if grip is None else grip == "open"
    closes = not apart if grip is None else grip == "close"
    if first and not before:
        yield Grip(closes)
    lying = lying_motions(plan, step)
    for number, trajectory in enumerate(moves):
        if number in (lying.start, lying.stop) and lying:
            yield Grip(number == lying.stop)
        yield trajectory
    if not first and not after:
        yield Grip(closes)


def commands_of(plan: RobotPlan, robot: int, presses: Sequence[TimedPress] = ()) -> Iterator[Command]:
    """Yield the commands of one arm in order: motions, gripper actions, presses, waits and counts."""
    graph = schedule_of(plan)
    tasks, order = _tasks(plan, graph, presses)
    # What several arms do at once, the first of them waits for and counts.
    owner = {
        task: (arm, COUNT_FROM + 1 + k)
        for arm, own in enumerate(tasks)
        for k, task in enumerate(own)
        if isinstance(task, Pressing) or graph.nodes[task].robot == arm
    }
    heard, awaited = dict.fromkeys(range(graph.robots), COUNT_FROM), set()
    waits: dict[Task, list[Wait]] = {}
    for former, latter in order:
        (before, count), after = owner[former], owner[latter][0]
        if before != after and after == robot:
            waits.setdefault(latter, []).append(Wait(before, count))
        elif before != after and before == robot:
            awaited.add(former)
    step = -1
    left: list[Trajectory | Grip] = []
    for task in tasks[robot]:
        node = None if isinstance(task, Pressing) else graph.nodes[task]
        now = task.press.step if isinstance(task, Pressing) else graph.nodes[task].step
        if now != step:
            yield from left
            step = now
            left = [] if node is None else list(events_of(plan, step, robot))
            yield Begin(step)
        for wait in sorted(waits.get(task, []), key=lambda entry: (entry.robot, -entry.count)):
            if wait.count > heard[wait.robot]:
                heard[wait.robot] = wait.count
                yield wait
        if isinstance(task, Pressing):
            yield task
        if node is not None and node.others:
            yield AtOnce(node.robots)
        while left and node is not None:  # a grip without a node belongs to the motion before or after it
            event = left.pop(0)
            yield event
            if isinstance(event, Grip) == (node.trajectory is None):
                break
        if task in awaited and owner[task][0] == robot:
            yield PublishCount(owner[task][1])
    yield from left


def _tasks(
    plan: RobotPlan, graph: TemporalPlanGraph, presses: Sequence[TimedPress]
) -> tuple[list[list[Task]], list[tuple[Task, Task]]]:
    """Return the tasks of each arm in order, and pairs of which the first must be done before the second begins.

    A press begins once the state before its step is reached, and ends once the gripper of its step has opened.
    """
    tasks: list[list[Task]] = [[*graph.of_robot(arm)] for arm in range(graph.robots)]
    order: list[tuple[Task, Task]] = [(edge.before, edge.after) for edge in graph.edges]
    events = nodes_of(plan)[1]
    for press in presses:
        begin, end = Pressing(press, True), Pressing(press, False)
        own = tasks[press.robot]
        place = sum(isinstance(task, Pressing) or graph.nodes[task].step < press.step for task in own)
        own[place:place] = [begin, end]
        release = events[press.step].node
        order += [(begin, release), (release, end)]
        order += [(events[press.step - 1].node, begin)] if press.step else []
    return tasks, order
