"""Units of work of the robots of a plan: the steps with each part, their motions, and conflicts between motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.robots.kernels.coordination import Swept, conflicts
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment
from falsework.robots.keyframes.trajectory_assembly import timed_legs
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import Array
from falsework.robots.plans.loads import Load, LoadKey
from falsework.robots.plans.trajectory import Trajectory
from falsework.robots.schedule.swept_bodies import SweptBodies

Box = tuple[float, float, float, float, float, float]
"""Lower and upper corner of a box whose sides are parallel to the axes, metres."""


def box_of(swept: Swept) -> Box:
    """Return the box around swept bodies."""
    return (*swept.low.min(axis=0).tolist(), *swept.high.max(axis=0).tolist())


def are_far(one: Box, other: Box, margin: float) -> bool:
    """Return whether two boxes keep a distance along an axis."""
    return (
        one[0] > other[3] + margin
        or one[1] > other[4] + margin
        or one[2] > other[5] + margin
        or one[3] < other[0] - margin
        or one[4] < other[1] - margin
        or one[5] < other[2] - margin
    )


@dataclass(frozen=True, eq=False)
class ArmSweep:
    """Swept bodies of an arm in a motion or at rest."""

    swept: tuple[Swept, Swept]
    """In cells and in finer cells."""
    ends: Array
    """Seconds into the motion at which each cell ends."""
    margin: float
    """Clearance that the planner keeps from it, metres."""
    rest: bool

    @cached_property
    def box(self) -> Box:
        """Box around all of it."""
        return box_of(self.swept[0])


Wait = tuple[float, float]
"""Least delay of a motion after what another arm did, seconds: after the start of its motion, or the end of its rest,
where the plan is executed as a disassembly; and after its end where it is executed backwards, as an assembly. There the
earlier of two motions comes second, and the later must be over by then."""
NO_WAIT: Wait = (-np.inf, -np.inf)
"""Wait of motions without a conflict."""


@dataclass(frozen=True, eq=False)
class Leg:
    """Motion of an arm, and its rest after it."""

    segment: PathSegment
    body: ArmSweep
    seconds: float
    rest: ArmSweep
    absent: int
    """Parts that were not in place where it was planned, as bits."""
    waits: dict[ArmSweep, Wait] = field(default_factory=dict)
    """Known results of `Work.wait`."""
    meetings: dict[int, float] = field(default_factory=dict)
    """Known results of `Work.meets`."""


@dataclass(frozen=True, eq=False)
class Unit:
    """Consecutive steps of one arm with one part, usually a hold and a removal."""

    job: int
    """Index of the unit among those of the plan; the same for the units of other arms that may replace it."""
    robot: int
    part: int
    edges: tuple[Edge, ...]
    legs: tuple[tuple[list[Leg], ...], ...]
    """For each step its motions, each in one or more variants."""
    movable: bool
    """Whether it is a hold and a removal: others, and those with halves of hand-overs or a part put down on its way,
    depend on the steps before and after them."""

    @cached_property
    def seconds(self) -> tuple[float, ...]:
        """Duration of each step without waits."""
        return tuple(sum(variants[0].seconds for variants in step) for step in self.legs)

    @cached_property
    def duration(self) -> float:
        """Duration of all steps without waits."""
        return sum(self.seconds)

    @property
    def approaches(self) -> bool:
        """Whether its first motion leads from the last configuration of the robot to the part."""
        return self.edges[0].segments[0].kind == "free"


class Work:
    """Motions of the arms of a plan, and their conflicts, each computed once."""

    def __init__(self, graph: KeyframeGraph, timed: dict[PathSegment, Trajectory | None]) -> None:
        self.graph, self.timed = graph, timed
        self.bodies = SweptBodies(graph.world)
        self._rests: dict[tuple[int, bytes, LoadKey | None], ArmSweep] = {}
        self._boxes: dict[int, Box] = {}

    def units(self, root: Node, chain: Sequence[Edge]) -> list[Unit]:
        """Return the units of a plan in the order of their first steps."""
        parts, node, rests = len(root.state), root, self.rests(root)
        found: list[list[tuple[Edge, tuple[list[Leg], ...]]]] = []
        begun: dict[int, list[tuple[Edge, tuple[list[Leg], ...]]]] = {}
        for edge in chain:
            robot = edge.robot
            if (edge.action < parts and node.held[robot] != edge.action) or robot not in begun:
                begun[robot] = []
                found.append(begun[robot])
            legs = self.legs(node, edge, rests)
            begun[robot].append((edge, legs))
            if legs:
                rests[robot] = legs[-1][0].rest
            node = edge.node
        return [self._unit(job, steps, parts) for job, steps in enumerate(found)]

    def _unit(self, job: int, steps: Sequence[tuple[Edge, tuple[list[Leg], ...]]], parts: int) -> Unit:
        edges, legs = zip(*steps, strict=True)
        movable = len(edges) == 2 and edges[0].action < parts <= edges[1].action
        movable = movable and not any(edge.hands_over or edge.put_down is not None for edge in edges)
        return Unit(job, edges[0].robot, edges[0].action % parts, edges, legs, movable)

    def replacement(self, job: int, node: Node, part: int, robot: int, rests: Sequence[ArmSweep]) -> Unit | None:
        """Return the unit of another arm that takes a part at a keyframe; None if it cannot."""
        hold = next(self.graph.holds(node, part, robot), None)
        removal = None if hold is None else next(self.graph.edges(hold.node, len(node.state) + part), None)
        if hold is None or removal is None or removal.put_down is not None:
            return None
        rests, steps = list(rests), []
        for before, edge in ((node, hold), (hold.node, removal)):
            legs = self.legs(before, edge, rests)
            if not legs:
                return None
            rests[robot] = legs[-1][0].rest
            steps.append((edge, legs))
        return self._unit(job, steps, len(node.state))

    def legs(self, node: Node, edge: Edge, rests: Sequence[ArmSweep]) -> tuple[list[Leg], ...]:
        """Return the motions of an edge out of a keyframe, proven in its scene, as lists of one variant each."""
        found = []
        for k, (segment, load) in enumerate(zip(edge.segments, loads_of(node, edge), strict=True)):
            leg = self.leg(edge.robot, segment, load, node, rests, on_way=k + 1 < len(edge.segments))
            if leg is not None:
                found.append([leg])
        return tuple(found)

    def leg(
        self,
        robot: int,
        segment: PathSegment,
        load: Load | None,
        node: Node,
        rests: Sequence[ArmSweep],
        *,
        on_way: bool,
    ) -> Leg | None:
        """Return a motion that was planned at a keyframe, clear of arms at rest; None for one of zero length.

        `on_way`: the arm carries the part beyond its end.
        """
        cell = self.graph.cell
        if segment not in self.timed:
            (self.timed[segment],) = timed_legs([cell.robots[robot].model], [segment], cell.speed)
        trajectory = self.timed[segment]
        if trajectory is None:
            return None
        swept, ends = self.bodies.moving(robot, trajectory, load)
        absent = bits(~node.present) | (0 if load is None else 1 << load.part)
        margin = cell.margins.line if segment.kind == "line" else cell.margins.free
        rest = self.rest(robot, segment.path[-1], load if on_way else None)
        clear = {other: NO_WAIT for k, other in enumerate(rests) if k != robot}
        return Leg(segment, ArmSweep(swept, ends, margin, False), trajectory.seconds, rest, absent, clear)

    def rest(self, robot: int, values: Array, load: Load | None = None) -> ArmSweep:
        """Return the body of an arm at rest."""
        key = (robot, np.round(values, 9).tobytes(), None if load is None else load.key)
        if key not in self._rests:
            swept = self.bodies.resting(robot, values, load)
            self._rests[key] = ArmSweep((swept, swept), np.zeros(1), self.graph.cell.margins.free, True)
        return self._rests[key]

    def rests(self, node: Node) -> list[ArmSweep]:
        """Return the bodies of all arms at a keyframe."""
        return [self.rest(robot, values) for robot, values in enumerate(node.configurations)]

    def wait(self, leg: Leg, other: ArmSweep) -> Wait:
        """Return how long a motion, and the rest after it, has to wait for what another arm did before."""
        found = leg.waits.get(other)
        if found is None:
            forward, backward = NO_WAIT
            for mine in (leg.body, leg.rest):
                margin = min(mine.margin, other.margin)
                if are_far(mine.box, other.box, margin):
                    continue
                hit = conflicts(mine.swept, other.swept, margin)
                if hit.any():
                    free = leg.seconds if mine.rest else _before(leg.body.ends, int(hit.any(axis=1).argmax()))
                    forward = max(forward, float(other.ends[np.flatnonzero(hit.any(axis=0))[-1]]))
                    backward = max(backward, -free)
            found = leg.waits[other] = forward, backward
        return found

    def meets(self, leg: Leg, parts: int) -> float:
        """Return the seconds into a motion at which it first meets one of some parts, as bits; inf if it never does.

        Only parts count that were absent where it was planned.
        """
        parts &= leg.absent
        found = leg.meetings.get(parts)
        if found is None:
            lowest = parts & -parts
            if parts == lowest:
                found = self._meets(leg.body, parts.bit_length() - 1) if parts else np.inf
            else:
                found = min(self.meets(leg, lowest), self.meets(leg, parts ^ lowest))
            leg.meetings[parts] = found
        return found

    def _meets(self, body: ArmSweep, part: int) -> float:
        """Return the seconds into a motion at which it is first in conflict with a part in place; inf if never."""
        place = self.bodies.standing(part)
        if part not in self._boxes:
            self._boxes[part] = box_of(place)
        if are_far(body.box, self._boxes[part], body.margin):
            return np.inf
        hit = conflicts(body.swept, (place, place), body.margin)[:, 0]
        return _before(body.ends, int(hit.argmax())) if hit.any() else np.inf

    def replan(self, node: Node, unit: Unit, place: int, rests: Sequence[ArmSweep]) -> Leg | None:
        """Return another free motion of a step: to the part from where the arm is, or from the part to the same place.

        Args:
            node: the keyframe before the step.
            place: index of the step in it.
            rests: bodies of all arms there.
        """
        robot, edge = unit.robot, unit.edges[place]
        old, scene, here = next(s for s in edge.segments if s.kind == "free"), node.scene, node.configurations[robot]
        start, goal = here if old is edge.segments[0] else old.path[0], old.path[-1]
        if old.part is not None:
            tool = tool_pose(self.graph.cell.robots[robot], here)
            scene = scene.with_configuration(robot, here).with_attached(robot, old.part, tool)
        motion = self.graph.cache.motion(scene, robot, start, goal)
        if motion.path is None:
            return None
        view = self.graph.cache.view(scene, robot)
        segment = PathSegment("free", motion.path, part=old.part, view=view)
        load = None if old.part is None else Load(old.part, here, np.eye(4))
        return self.leg(robot, segment, load, node, rests, on_way=old is not edge.segments[-1])


def _before(ends: Array, cell: int) -> float:
    """Return when a cell of a motion begins, seconds into the motion."""
    return float(ends[cell - 1]) if cell else 0.0


def loads_of(node: Node, edge: Edge) -> list[Load | None]:
    """Return what an arm carries, or has put down, in each motion of an edge out of a keyframe."""
    carried = [segment.part for segment in edge.segments]
    if edge.put_down is None:
        grip = node.configurations[edge.robot]
        return [None if part is None else Load(part, grip, np.eye(4)) for part in carried]
    part, empty = edge.action - len(node.state), [k for k, part in enumerate(carried) if part is None]
    again = edge.segments[empty[-1]].path[-1]
    before = Load(part, node.configurations[edge.robot], np.eye(4))
    lying, after = Load(part, None, edge.put_down), Load(part, again, edge.put_down)
    return [before if k < empty[0] else lying if k <= empty[-1] else after for k in range(len(carried))]


def bits(parts: NDArray[np.bool_]) -> int:
    """Return a set of parts, shape (parts,), as bits."""
    return int.from_bytes(np.packbits(parts, bitorder="little").tobytes(), "little")
