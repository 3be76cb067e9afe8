"""Actions that fail at keyframes, and the holds that caused the failures: targets of backjumping."""

from __future__ import annotations

from collections.abc import Sequence

from falsework.robots.planning.keyframe_graph import Edge, KeyframeGraph, Node
from falsework.robots.planning.solvability import SolvabilityCheck


class FailedActions:
    """Actions without a motion, each with the robots that block it.

    Conflict-directed backjumping: Prosser, Hybrid algorithms for the constraint satisfaction problem (1993).
    """

    def __init__(self, graph: KeyframeGraph, solvability: SolvabilityCheck) -> None:
        """Create an empty set.

        Args:
            graph: keyframe graph, which logs why motions fail.
            solvability: source of the legal actions.
        """
        self.graph, self.solvability = graph, solvability
        self._robots: dict[tuple[bytes, int], set[int]] = {}

    def __contains__(self, entry: tuple[Node, int]) -> bool:
        node, action = entry
        return (node.key, action) in self._robots

    def add(self, node: Node, action: int) -> bool:
        """Record an action that has just failed: blocked by robots in collisions, and by the robot that holds the part.

        Without any, it is blocked by the robots that could hold the part if they held no other.

        Returns:
            Whether two parts turned out to be ones that no two arms can hold at the same time.
        """
        parts, names = self.graph.assembly.part_count, [robot.name for robot in self.graph.cell.robots]
        found = {node.held.index(action - parts)} if action >= parts else set()
        for reason in self.graph.reasons.recent:
            for body in reason.pair or ():
                found |= {k for k, name in enumerate(names) if k != reason.robot and body.startswith(f"{name} ")}
        if not found:
            holding = [robot for robot, part in enumerate(node.held) if part is not None]
            found = {robot for robot in holding if self.graph.grips(robot, action, node.state)}
        self._robots[node.key, action] = found
        if action >= parts:
            return False
        holds = [part for robot in found if (part := node.held[robot]) is not None]
        return any(self.graph.joint.learn(part, action, node.state) for part in holds)

    def of(self, node: Node) -> list[int]:
        """Return the actions that have failed at a keyframe."""
        return [action for action in self.solvability.legal(node.state) if (node, action) in self]

    def blamed(self, node: Node, chain: Sequence[Edge]) -> set[int]:
        """Return the holds without which an action that failed at a keyframe might have succeeded.

        Args:
            node: the keyframe.
            chain: the edges that lead to it.

        Returns:
            Indices of edges.
        """
        robots = {robot for action in self.of(node) for robot in self._robots[node.key, action]}
        last = {edge.robot: number for number, edge in enumerate(chain)}
        return {last[robot] for robot in robots if node.held[robot] is not None and robot in last}
