"""Keyframe graph: robot configurations in each state, and the motions of one robot between states.

Section 6 of the paper, figures 9 and 10. A node is a state with the joint values of all robots and the part that each
holds. An edge carries out one action: one robot moves, all others are at rest. The graph is never built
completely: edges are computed on demand and cached.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States
from falsework.geometry.clearance.locked import PartSet
from falsework.robots.grasping.exit_ways import ExitWays
from falsework.robots.keyframes.failure_report import FailureLog
from falsework.robots.keyframes.grasp_configurations import GraspConfiguration, GraspConfigurations
from falsework.robots.keyframes.joint_holds import JointHolds
from falsework.robots.keyframes.joint_removals import JointRemovals
from falsework.robots.keyframes.keyframes import DeadEnds, Edge, Node, PathSegment, accept_all, removed_by
from falsework.robots.keyframes.putting_down import PuttingDown
from falsework.robots.keyframes.ways_in_turn import WaysInTurn
from falsework.robots.keyframes.withdrawal import Reaching, Withdrawal
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import NO_CONTACT, CollisionWorld, Scene, grasp_contact
from falsework.robots.motion.near_pairs import NearPair, nearest_pair
from falsework.robots.motion.path_planner import MotionCache
from falsework.robots.plans.ways import in_turn

_MAX_DETOURS = 2
"""Withdrawals of a part that cannot be delivered after which it is put down, to be gripped in another way."""


@dataclass(frozen=True)
class KeyframeSettings:
    """Limits on the candidates tried for one step."""

    grasps: int = 128
    """Grasps per part, best first."""
    candidates: int = 24
    """Configurations of one robot for one grasp or drop-off pose that are tried, nearest first."""
    nodes: int = 500
    """Limit on the nodes of the trees of one free motion."""
    approaches: tuple[float, ...] = (1.0, 0.4, 1.8)
    """Lengths of the line on which a gripper approaches a part, in approach margins of the cell, tried in turn."""
    withdrawals: tuple[float, ...] = (1.0, 2.0, 4.0)
    """Lengths of the line on which a part is withdrawn, in approach margins, tried in turn until it is clear."""


class KeyframeGraph:
    """Keyframes of one structure in one cell, and the motions between them."""

    def __init__(
        self,
        assembly: Assembly,
        cell: Cell,
        *,
        settings: KeyframeSettings = KeyframeSettings(),
        seed: int = 0,
        parts: PartShapes | None = None,
        present: NDArray[np.bool_] | None = None,
        leaving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Create an empty graph; the seed is that of the free motions.

        `present` and `leaving` are parts that are ever in place, and that ever leave, shape (parts,); all by default.
        """
        self.assembly, self.cell, self.settings, self.seed = assembly, cell, settings, seed
        self.allow_regrasp = False
        """Whether parts may be held again, handed over or put down; from the second turn of a search on."""
        self.parts = parts or place_parts(assembly, cell.placement)
        self.world = CollisionWorld(cell, self.parts)
        self.reasons = FailureLog()
        self.cache = MotionCache(self.world, nodes=settings.nodes, seed=seed)
        self.grasp_configurations = GraspConfigurations(assembly, self.cache, self.reasons, limit=settings.grasps)
        self.given = self.grasp_configurations.given
        self.joint = JointHolds(self.grasp_configurations, self._usable)
        self.accepts: Callable[[Edge], bool] = accept_all
        """Whether a hold or a removal may be part of a plan."""
        self.dead = DeadEnds()
        """Dead ends of the search that uses the graph."""
        self._alone: dict[tuple[int, int, bytes, bytes, bool, bool], bool] = {}
        self.withdrawal = Withdrawal(self.grasp_configurations, settings.withdrawals)
        self.reaching = Reaching(self.cache, self.reasons, settings.approaches)
        self.putting_down = PuttingDown(self.grasp_configurations, self.reaching)
        self.exits = ExitWays(assembly, cell.placement, present, leaving)
        self.joint_removals = JointRemovals(self.exits, self.withdrawal)
        self.ways_in_turn = WaysInTurn(self.joint_removals, self.reaching, self.grasp_configurations)

    def start(self, state: States, configurations: tuple[Array, ...], held: tuple[int | None, ...]) -> Node:
        """Return an initial node."""
        return Node(np.asarray(state, np.uint8), tuple(np.array(c, float) for c in configurations), held)

    def edges(self, node: Node, action: int) -> Iterator[Edge]:
        """Yield edges that carry out an action, most promising first, each computed on demand."""
        parts = self.assembly.part_count
        if action < parts and node.state[action] == HELD:
            return self._release(node, action)
        if len(removed := removed_by(action, parts)) > 1:
            return filter(self._accepted, self._remove_set(node, tuple(removed)))
        edges = self._remove(node, action - parts) if action >= parts else self._hold(node, action)
        return filter(self._accepted, edges)

    def _accepted(self, edge: Edge) -> bool:
        """Return whether a hold, or a removal with all that follows on its way, may be part of a plan."""
        acting = next((other for other in (edge, *edge.node.following) if other.action >= 0), edge)
        return self.accepts(replace(acting, node=edge.node.following[-1].node) if edge.node.following else edge)

    def take_over(self, node: Node, part: int) -> Iterator[Edge]:
        """Yield edges on which another robot holds a held part as well, so that the robot that holds it can leave.

        One from each side for each robot: which robot it is, and where it stands, matters more than how it holds.
        """
        left: dict[tuple[int, bytes], list[GraspConfiguration]] = defaultdict(list)
        for robot in self._nearest_free(node, part):
            for grip in self.grips(robot, part, node.state):
                left[robot, (np.round(grip.grasp.approach, 1) + 0.0).tobytes()].append(grip)
        for lasting in (True,) if node.was_released(part) else (True, False):
            for (robot, side), grips in list(left.items()):
                for edge in self.holds(node, part, robot, lasting, grips):
                    if next(self._release(edge.node, part), None) is not None:
                        del left[robot, side]
                        yield edge
                        break

    def grips(self, robot: int, part: int, state: States) -> list[GraspConfiguration]:
        """Return all grasps of a part by a robot among the parts of a state; other robots are ignored."""
        return self.grasp_configurations.get(robot, part, state)

    def blocked_by(self, part: int, state: States) -> int:
        """Count the parts that block the least blocked exit direction of a part."""
        return int((self.exits.blockers(part) & (state != REMOVED)).sum(axis=1).min(initial=len(state)))

    def reachable(self, part: int) -> bool:
        """Return whether any robot can hold a part that is alone with the boundary."""
        alone = np.where(self.assembly.boundary, HELD, REMOVED).astype(np.uint8)
        alone[part] = HELD
        return any(self.grips(robot, part, alone) for robot in range(self.cell.robot_count))

    def collision(self, node: Node, robot: int) -> NearPair | None:
        """Return two bodies that collide at a robot's configuration, those that overlap most, or None."""
        # Robots at the start of a plan are where they are: absence of contact suffices.
        part = node.held[robot]
        contact = NO_CONTACT if part is None else grasp_contact(part)
        return nearest_pair(self.cache.view(node.scene, robot, contact, 0.0), node.configurations[robot])

    # Holding

    def _hold(self, node: Node, part: int) -> Iterator[Edge]:
        free, found = self._nearest_free(node, part), False
        # Where a part may be held again, a grasp with which it cannot leave later is better than none.
        for lasting in (True, False) if self.allow_regrasp and not node.was_released(part) else (True,):
            # One grasp with each robot before another with the first: which robot holds a part matters more than how.
            turns = [self.holds(node, part, robot, lasting) for robot in free]
            while turns:
                for ways in list(turns):
                    edge = next(ways, None)
                    if edge is None:
                        turns.remove(ways)
                    else:
                        found = True
                        yield edge
            if found:
                return

    def _nearest_free(self, node: Node, part: int) -> list[int]:
        """Return the robots that hold nothing, nearest to a part first."""
        free = [robot for robot, held in enumerate(node.held) if held is None]
        center = self.parts.center[part]
        return sorted(free, key=lambda robot: float(np.linalg.norm(self.cell.robots[robot].base[:2, 3] - center[:2])))

    def holds(
        self, node: Node, part: int, robot: int, lasting: bool = True, grips: list[GraspConfiguration] | None = None
    ) -> Iterator[Edge]:
        """Yield edges on which a robot that holds nothing holds a part, with some grasps, all by default.

        `lasting`: only with grasps with which the part can leave later.
        """
        grips = self.grips(robot, part, node.state) if grips is None else grips
        if node.changed:
            grips = [grip for grip in grips if node.is_new(part, robot, grip.configuration)]
        if not grips:
            return
        view = self.cache.view(node.scene, robot, grasp_contact(part))
        values = np.array([grip.configuration for grip in grips])
        hits = view.hits(values)
        for row in np.flatnonzero(hits >= 0)[:1]:
            self.reasons.add("hold", part, robot, "a robot blocks every grasp", view.pair(int(hits[row])))
        open_grips = [grips[row] for row in np.flatnonzero(hits < 0)]
        for grip in self.grasp_configurations.best(open_grips, robot, node.scene, node.held, self.settings.candidates):
            if not self.allow_regrasp and self.dead.repeated(node, part, robot):
                return
            edge = self._try_grip(node, part, grip, lasting)
            if edge is not None:
                yield edge

    def _try_grip(self, node: Node, part: int, grip: GraspConfiguration, lasting: bool) -> Edge | None:
        robot, here = grip.robot, grip.configuration
        retreat = self.reaching.retreat("hold", node.scene, part, robot, here, -grip.grasp.approach)
        if retreat is None:
            return None
        # The part must be able to leave with this grasp once its exit is free, unless it is held again before.
        if lasting and not self._can_leave_later(node, part, grip):
            return None
        segments = self.reaching.approach(node.scene, part, robot, retreat)
        if segments is None:
            return None
        return Edge(part, robot, segments, node.after(part, robot, here), part in node.held)

    def _usable(self, grip: GraspConfiguration, part: int, state: States) -> bool:
        """Return whether an arm can approach a grasp, and the part leave with it or be released, without other arms."""
        key = (grip.robot, part, grip.configuration.tobytes(), state.tobytes(), self.allow_regrasp, part in self.given)
        if key not in self._alone:
            alone = self.start(state, self.cell.homes, (None,) * self.cell.robot_count)
            here, way = grip.configuration, -grip.grasp.approach
            line = self.reaching.retreat("hold", alone.scene, part, grip.robot, here, way)
            self._alone[key] = line is not None and (self.allow_regrasp or self._can_leave_later(alone, part, grip))
        return self._alone[key]

    def _can_leave_later(self, node: Node, part: int, grip: GraspConfiguration) -> bool:
        if part in self.given:  # held to the end
            return True
        later, ways = self.exits.free_later(part, node.state)
        values = tuple(
            np.asarray(grip.configuration)
            if robot == grip.robot
            else (node.configurations[robot] if held not in (None, part) and later[held] != REMOVED else entry.home)
            for robot, (entry, held) in enumerate(zip(self.cell.robots, node.held, strict=True))
        )
        scene = Scene(values, later != REMOVED, (None,) * len(values))
        lines = self.withdrawal.lines(scene, part, grip.robot, grip.configuration, ways, "later withdrawal")
        return next(lines, None) is not None

    # Releasing

    def _release(self, node: Node, part: int) -> Iterator[Edge]:
        """Yield the edge on which a robot lets go of a part and stays beside it, then the one on which it goes home."""
        robot, hands_over = node.holder(part), node.handed == part
        for segments in self.reaching.departures(node.scene, part, robot):
            yield Edge(part, robot, segments, node.after(part, robot, segments[-1].path[-1]), hands_over)

    # Removing

    def _remove(self, node: Node, part: int) -> Iterator[Edge]:
        robot = node.held.index(part)
        if not self.allow_regrasp and self.dead.repeated(node, part + self.assembly.part_count, robot):
            return
        here = node.configurations[robot]
        ways = self.exits.free(part, node.state)
        if not ways:
            self.reasons.add("remove", part, robot, "no free way out")
            return
        if in_turn(ways[0]):
            yield from self.ways_in_turn.edges(node, ways[0])
            return
        action, stuck, delivered = part + self.assembly.part_count, [], False
        for way, paths, scene in self.withdrawal.lines(node.scene, part, robot, here, ways, "way out"):
            lines = tuple(PathSegment("line", path, part=part) for path in paths)
            away = self.withdrawal.delivery(part, robot, paths[-1][-1], scene)
            if away is None:
                stuck.append((way, lines, scene))
            else:
                delivered = True
                yield Edge(action, robot, (*lines, away), node.after(action, robot, away.path[-1]), way=way)
        for way, lines, scene in stuck[:_MAX_DETOURS] if self.allow_regrasp and not delivered else ():
            detour = self.putting_down.detour(part, robot, here, lines[-1].path[-1], scene)
            if detour is not None:
                after = node.after(action, robot, detour.end)
                yield Edge(action, robot, (*lines, *detour.segments), after, put_down=detour.pose, way=way)

    def _remove_set(self, node: Node, parts: PartSet) -> Iterator[Edge]:
        """Yield edges on which held parts leave together, straight or in several moves."""
        way = self.exits.path(parts, node.state)
        if way:
            yield from self.ways_in_turn.edges(node, way)
            return
        found = False
        for edge in self.joint_removals.edges(node, parts):
            found = True
            yield edge
        if not found:
            self.reasons.add("remove", parts[0], node.held.index(parts[0]), "no free way out for the set")
