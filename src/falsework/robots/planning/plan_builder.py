"""Timed robot plan of a chain of edges, in the order of execution, for robots that move at the same time or in turn.

This is where motions, which are searched for as disassembly, are put in the order in which they are executed.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace

from falsework.robots.interleaving.reordering import reorder
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import Edge, Node, PathSegment
from falsework.robots.keyframes.trajectory_assembly import make_robot_plan
from falsework.robots.motion.shortening import shorter_path
from falsework.robots.planning.boundary_motions import BoundaryMotions
from falsework.robots.planning.hybrid_result import HybridSettings
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.schedule.build import schedule_plan
from falsework.search.problem.task import Direction
from falsework.stability.oracle import StabilityOracle


class PlanBuilder:
    """Plans of the chains of one search; trajectories are computed once."""

    def __init__(
        self,
        graph: KeyframeGraph,
        oracle: StabilityOracle,
        solvability: SolvabilityCheck,
        ends: BoundaryMotions,
        settings: HybridSettings,
        stop: Callable[[], bool],
        *,
        concurrent: bool = False,
        forces: bool = False,
    ) -> None:
        """Make plans of the edges of `graph`.

        Args:
            graph: keyframes of the structure in the cell.
            oracle: decides stability.
            solvability: the task, and the actions that its rules allow.
            ends: motions before and after the chains.
            settings: order and seed.
            stop: tells when to end with the order found so far.
            concurrent: whether robots move at the same time.
            forces: whether plans keep the forces that prove their states.
        """
        self.graph, self.oracle, self.solvability = graph, oracle, solvability
        self.ends, self.settings, self.stop = ends, settings, stop
        self.concurrent, self.forces = concurrent, forces
        self._timed: dict[PathSegment, Trajectory | None] = {}

    def plan(self, root: Node, chain: list[Edge], *, whole: bool) -> RobotPlan:
        """Certify the states along a chain of edges, compute its trajectories, and put them in their order.

        Args:
            root: the first keyframe.
            chain: the edges.
            whole: whether the chain reaches the target; a partial plan is scheduled as it is.
        """
        builds = self.settings.direction is Direction.ASSEMBLY
        if self.concurrent and whole:
            chain = self._shortened(chain)
            self._make(root, chain)
            given = {"legal": self.solvability.legal, "stop": self.stop, "builds": builds}
            other = reorder(self.graph, self.oracle, root, chain, self._timed, **given)
            chain = other if not other or self.graph.accepts(other[-1]) else chain
            root, chain = self.ends.around(root, chain)
            chain = self._shortened(chain, done=self._timed)
        else:
            root, chain = self.ends.around(root, chain)
        plan = self._make(root, chain)
        plan = plan.reverse() if builds else plan
        if not self.concurrent:
            return plan
        return schedule_plan(plan, self.graph.assembly, self.graph.cell, parts=self.graph.parts)

    def _shortened(self, chain: list[Edge], done: Container[PathSegment] = frozenset()) -> list[Edge]:
        """Return edges whose free motions take less time where such are found, except for those that are done."""
        found, speed = [], self.graph.cell.speed
        for k, edge in enumerate(chain):
            segments = list(edge.segments)
            for j, segment in enumerate(segments):
                if segment.view is not None and segment not in done:
                    path = shorter_path(segment.view, segment.path, speed, [self.settings.seed, k, j])
                    segments[j] = segment if path is segment.path else replace(segment, path=path)
            found.append(replace(edge, segments=tuple(segments)))
        return found

    def _make(self, root: Node, chain: list[Edge]) -> RobotPlan:
        task, forces = self.ends.whole(self.solvability.task), self.forces
        cell, assembly = self.graph.cell, self.graph.assembly
        return make_robot_plan(assembly, cell, task, self.oracle, root, chain, forces=forces, timed=self._timed)
