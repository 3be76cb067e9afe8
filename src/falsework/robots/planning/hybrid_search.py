"""Search for abstract actions and motions together.

Depth-first search with backtracking. At every keyframe it tries the actions after which the structure can still be
disassembled, the most promising first, and requests a motion from the keyframe graph; without one, the action is
rejected with a reason. After some dead ends it restarts in another order, with all caches. Under the criterion
`contact` a plan whose replay in assembly order fails is rejected too: the failing state is forbidden, and the search
restarts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.robots.interleaving.reordering import reorder
from falsework.robots.keyframes.failure_report import Explanation, describe_failure, explain
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import DeadEnds, Edge, Node, PathSegment, route_along
from falsework.robots.keyframes.trajectory_assembly import make_robot_plan
from falsework.robots.motion.shortening import shorter_path
from falsework.robots.planning.action_ranking import ActionRanking, ExecutionHeuristic, FailedActions
from falsework.robots.planning.boundary_motions import BoundaryMotions
from falsework.robots.planning.hybrid_result import HybridProgress, HybridResult, HybridSettings, Progress
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.trajectory import Trajectory
from falsework.robots.schedule.solver import schedule_plan
from falsework.search.planner import MOST_FALLS
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.guide import Guide, MemoizedGuide
from falsework.search.problem.result import Outcome, SearchResult
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle

_EDGES_PER_ACTION = 3
"""Motions per action that are tried at a keyframe."""
_ACTIONS_PER_KEYFRAME = 8
"""Actions that are tried with motions at a keyframe before it counts as a dead end."""
_SOLVABILITY_CHECKS = 4
"""Solvability checks at one keyframe in the first search; later searches may make more."""
_LAST_VERDICTS = 400
"""Verdicts for such checks where no action has succeeded yet, before the keyframe counts as a dead end."""
_VARIATIONS = 4
"""Varied plans that are looked for before a search where excluded holds have left none."""
_POSTPONED_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Delays of missing parts that are tried in turn, as shares of the longest that stability alone allows."""

_LATE = "the deadline has passed"


class HybridSearch:
    """One search for a plan of robots between two keyframes; `plan_robots` makes it."""

    def __init__(
        self,
        graph: KeyframeGraph,
        task: Task,
        oracle: StabilityOracle,
        guide: Guide | None,
        settings: HybridSettings,
        progress: Progress | None,
        ends: BoundaryMotions,
        clock: Deadline,
        *,
        concurrent: bool = False,
        forces: bool = False,
    ) -> None:
        self.graph, self.task, self.oracle, self.ends, self.clock = graph, task, oracle, ends, clock
        self.assembly, self.cell, self.settings, self.progress = graph.assembly, graph.cell, settings, progress
        ease = ExecutionHeuristic(self.graph, None if guide is None else MemoizedGuide(guide))
        score = None if guide is None else ease
        self.solvability = SolvabilityCheck(
            self.assembly, task, oracle, guide=guide, score=score, seed=settings.seed, joint=self.graph.joint
        )
        self.ranking = ActionRanking(graph, ease, self.solvability)
        self.abstract: SearchResult | None = None
        self.best: list[Edge] = []
        self.tried: Counter[tuple[str, int]] = Counter()
        self.dead = self.graph.dead = DeadEnds()
        self.failures = FailedActions(self.graph, self.solvability)
        self.concurrent, self.forces = concurrent, forces
        self._timed: dict[PathSegment, Trajectory | None] = {}
        self.counts: Counter[str] = Counter()
        self.attempt = 0
        self.unreachable: list[int] | None = None
        self.fallen = ""  # where the replay of the last rejected plan fails, in words
        self._reported = 0.0

    def run(self, root: Node) -> HybridResult:
        """Find an abstract plan, then motions for it or for a similar one; end at the deadline."""
        try:
            with self.clock.interrupts():
                return self._search(root)
        except DeadlineExceeded:  # in a search for a way out
            return self.failed(root, "interrupted", _LATE)

    def _search(self, root: Node) -> HybridResult:
        self.abstract = self.solvability.prepare(lambda: self.clock.passed)
        if not self.abstract.found:
            if self.solvability.fallen is not None:
                self.fallen = describe_failure("plan", *self.solvability.fallen, self.assembly.names)
            proven, late = self.abstract.outcome is Outcome.PROVED_IMPOSSIBLE, self.clock.passed
            outcome = "proved_impossible" if proven else "interrupted" if late else "not_found"
            return self.failed(root, outcome, self.fallen or (_LATE if outcome == "interrupted" else ""))
        if self.task.is_done:
            return self.solved(root, [])
        limit = ""
        # Missing parts may have to come earlier than stability requires, so that the arms can insert them.
        shares = _POSTPONED_SHARES if any(self.solvability.postponed) else (1.0,)
        for share in shares:
            self.solvability.relax(share)
            self.dead.clear()
            for turn in range(self.settings.attempts if share == shares[-1] else 1):
                self.graph.allow_regrasp = self.task.allow_regrasp and self.attempt > 0
                if self.graph.allow_regrasp and self.attempt == 1:  # what failed without releases may succeed with them
                    self.dead.clear()
                    self.graph.joint.forget()
                    self.failures = FailedActions(self.graph, self.solvability)
                for again in range(_VARIATIONS if turn else 0):
                    self.solvability.perturb(self.attempt + again * self.settings.attempts)
                    if self.solvability.stays(root.state):
                        break
                chain = self.depth_first_search(root, np.random.default_rng([self.settings.seed, self.attempt]))
                self.attempt += 1
                if chain is not None:
                    return self.solved(root, chain)
                if self.counts["replays_fallen"] == MOST_FALLS:
                    return self.failed(root, "not_found", self.fallen)
                if self.clock.passed:
                    return self.failed(root, "interrupted", _LATE)
                if self._hopeless():
                    return self.failed(root, "not_found", "further search cannot succeed")
                limit = f"{self.attempt} searches failed{f'; {self.fallen}' if self.fallen else ''}"
        return self.failed(root, "not_found", limit)

    def depth_first_search(self, root: Node, rng: np.random.Generator) -> list[Edge] | None:
        """Return the edges of a plan with a stable replay by one depth-first search; None after too many dead ends."""
        chain: list[Edge] = []
        nodes, options = [root], [self.options(root, rng)]
        # Causes of the dead ends after each keyframe: indices of earlier edges.
        causes: list[set[int]] = [set()]
        stuck: set[bytes] = set()  # states at which the search went no further, with any grasps
        newest, allowed = root, self.settings.dead_ends * (1 + self.attempt // 3)

        def restart(keep: int) -> None:
            """Go on from the last of the first keyframes."""
            del nodes[keep:], options[max(keep - 1, 0) :], causes[keep:], chain[max(keep - 1, 0) :]
            options.extend(self.options(node, rng) for node in nodes[-1:])

        while nodes:
            if self.clock.passed:
                return None
            excluded = self.graph.joint.excluded
            edge = next(options[-1], None)
            if excluded < self.graph.joint.excluded and self.solvability.reroute(nodes[-1].state):
                options[-1] = self.options(nodes[-1], rng)
                continue
            if edge is None:
                self.dead.add(nodes[-1])
                if nodes[-1] is newest:  # others are left because of dead ends after them
                    stuck.add(newest.state.tobytes())
                if self._done(chain) >= self._done(self.best):
                    self.tried.update(self.failures.kinds(nodes[-1]))
                blamed = causes[-1] | self.failures.blamed(nodes[-1], chain)
                back = max(blamed, default=len(chain) - 1)
                del nodes[back + 1 :], options[back + 1 :], causes[back + 1 :], chain[max(back, 0) :]
                if nodes:
                    causes[-1] |= blamed - {back}
                self.counts["dead_ends"] += 1
                if len(stuck) > allowed:
                    return None
                if nodes and self.graph.joint.excluded and not self.solvability.stays(nodes[-1].state):
                    restart(self._extendable_keyframes(nodes))
                continue
            chain.append(edge)
            if self._done(chain) > self._done(self.best) and not edge.node.following:
                self.best = list(chain)
                self.tried.clear()
                stuck.clear()  # beyond them: another search would have to come here first
            self._report(len(stuck))
            ended = not (edge.node.carried or edge.node.following)
            if np.array_equal(edge.node.state, self.task.target) and ended:
                keep = self._keyframes_before_failure(root, chain)
                if keep is None:
                    return chain
                restart(keep)  # the plan up to the forbidden state remains valid: only its continuation changes
                continue
            newest = edge.node
            nodes.append(newest)
            options.append(self.options(newest, rng))
            causes.append(set())
        return None

    def _extendable_keyframes(self, nodes: Sequence[Node]) -> int:
        """Return how many keyframes of a chain to keep once its last state may no longer lead to the target.

        The steps back grow: to find no path takes a second or more, and tens in succession may have none.
        """
        for keep in sorted({max(len(nodes) - back, 1) for back in (0, 1, 5, 21, 85, len(nodes))}, reverse=True):
            state = nodes[keep - 1].state
            if not self.clock.passed and (self.solvability.stays(state) or self.solvability.reroute(state)):
                return keep
        return 0

    def _keyframes_before_failure(self, root: Node, chain: list[Edge]) -> int | None:
        """Replay a plan with motions and forbid the state in which the structure collapses; None if it succeeds.

        The result is the number of keyframes before that state, 0 if there is no other path.
        """
        route = route_along(root, chain)
        row = self.solvability.falls(route)
        if row is None:
            return None
        self.counts["replays_fallen"] += 1
        self.fallen = describe_failure(
            "plan with motions", route, row, self.assembly.names, self.counts["replays_fallen"]
        )
        self.best = []  # a plan that collapses is not returned as a partial plan either
        self.dead.clear()
        forbidden = self.solvability.forbid(route, row)
        if forbidden is None or self.counts["replays_fallen"] == MOST_FALLS:
            return 0
        first = len(route.actions) - forbidden
        acts = [not (edge.hands_over or edge.transit) for edge in chain]
        return int(np.searchsorted(np.cumsum([0, *acts]), first))

    def options(self, node: Node, rng: np.random.Generator) -> Iterator[Edge]:
        """Yield edges out of a keyframe in order of trial, without those that lead to dead ends."""
        return (edge for edge in self._edges(node, rng) if edge.node not in self.dead)

    def _edges(self, node: Node, rng: np.random.Generator) -> Iterator[Edge]:
        if node.following:
            yield node.following[0]
            return
        if node.handed is not None:  # the robot that held the part first leaves it to the other
            yield from self.graph.edges(node, node.handed)
            return
        if node.carried:  # after parts that left at the same instant
            yield from self.graph.joint_removals.deliveries(node)
            return
        tried, verdicts, probes, worked = 0, 0, _SOLVABILITY_CHECKS * (1 + self.attempt), False
        for action in self.ranking.actions(node, self.attempt, rng):
            if (node, action) in self.failures or self.clock.passed:
                continue
            if not self.solvability.known(node.state, action):
                # Where no action has succeeded yet, further checks are the cheapest way on, apart from backtracking.
                if (probes <= 0 and worked) or verdicts > _LAST_VERDICTS:
                    continue
                probes -= 1
            spent = self.solvability.joining.spent
            solvable = self.solvability.solvable(node.state, action)
            verdicts += self.solvability.joining.spent - spent
            if not solvable:
                self.counts["unsolvable"] += 1
                continue
            self.counts["actions"] += 1
            found = 0
            self.graph.reasons.recent.clear()
            for edge in islice(self.graph.edges(node, action), _EDGES_PER_ACTION):
                found += 1
                yield edge
            worked |= found > 0
            if not found:
                self.counts["rejected"] += 1
                if self.failures.add(node, action):
                    return
            tried += 1
            if tried == _ACTIONS_PER_KEYFRAME:
                break
        for part in self.failures.repairs(node):
            if self.clock.passed:
                return
            if node.can_release(part) and self.solvability.solvable(node.state, part):
                self.counts["releases"] += 1
                yield from self.graph.edges(node, part)
            else:  # where the structure would not stand, another robot holds the part before this one leaves it
                self.counts["hand_overs"] += 1
                yield from self.graph.take_over(node, part)

    def _done(self, chain: Sequence[Edge]) -> int:
        """Return the steps of disassembly that a chain has done; a release takes one back."""
        return int(self.task.steps_done(chain[-1].node.state)) if chain else 0

    def _hopeless(self) -> bool:
        """Return whether a part must leave that no robot can hold even when it is alone."""
        if self.unreachable is None:
            leaving = np.flatnonzero((self.task.target == REMOVED) & (self.task.start != REMOVED)).tolist()
            self.unreachable = [part for part in leaving if not self.graph.reachable(part)]
        return bool(self.unreachable)

    def _report(self, dead_ends: int) -> None:
        now = self.clock.seconds
        if self.progress is not None and now - self._reported > 0.1:
            self._reported = now
            self.progress(HybridProgress(self._done(self.best), self.task.steps, self.attempt, dead_ends, now))

    def solved(self, root: Node, chain: list[Edge]) -> HybridResult:
        """Certify a chain of edges and compute its trajectories."""
        plan = self._plan(root, chain)
        return HybridResult(plan, None, None, plan.statistics)

    def failed(self, root: Node, outcome: str, limit: str) -> HybridResult:
        """Explain why there is no plan, and return the partial one."""
        abstract = self.abstract is not None and not self.abstract.found
        why = explain(
            outcome,
            self._done(self.best),
            self.task.steps,
            self.graph.reasons,
            self.tried,
            [robot.name for robot in self.cell.robots],
            self.assembly.names,
            limit=limit,
            unreachable=self.unreachable or [],
            abstract=abstract,
        )
        part = None  # the beginning of a disassembly is no beginning of a continued assembly
        if self.best and not self.ends.fixed and self.solvability.falls(route_along(root, self.best)) is None:
            part = self._plan(root, self.best, why)
        statistics = self._statistics() if part is None else part.statistics
        return HybridResult(None, part, why, statistics, no_order=abstract)

    def _plan(self, root: Node, chain: list[Edge], why: Explanation | None = None) -> RobotPlan:
        statistics = self._statistics() | ({} if why is None else {"failure": why.to_dict()})
        plan = self._timed_plan(root, chain, whole=why is None)
        replay = None if plan.plan.replay is None else plan.plan.replay.to_dict()
        plan.statistics.update(statistics, seconds=round(self.clock.seconds, 3), replay=replay)
        return plan

    def _timed_plan(self, root: Node, chain: list[Edge], *, whole: bool) -> RobotPlan:
        """Certify the states along a chain of edges, compute its trajectories, and put them in the order of execution.

        A partial plan is scheduled as it is. Motions, which are searched for as disassembly, get their order here.
        """
        builds = self.settings.direction is Direction.ASSEMBLY
        if self.concurrent and whole:
            chain = self._shortened(chain)
            self._make(root, chain)
            given = {"legal": self.solvability.legal, "stop": lambda: self.clock.passed, "builds": builds}
            if not any(edge.partners or edge.transit for edge in chain):
                other = reorder(self.graph, self.oracle, root, chain, self._timed, **given)
                chain = other if not other or self.graph.accepts(other[-1]) else chain
            root, chain = self.ends.around(root, chain)
            chain = self._shortened(chain, done=self._timed)
        else:
            root, chain = self.ends.around(root, chain)
        plan = self._make(root, chain)
        plan = plan.reverse() if builds else plan
        return schedule_plan(plan, self.assembly, self.cell, parts=self.graph.parts) if self.concurrent else plan

    def _shortened(self, chain: list[Edge], done: Container[PathSegment] = frozenset()) -> list[Edge]:
        """Return edges whose free motions take less time where such are found, except for those that are done."""
        found, speed = [], self.cell.speed
        for k, edge in enumerate(chain):
            segments = list(edge.segments)
            for j, segment in enumerate(segments):
                if segment.view is not None and segment not in done:
                    path = shorter_path(segment.view, segment.path, speed, [self.settings.seed, k, j])
                    segments[j] = segment if path is segment.path else replace(segment, path=path)
            found.append(replace(edge, segments=tuple(segments)))
        return found

    def _make(self, root: Node, chain: list[Edge]) -> RobotPlan:
        task = self.ends.whole(self.solvability.task)
        given = (self.assembly, self.cell, task, self.oracle, root, chain)
        return make_robot_plan(*given, forces=self.forces, timed=self._timed)

    def _statistics(self) -> dict[str, Any]:
        return {
            "criterion": self.oracle.settings.criterion,
            "seed": self.settings.seed,
            "seconds": round(self.clock.seconds, 3),
            "attempts": self.attempt,
            **{key: self.counts[key] for key in ("dead_ends", "actions", "rejected", "unsolvable", "replays_fallen")},
            "solvable_states": len(self.solvability),
            "free_motions": self.graph.cache.motions,
            "free_motions_used_again": self.graph.cache.motions_kept,
            "verdicts": self.oracle.counters.asked,
            **({key: self.counts[key] for key in ("releases", "hand_overs")} if self.task.allow_regrasp else {}),
        }
