"""Temporal plan graph: the motions of all arms, and the precedences between them.

Nodes are motions from rest to rest, and instants at which a gripper closes on a part or opens. A precedence
lets one node begin only when another has reached an offset; a late arm delays those that wait for it, and nothing
else changes. Hönig et al., Multi-agent path finding with kinematic constraints (ICAPS 2016), for arms as in Huang et
al., APEX-MR (RSS 2025).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from falsework.errors import InputError, PlanError
from falsework.robots.model.shapes import Array
from falsework.utils.models import FileModel

Reason = Literal["arm", "state", "part", "volume"]


@dataclass(frozen=True)
class MotionNode:
    """Motion of one arm from rest to rest, or, without a trajectory, the instant at which a gripper closes or opens."""

    robot: int
    step: int
    """Step of the plan that it belongs to."""
    trajectory: int | None
    """Index of its trajectory in the step."""
    seconds: float
    """Nominal duration."""
    others: tuple[int, ...] = ()
    """Arms that move at the same instant: all of them begin, go on and end as one, whatever the delays."""

    @property
    def robots(self) -> tuple[int, ...]:
        """All arms that move."""
        return (self.robot, *self.others)


class Precedence(FileModel, frozen=True):
    """Precedence: motion `after` begins only when motion `before` has come to `offset`."""

    before: Annotated[int, Meta(ge=0)]
    offset: Annotated[float, Meta(ge=0)]
    """Seconds into the nominal motion of `before`, up to its duration."""
    after: Annotated[int, Meta(ge=0)]
    why: Reason
    """`arm`: the same arm; `state`: the structure must be in the state that the step needs; `part`: a part must have
    left its place or must not have reached it; `volume`: another arm must have left the swept volume."""


@dataclass(frozen=True, eq=False)
class TemporalPlanGraph:
    """Motions and precedences of a robot plan, with the times that follow from them."""

    nodes: tuple[MotionNode, ...]
    """Nodes in an order in which they can be executed one by one; those of an arm in its own order."""
    edges: tuple[Precedence, ...]
    robots: int
    lower_bound: float
    """Proven lower bound on the makespan of any order of these motions, seconds."""

    def __post_init__(self) -> None:
        for edge in self.edges:
            if not (0 <= edge.before < len(self.nodes) and 0 <= edge.after < len(self.nodes)):
                raise PlanError(
                    f"a precedence names motion {max(edge.before, edge.after)}, there are {len(self.nodes)}"
                )
            if not 0 <= edge.offset <= self.nodes[edge.before].seconds + 1e-6:
                raise PlanError(f"a precedence waits {edge.offset:g} s into a motion that is shorter; plan again")
        self.order  # noqa: B018 - raises where there is a cycle

    @cached_property
    def order(self) -> tuple[int, ...]:
        """Nodes so that each comes after all that it waits for; PlanError if motions wait for each other in a cycle."""
        sorter = TopologicalSorter(dict.fromkeys(range(len(self.nodes)), ()))
        for edge in self.edges:
            sorter.add(edge.after, edge.before)
        try:
            return tuple(sorter.static_order())
        except CycleError as error:
            step = self.nodes[min(error.args[1])].step + 1
            raise PlanError(f"motions wait for each other in a cycle, one of them in step {step}; plan again") from None

    @cached_property
    def _after(self) -> tuple[tuple[Precedence, ...], ...]:
        found: list[list[Precedence]] = [[] for _ in self.nodes]
        for edge in self.edges:
            found[edge.before].append(edge)
        return tuple(tuple(edges) for edges in found)

    def starts(self, stretch: ArrayLike | None = None) -> Array:
        """Return the start time of each node if every arm moves as soon as it may, seconds, shape (nodes,).

        Args:
            stretch: factor on the nominal duration of each motion, shape (nodes,); 1 by default.
        """
        factor = np.ones(len(self.nodes)) if stretch is None else np.asarray(stretch, dtype=np.float64)
        if factor.shape != (len(self.nodes),) or not (factor >= 1).all() or not np.isfinite(factor).all():
            raise InputError("delays must be finite and not negative: give one factor of at least 1 for each motion")
        found = np.zeros(len(self.nodes))
        for node in self.order:
            for edge in self._after[node]:
                found[edge.after] = max(found[edge.after], found[node] + factor[node] * edge.offset)
        return found

    @cached_property
    def durations(self) -> Array:
        """Nominal durations, seconds, shape (nodes,)."""
        return np.array([node.seconds for node in self.nodes])

    @cached_property
    def makespan(self) -> float:
        """Time at which the last motion ends without delays, seconds."""
        return float((self.starts() + self.durations).max(initial=0.0))

    @property
    def gap(self) -> float:
        """Share of the makespan by which it exceeds the lower bound."""
        return max(0.0, 1 - self.lower_bound / self.makespan) if self.makespan > 0 else 0.0

    @property
    def sequential(self) -> float:
        """Duration of the same motions one after the other, seconds."""
        return float(self.durations.sum())

    @property
    def busiest(self) -> float:
        """Duration of the motions of the busiest arm, a lower bound on any makespan, seconds."""
        work = (sum(node.seconds for node in self.nodes if robot in node.robots) for robot in range(self.robots))
        return float(max(work, default=0.0))

    def of_robot(self, robot: int) -> list[int]:
        """Return the nodes of one arm in order."""
        return [index for index, node in enumerate(self.nodes) if robot in node.robots]

    def reverse(self) -> TemporalPlanGraph:
        """Return the graph of the reverse plan: a wait for part of a motion becomes a wait for all of it.

        It is as safe, and may be slower than a graph made for that direction. A wait that costs much in one direction
        may cost nothing in the other, so that of the lower bound only the work of the busiest arm remains proven.
        """
        last = len(self.nodes) - 1
        steps = max((node.step for node in self.nodes), default=0)
        lots = [0] * (steps + 1)
        for node in self.nodes:
            lots[node.step] += node.trajectory is not None
        nodes = tuple(
            replace(
                node,
                step=steps - node.step,
                trajectory=None if node.trajectory is None else lots[node.step] - 1 - node.trajectory,
            )
            for node in reversed(self.nodes)
        )
        edges = tuple(
            Precedence(last - edge.after, self.nodes[edge.after].seconds, last - edge.before, edge.why)
            for edge in reversed(self.edges)
        )
        return TemporalPlanGraph(nodes, edges, self.robots, self.busiest)
