"""Positions that the arms of a temporal plan graph can have at the same time, whatever the delays.

The progress of an arm is a number: 2 i while it rests before motion i, 2 i + 1 when the motion begins, 2 i + 2 when it
ends. A motion begins only when every arm has made some least progress, its own waits and the waits of what it waits for
included. Two positions can therefore coincide if and only if each arm has made the progress that the motion begun last
by the other needs: the least progress of all arms that reaches both positions is then itself an execution. So the
positions of two motions that can coincide form a rectangle. Arms that move as one make equal progress in that motion:
its positions coincide only with each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from falsework.errors import PlanError
from falsework.robots.model.shapes import Array
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import Event, Segment, nodes_of, segments_of

_INSTANT = 1e-6
"""Times that differ by no more are equal, seconds; the rounding of files is finer."""


@dataclass(frozen=True)
class Overlap:
    """Positions of two segments that can coincide: all pairs of two ranges of progress."""

    one: Segment
    other: Segment
    one_range: tuple[float, float]
    other_range: tuple[float, float]

    @property
    def as_one(self) -> bool:
        """Whether both are one motion of several arms, or their rest within it: only equal progress coincides."""
        both_rest = self.one.trajectory is None and self.other.trajectory is None
        on_way = bool(self.one.frames and self.other.frames) if both_rest else self.one.trajectory is not None
        return self.one.begun is not None and self.one.begun == self.other.begun and on_way


class ReachablePositions:
    """Positions of all arms that can coincide under the schedule of a plan."""

    def __init__(self, plan: RobotPlan) -> None:
        """Compute the least progress of every arm when each motion begins; PlanError without a schedule."""
        graph = plan.schedule
        if graph is None:
            raise PlanError("the robot plan has no schedule whose delays could be checked; plan again, or schedule it")
        self.plan, self.graph = plan, graph
        self.events: tuple[Event, ...] = nodes_of(plan)[1]
        self._own = [graph.of_robot(robot) for robot in range(graph.robots)]
        self.begins = np.zeros((len(graph.nodes), graph.robots))
        """Progress at which each arm of a node begins it, shape (nodes, robots)."""
        for robot, nodes in enumerate(self._own):
            self.begins[nodes, robot] = 2 * np.arange(len(nodes)) + 1.0
        self.needed = np.zeros((len(graph.nodes), graph.robots))
        """Least progress of each arm when a node begins, shape (nodes, robots)."""
        self._before = np.zeros((len(graph.nodes), graph.robots))
        """Progress of each arm that a node waits for, shape (nodes, robots)."""
        self._find_least_progress()
        self._first = np.array([graph.nodes[event.node].robot for event in self.events], dtype=np.int64)
        """First arm of each event, shape (events,)."""
        self.reached = np.array([self.begins[event.node] + event.at_end for event in self.events])
        """Progress of each arm of an event when that happens, shape (events, robots)."""
        self.segments = segments_of(plan)

    def _find_least_progress(self) -> None:
        graph, found = self.graph, self.needed
        waits: list[list[tuple[int, float]]] = [[] for _ in graph.nodes]
        for edge in graph.edges:
            seconds = graph.nodes[edge.before].seconds
            done = edge.offset >= seconds - _INSTANT
            share = 0.0 if edge.offset <= _INSTANT else 1.0 if done else edge.offset / seconds
            waits[edge.after].append((edge.before, share))
        for index in graph.order:
            for before, share in waits[index]:
                np.maximum(found[index], found[before], out=found[index])
                for robot in graph.nodes[before].robots:
                    found[index, robot] = max(found[index, robot], self.begins[before, robot] + share)
            self._before[index] = found[index]
            own = list(graph.nodes[index].robots)
            found[index, own] = np.maximum(found[index, own], self.begins[index, own])

    def _needs(self, segments: Sequence[Segment], robot: int) -> Array:
        """Return the least progress of an arm in each segment of another, shape (segments,)."""
        found = np.zeros(len(segments))
        for k, segment in enumerate(segments):
            if segment.begun is not None:
                ended = segment.trajectory is None and robot in self.graph.nodes[segment.begun].robots
                found[k] = self.begins[segment.begun, robot] + 1 if ended else self.needed[segment.begun, robot]
        return found

    def overlaps(self, one: int, other: int) -> Iterator[Overlap]:
        """Yield all pairs of segments of two arms of which positions can coincide."""
        rows, columns = self.segments[one], self.segments[other]
        of_one, of_other = self._needs(columns, one), self._needs(rows, other)
        tops = np.array([entry.high for entry in rows])[:, None] >= of_one[None]
        sides = np.array([entry.high for entry in columns])[None] >= of_other[:, None]
        for i, j in np.argwhere(tops & sides).tolist():
            a, b = rows[i], columns[j]
            low, side = max(a.low, float(of_one[j])), max(b.low, float(of_other[i]))
            # The end of a motion alone is the rest that follows, of which the load may be put down.
            if (low < a.high or a.trajectory is None) and (side < b.high or b.trajectory is None):
                yield Overlap(a, b, (low, a.high), (side, b.high))

    def out_of_order(self) -> list[tuple[int, str]]:
        """Return the nodes that a delay can bring before what they must follow, motion or state, and what that is."""
        found = []
        for arm, nodes in enumerate(self._own):
            for before, after in pairwise(nodes):
                end = self.begins[before, arm] + (self.graph.nodes[before].seconds > 0)
                if self._before[after, arm] < end:
                    found.append((after, "its motion does not wait for the motion before"))
        for k, (before, after) in enumerate(pairwise(self.events)):
            robot, same = self.graph.nodes[before.node].robot, before.node == after.node
            if not same and self.needed[after.node, robot] < self.reached[k, robot]:
                found.append((after.node, "it does not wait for the state of the previous step"))
        return found

    def present(self, segment: Segment) -> list[tuple[float, float, int, int]]:
        """Return ranges of progress of a motion, and the first and the last keyframe that can hold in each.

        The end of a range is included only as a limit: what happens when the motion ends belongs to the rest after it.
        """
        robot, count = segment.robot, len(self.events)
        arms = self._first
        must = np.zeros(self.graph.robots) if segment.begun is None else self.needed[segment.begun]
        happened = must[arms] >= self.reached[np.arange(count), arms]
        first = count if happened.all() else int(np.argmin(happened))
        # The progress of this arm without which an event cannot happen.
        needs = np.array([self.needed[event.node, robot] for event in self.events])
        own = np.array([robot in self.graph.nodes[event.node].robots for event in self.events], dtype=bool)
        needs[own] = np.maximum(needs[own], self.reached[own, robot])
        cuts = np.unique(np.clip(needs[first:], segment.low, segment.high))
        cuts = np.unique(np.concatenate([[segment.low], cuts, [segment.high]]))
        found = list[tuple[float, float, int, int]]()
        for low, high in pairwise(cuts.tolist()):
            last = first + int((needs[first:] <= low).sum())
            found.append((low, high, first, last))
        return found

    def contains(self, starts: Array, factor: Array) -> bool:
        """Return whether an execution with start times and factors of durations passes only through these positions."""
        ends = starts + factor * self.graph.durations
        for robot, own in enumerate(self._own):
            if not own:
                continue
            place = np.searchsorted(starts[own], starts + _INSTANT, side="right") - 1
            index = np.asarray(own)[np.maximum(place, 0)]
            span = np.maximum(ends[index] - starts[index], _INSTANT)
            made = self.begins[index, robot] + np.clip((starts - starts[index] + _INSTANT) / span, 0.0, 1.0)
            if (np.where(place < 0, 0.0, made) < self.needed[:, robot] - 1e-9).any():
                return False
        return True
