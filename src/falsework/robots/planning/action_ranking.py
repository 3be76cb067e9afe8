"""Choice of actions: ease of execution plus an action heuristic, actions that failed, and holds to exchange."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np

from falsework.assembly.state import HELD, Mask, States
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.keyframes.keyframes import Edge, Node, removed_by
from falsework.robots.model.shapes import Array
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction


class ExecutionHeuristic:
    """Score of the actions of a state: ease of execution by arms, plus an action heuristic.

    Removals come first, since they free a robot; then unblocked and high parts. The heuristic knows stability, not
    reachability: a policy followed alone leads to states where no part can be withdrawn.
    """

    def __init__(self, graph: KeyframeGraph, guide: Guide | None) -> None:
        """Add an action heuristic, such as a trained policy, to the ease of execution."""
        self.graph, self.guide = graph, guide
        heights = graph.parts.center[:, 2]
        self._lowest, self._height = float(heights.min()), float(np.ptp(heights)) + 1e-9

    def __call__(self, states: States, actions: Mask) -> Array:
        """Return scores as `solvability.ActionScore`: shapes (batch, parts) and (batch, 2 parts), the latter out."""
        scores = self.guided(states, actions)
        for row, action in zip(*(index.tolist() for index in np.nonzero(actions)), strict=True):
            scores[row, action] += self.of(states[row], action)
        return scores

    def guided(self, states: States, actions: Mask) -> Array:
        """Return the scores of the action heuristic; zeros without one. Shapes as those of a call."""
        if self.guide is None:
            return np.zeros(actions.shape)
        return np.array(self.guide(states, actions, Direction.DISASSEMBLY), dtype=np.float64)

    def of(self, state: States, action: int) -> float:
        """Estimate how easy one action is, independent of the robots' configurations."""
        if action >= len(state):
            return 100.0
        height = float(self.graph.parts.center[action, 2] - self._lowest) / self._height
        return 2.0 * height - 5.0 * min(self.graph.blocked_by(action, state), 4)


class ActionRanking:
    """Order of the legal actions of keyframes."""

    def __init__(self, graph: KeyframeGraph, ease: ExecutionHeuristic, solvability: SolvabilityCheck) -> None:
        self.graph, self.ease, self.solvability = graph, ease, solvability
        self._width = float(np.ptp(graph.parts.center[:, :2], axis=0).max()) + 1e-9

    def actions(self, node: Node, attempt: int, rng: np.random.Generator) -> list[int]:
        """Return the legal actions in order of trial: easy ones near a free robot and far from busy ones.

        Releases are among them, first, only where the abstract plan needs them. Later attempts are perturbed more.
        """
        releases = [part for part in self.solvability.planned_releases(node.state) if not node.was_released(part)]
        actions = self.solvability.legal(node.state)
        if not actions:
            return releases
        single = [action for action in actions if action < 2 * len(node.state)]  # those of sets come last
        allowed: Mask = np.zeros((1, 2 * len(node.state)), dtype=bool)
        allowed[0, single] = True
        scores = np.array([self._score(node, action) for action in actions])
        scores[: len(single)] += self.ease.guided(node.state[None], allowed)[0, single]
        scores += rng.normal(size=len(actions)) * (0.1 if attempt == 0 else 0.4 * min(attempt, 4))
        ordered = [actions[k] for k in np.argsort(-scores, kind="stable")]
        return releases + ordered

    def _score(self, node: Node, action: int) -> float:
        # Known results cost nothing; a part with blocked exits is worse than an unknown result.
        score = 3.0 * self.solvability.preferred(node.state, action) + self.solvability.known(node.state, action)
        score += self.ease.of(node.state, action)
        if action >= len(node.state):
            return score
        center = self.graph.parts.center[action]
        robots = self.graph.cell.robots
        free = [robot for robot, held in enumerate(node.held) if held is None]
        score -= min(float(np.linalg.norm(robots[robot].base[:2, 3] - center[:2])) / self._width for robot in free)
        for part in node.held:
            if part is not None:
                apart = float(np.linalg.norm(self.graph.parts.center[part] - center)) / self._width
                score += min(apart, 1.0)
        return score


class FailedActions:
    """Actions without a motion, each with the robots that block it.

    Conflict-directed backjumping: Prosser, Hybrid algorithms for the constraint satisfaction problem (1993).
    """

    def __init__(self, graph: KeyframeGraph, solvability: SolvabilityCheck) -> None:
        self.graph, self.solvability = graph, solvability
        self._robots: dict[tuple[bytes, int], set[int]] = {}

    def __contains__(self, entry: tuple[Node, int]) -> bool:
        node, action = entry
        return (node.key, action) in self._robots

    def add(self, node: Node, action: int) -> bool:
        """Record an action that has just failed: blocked by robots in collisions, and by the robot that holds the part.

        Without any, it is blocked by the robots that could hold the part if they held no other. Return whether two or
        three parts turned out to be ones that no arms can hold at the same time.
        """
        parts, names = self.graph.assembly.part_count, [robot.name for robot in self.graph.cell.robots]
        found = {node.held.index(part) for part in removed_by(action, parts)}
        for reason in self.graph.reasons.recent:
            for body in reason.pair or ():
                found |= {k for k, name in enumerate(names) if k != reason.robot and body.startswith(f"{name} ")}
        if not found:
            holding = [robot for robot, part in enumerate(node.held) if part is not None]
            found = {robot for robot in holding if self.graph.grips(robot, action, node.state)}
        self._robots[node.key, action] = found
        if action >= parts or node.state[action] == HELD:
            return False
        pairs = [(part, action) for robot in found if (part := node.held[robot]) is not None]
        held = [part for part in node.held if part is not None]
        triples = [(*both, action) for both in itertools.combinations(held, 2)]
        return any(self.graph.joint.learn(parts, node.state) for parts in (*pairs, *triples))

    def of(self, node: Node) -> list[int]:
        """Return the actions that have failed at a keyframe."""
        return [action for action in self.solvability.legal(node.state) if (node, action) in self]

    def kinds(self, node: Node) -> list[tuple[str, int]]:
        """Return kind and part of the actions that have failed at a keyframe."""
        parts = len(node.state)
        return [
            ("remove", removed[0]) if (removed := removed_by(action, parts)) else ("hold", action)
            for action in self.of(node)
        ]

    def repairs(self, node: Node) -> list[int]:
        """Return held parts to release or hand over, whose robots block actions that failed; those that stay first."""
        if not self.graph.allow_regrasp:
            return []
        robots = Counter(robot for action in self.of(node) for robot in self._robots[node.key, action])
        held, allowed = [node.held[robot] for robot, _ in robots.most_common()], self.solvability.releasable(node.state)
        parts = [part for part in held if part is not None and allowed[part] and node.can_hand_over(part)]
        return sorted(parts, key=lambda part: (node, part + len(node.state)) not in self)

    def blamed(self, node: Node, chain: Sequence[Edge]) -> set[int]:
        """Return the holds, indices of edges, without which an action that failed might have succeeded."""
        robots = {robot for action in self.of(node) for robot in self._robots[node.key, action]}
        last = {edge.robot: number for number, edge in enumerate(chain)}
        return {last[robot] for robot in robots if node.held[robot] is not None and robot in last}
