"""Which action to try first at a keyframe: as a guide says, else what motions make easy."""

from __future__ import annotations

import numpy as np

from falsework.assembly.state import Mask
from falsework.robots.keyframes import KeyframeGraph, Node
from falsework.robots.proposals import Proposals
from falsework.search.guide import Guide
from falsework.search.task import Direction


class Ranking:
    """Orders the legal actions of keyframes."""

    def __init__(self, graph: KeyframeGraph, proposals: Proposals, guide: Guide | None) -> None:
        """Rank actions.

        Args:
            graph: keyframes of the structure in the cell.
            proposals: which actions are legal, and which are known to keep the way open.
            guide: ranks actions, such as a trained policy.
        """
        self.graph, self.proposals, self.guide = graph, proposals, guide

    def actions(self, node: Node, attempt: int, rng: np.random.Generator) -> list[int]:
        """Legal actions in the order in which to try them: as the guide says, else what motions make easy.

        Removals first: they set a robot free. Then parts that nothing blocks, high up, near a free robot and far
        from the busy ones.

        Args:
            node: where to go on.
            attempt: number of the search; later ones are shaken more.
            rng: shakes the order.
        """
        actions = self.proposals.legal(node.state)
        if not actions:
            return []
        if self.guide is not None:
            allowed: Mask = np.zeros((1, 2 * len(node.state)), dtype=bool)
            allowed[0, actions] = True
            scores = np.asarray(self.guide(node.state[None], allowed, Direction.DISASSEMBLY), float)[0, actions]
            scores = scores + rng.gumbel(size=len(actions)) * (0.0 if attempt == 0 else 0.5)
            return [actions[k] for k in np.argsort(-scores, kind="stable")]
        scores = np.array([self._ease(node, action) for action in actions])
        scores += rng.normal(size=len(actions)) * (0.1 if attempt == 0 else 0.4 * min(attempt, 4))
        return [actions[k] for k in np.argsort(-scores, kind="stable")]

    def _ease(self, node: Node, action: int) -> float:
        """How easy an action is for the robots, by rules of thumb."""
        # What is known costs nothing to judge; a part with its way blocked is worse than an unknown answer.
        known = 3.0 * self.proposals.preferred(node.state, action) + self.proposals.known(node.state, action)
        if action >= len(node.state):
            return 100.0 + known
        center = self.graph.parts.center[action]
        score = known - 5.0 * min(self.graph.blocked_by(action, node.state), 4)
        score += 2.0 * (center[2] - self.graph.lowest) / self.graph.height
        robots = self.graph.cell.robots
        free = [robot.base[:2, 3] for robot, held in zip(robots, node.held, strict=True) if held is None]
        near = min(float(np.linalg.norm(base - center[:2])) for base in free)
        score -= near / self.graph.spread
        for part in node.held:
            if part is not None:
                apart = float(np.linalg.norm(self.graph.parts.center[part] - center)) / self.graph.spread
                score += min(apart, 1.0)
        return score
