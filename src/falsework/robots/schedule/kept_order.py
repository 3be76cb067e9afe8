"""Makespans of a schedule in which one motion is replaced, while the order of all conflicts stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.robots.kernels.coordination import conflicts
from falsework.robots.plans.robot_plan import Trajectory
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.schedule.conflicts import is_proven, margin_of
from falsework.robots.schedule.itinerary import Itineraries, Stretch
from falsework.robots.schedule.occupancy import Span, spans

Array = NDArray[np.float64]

_Wait = tuple[int, float, int]
"""Node before, offset into it, node after."""
_NEVER: _Wait = (0, np.inf, 0)
"""Wait for an arm that rests there for ever."""


class KeptOrder:
    """Schedule whose conflicts are decided: of each two motions or rests of two arms one goes first.

    A graph has only the longest wait between two nodes. Where that is one for space, a shorter one of another kind is
    missing here, and a makespan with another motion may come out too short: it is an estimate.
    """

    def __init__(self, rows: Itineraries, graph: TemporalPlanGraph) -> None:
        """Find the waits of all pairs of motions and rests.

        Args:
            rows: itineraries of the plan.
            graph: a schedule of it.
        """
        self.rows, self.graph = rows, graph
        starts = graph.starts()
        self.spans = [list(spans(rows, starts, robot)) for robot in range(graph.robots)]
        self.fixed = [(edge.before, edge.offset, edge.after) for edge in graph.edges if edge.why != "volume"]
        self.waits: dict[tuple[int, int], _Wait] = {}
        """Of pairs of stretches in conflict, by their identities."""
        for one in range(graph.robots):
            for other in range(one + 1, graph.robots):
                for a in self.spans[one]:
                    for b in self.spans[other]:
                        if _may_meet(a.stretch, b.stretch):
                            margin = min(margin_of(rows, a.stretch), margin_of(rows, b.stretch))
                            wait = _wait(a, b, rows.conflicts(a.stretch, b.stretch, margin))
                            if wait is not None and wait is not _NEVER:
                                self.waits[id(a.stretch), id(b.stretch)] = wait

    def without(self, node: int) -> tuple[Array, Array]:
        """Return start times and tails of all nodes where nothing waits for one of them; both of shape (nodes,).

        The tail of a node is the time from its start to the end of all that waits for it, in seconds.
        """
        graph = self.graph
        after: list[list[tuple[float, int]]] = [[] for _ in graph.nodes]
        for one, offset, other in (*self.fixed, *self.waits.values()):
            if node not in (one, other):
                after[one].append((offset, other))
        starts, tails = [0.0] * len(after), graph.durations.tolist()
        for one in graph.order:
            for offset, other in after[one]:
                starts[other] = max(starts[other], starts[one] + offset)
        for one in reversed(graph.order):
            for offset, other in after[one]:
                tails[one] = max(tails[one], offset + tails[other])
        return np.array(starts), np.array(tails)


class Replacement:
    """One motion of a schedule, and what other motions in its place would bring.

    Only waits of the motion itself, and for it, differ then. With start times and tails of all other nodes as if it did
    not exist, the makespan follows from these waits alone.
    """

    def __init__(self, order: KeptOrder, node: int) -> None:
        """Separate the motion from all others.

        Args:
            order: the schedule.
            node: the motion.
        """
        self.order, self.node, rows = order, node, order.rows
        robot, self._seconds = rows.nodes[node].robot, rows.nodes[node].seconds
        self._span = next(span for span in order.spans[robot] if span.stretch.node == node)
        self._starts, self._tails = order.without(node)
        self._least = float((self._starts + self._tails).max())
        self._load, mine = rows.load(node), self._span.stretch
        others = [span for other, row in enumerate(order.spans) if other != robot for span in row]
        others = [span for span in others if _may_meet(mine, span.stretch)]

        def urgency(span: Span) -> float:
            wait = order.waits.get((id(mine), id(span.stretch))) or order.waits.get((id(span.stretch), id(mine)))
            return 0.0 if wait is None else -float(self._starts[wait[0]] + wait[1] + self._tails[wait[2]])

        # The conflicts that decide about the makespan first: most candidates are rejected for them.
        self._others = [
            (span, min(margin_of(rows, mine), margin_of(rows, span.stretch))) for span in sorted(others, key=urgency)
        ]

    def makespan(self, motion: Trajectory, limit: float) -> float:
        """Return the makespan with another motion, or infinity where it is not below a limit, seconds."""
        rows, node = self.order.rows, self.node
        begin, tail = 0.0, motion.seconds
        for before, offset, after in self.order.fixed:
            if after == node:
                begin = max(begin, self._starts[before] + offset)
            elif before == node:
                ends = offset >= self._seconds - 1e-9
                tail = max(tail, (motion.seconds if ends else min(offset, motion.seconds)) + self._tails[after])
        if max(self._least, begin + tail) >= limit:
            return np.inf
        swept, ends = rows.bodies.moving(rows.nodes[node].robot, motion, self._load)
        mine = replace(self._span, stretch=replace(self._span.stretch, swept=swept, ends=ends, cells=len(ends)))
        low, high = swept[0].low.min(axis=0), swept[0].high.max(axis=0)
        for other, margin in self._others:
            bodies = other.stretch.swept
            if (low > bodies[0].high.max(axis=0) + margin).any() or (high < bodies[0].low.min(axis=0) - margin).any():
                continue
            wait = _wait(mine, other, conflicts(swept, bodies, margin))
            if wait is None:
                continue
            if wait is _NEVER:
                return np.inf
            if wait[2] == node:
                begin = max(begin, self._starts[wait[0]] + wait[1])
            else:
                tail = max(tail, wait[1] + self._tails[wait[2]])
            if begin + tail >= limit:
                return np.inf
        return float(max(self._least, begin + tail))


def _may_meet(one: Stretch, other: Stretch) -> bool:
    return not (one.after >= other.before or other.after >= one.before or is_proven(one, other))


def _wait(one: Span, other: Span, table: NDArray[np.bool_]) -> _Wait | None:
    """Return the wait of the later of two motions or rests in conflict, of which the table has the cells; else None."""
    if not table.any():
        return None
    if (one.begin, one.end) > (other.begin, other.end):
        one, other, table = other, one, table.T
    stretch, offset = one.stretch, 0.0
    if stretch.node is not None:
        offset = float(stretch.ends[np.flatnonzero(table.any(axis=1))[-1]])
    if one.ahead is None or other.last is None:
        return _NEVER
    return one.ahead, offset, other.last
