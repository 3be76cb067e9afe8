"""Free motions planned anew around other arms that move, where that makes the schedule shorter.

A motion waits for another arm because the volumes of the two meet. The free motions in such conflicts on the critical
path are replaced by paths around the bodies of the other arms, or by deformations of the present path that leave the
shared volume sooner or enter it later. The makespan decides, with all conflicts of the new motion: a detour may take
longer than the wait.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.errors import PlanError
from falsework.robots.kernels.collision import CLEAR
from falsework.robots.kernels.rrt_connect import INTERVALS, edges_free
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.keyframes.trajectory_assembly import timed_leg
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import inverse_pose
from falsework.robots.motion.collision_world import BESIDE, Attached, CollisionQuery, CollisionWorld, Scene
from falsework.robots.motion.path_planner import plan_free, resolution_of
from falsework.robots.planning.shorter_motions import shorter
from falsework.robots.plans.loads import loads_beside
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.schedule.conflicts import choices, fixed_precedences
from falsework.robots.schedule.itinerary import Itineraries
from falsework.robots.schedule.kept_order import KeptOrder, Replacement
from falsework.robots.schedule.occupancy import occupied
from falsework.robots.schedule.solver import as_scheduled, solve

Array = NDArray[np.float64]

_LEAST_SHARE = 0.08
"""Share of the makespan that waits for space cost from which on replacements are worth their time."""
_LEAST_GAIN = 0.02
"""Least time by which a replacement must shorten the schedule, seconds."""
_MOTIONS = 24
"""Motions that are tried, those with most to gain first."""
_NODES = 400
"""Limit on the nodes of the trees of a path around neighbours."""
_DEFORMATIONS = 40
"""Deformations tried of the path of a motion."""
_POINTS = 24
"""Points of a path that is deformed."""
_FARTHEST = (0.3, 0.15, 0.08)
"""Standard deviations of deformations, rad or m."""


def plan_around_neighbours(
    plan: RobotPlan, world: CollisionWorld, *, seed: int = 0, stop: Callable[[], bool] = lambda: False
) -> RobotPlan:
    """Return a plan with a shorter schedule if replacing motions leads to one, else the same motions and schedule.

    The statistics have the number of motions that were replaced, and by how many seconds the makespan fell.

    Args:
        plan: robot plan with a schedule.
        world: the cell and the parts.
        seed: seed of paths and deformations.
        stop: tells when to end with the plan found so far.
    """
    graph, replaced, before = plan.schedule, 0, plan.makespan
    if graph is not None and not stop() and graph.makespan - _relaxed(graph).makespan > _LEAST_SHARE * graph.makespan:
        search = _Rerouting(plan, graph, world, seed)
        search.run(stop)
        replaced = sum(old is not new for (*_, old), (*_, new) in zip(plan.moves(), search.plan.moves(), strict=True))
        if replaced:
            graph = solve(search.rows.nodes, search.fixed, search.choices, len(plan.robots))
            plan = replace(search.plan, schedule=graph)
    gain = {"replanned_motions": replaced, "replanning_saves": round(before - plan.makespan, 3)}
    return replace(plan, statistics={**plan.statistics, **gain})


def _relaxed(graph: TemporalPlanGraph, node: int | None = None) -> TemporalPlanGraph:
    """Return a schedule without waits for space: of all motions, or of and for one of them.

    A graph has only the longest wait between two nodes, so a shorter one of another kind may be missing here.
    """
    kept = (e for e in graph.edges if e.why != "volume" or not (node is None or node in (e.before, e.after)))
    return TemporalPlanGraph(graph.nodes, tuple(kept), graph.robots, 0.0)


class _Rerouting:
    """Plan whose motions are replaced one by one."""

    def __init__(self, plan: RobotPlan, graph: TemporalPlanGraph, world: CollisionWorld, seed: int) -> None:
        self.plan, self.world, self.seed = plan, world, seed
        self.rows = Itineraries(plan, world)
        self._schedule(graph.starts())
        self._tried: set[Trajectory] = set()

    def _schedule(self, starts: Array) -> None:
        """Order all conflicts as in a schedule of nearly the same motions with given start times."""
        self.fixed = fixed_precedences(self.rows)
        self.graph, self.choices = as_scheduled(
            self.rows.nodes, self.fixed, choices(self.rows), len(self.plan.robots), starts
        )

    def run(self, stop: Callable[[], bool]) -> None:
        """Replace motions until none in a conflict on a critical path can be, or enough were tried."""
        shorter_now = True
        while shorter_now:
            shorter_now, order = False, KeptOrder(self.rows, self.graph)
            for node, relaxed in self._candidates():
                motion = self._trajectory(node)
                if motion in self._tried:
                    continue
                if len(self._tried) == _MOTIONS or stop():
                    return
                self._tried.add(motion)
                other = self._better(Replacement(order, node), node, relaxed)
                if other is not None and self._take(node, other):
                    shorter_now = True
                    break

    def _trajectory(self, node: int) -> Trajectory:
        entry = self.rows.nodes[node]
        assert entry.trajectory is not None
        return self.plan.steps[entry.step].trajectories[entry.trajectory]

    def _candidates(self) -> list[tuple[int, TemporalPlanGraph]]:
        """Return motions to replace, each with the schedule without its waits for space, the shortest first."""
        graph, found = self.graph, []
        critical = [edge for edge in graph.critical_edges() if edge.why == "volume"]
        for node in sorted({edge.before for edge in critical} | {edge.after for edge in critical}):
            entry = self.rows.nodes[node]
            step = self.plan.steps[entry.step]
            if entry.trajectory is None or step.put_down is not None or self._trajectory(node).kind == "line":
                continue
            relaxed = _relaxed(graph, node)
            if relaxed.makespan < graph.makespan - _LEAST_GAIN:
                found.append((node, relaxed))
        return sorted(found, key=lambda entry: entry[1].makespan)

    def _better(self, place: Replacement, node: int, relaxed: TemporalPlanGraph) -> Trajectory | None:
        """Return a motion with which the schedule is shorter."""
        limit = self.graph.makespan - _LEAST_GAIN
        old = self._best = self._trajectory(node)
        for motion in self._motions(node, relaxed):
            makespan = place.makespan(motion, limit)
            if makespan < limit:
                limit, self._best = makespan, motion
        return None if self._best is old else self._best

    def _motions(self, node: int, relaxed: TemporalPlanGraph) -> Iterator[Trajectory]:
        """Yield motions between the same configurations: one around neighbours, and deformations of the best so far."""
        old, scene = self._trajectory(node), self._scene(node)
        robot = self.rows.nodes[node].robot
        model, speed = self.world.cell.robots[robot].model, self.world.cell.speed

        def timed(path: Array) -> Trajectory | None:
            return timed_leg(model, PathSegment("free", path, old.part, old.touches), speed)

        around = self._around(node, scene, relaxed)
        if around is not None:
            motion = timed(around)
            if motion is not None:
                yield motion
        view = self.world.view(scene, robot)
        arrays = (view.chain, view.bodies, view.obstacles, view.rules, view.work)
        opened, rng = np.empty((2, INTERVALS), np.int64), np.random.default_rng([self.seed, node])
        for _ in range(_DEFORMATIONS):
            points = self._best.sample(np.linspace(0.0, self._best.seconds, _POINTS))
            path = _deformed(points, rng)
            path[0], path[-1] = old.positions[0], old.positions[-1]
            inside = model.within_limits(path).all()
            if inside and edges_free(path, resolution_of(view), *arrays, opened) == len(path) - 1:
                motion = timed(path)
                if motion is not None:
                    yield motion

    def _around(self, node: int, scene: Scene, relaxed: TemporalPlanGraph) -> Array | None:
        """Return a path around what the other arms do in the time of a motion in another schedule."""
        old, robot = self._trajectory(node), self.rows.nodes[node].robot
        starts = relaxed.starts()
        begin, end = float(starts[node]), float(starts[node]) + old.seconds
        bodies = [
            (when, other, body)
            for other in range(len(self.plan.robots))
            if other != robot
            for when, body in occupied(self.rows, starts, other, begin, end)
        ]
        view = self.world.view(scene, robot, beside=[body for _, _, body in bodies])
        origin = BESIDE - view.owners
        for values, arrives in ((old.positions[0], False), (old.positions[-1], True)):
            while (column := _beside(view, values)) is not None:
                when, other, _ = bodies[origin[column]]
                view.rules.pair[:, column] = False
                if arrives:  # it has to wait until the other has left: all that it leaves before is free by then
                    gone = [k >= 0 and bodies[k][1] == other and bodies[k][0] <= when for k in origin]
                    view.rules.pair[:, gone] = False
        path = plan_free(view, old.positions[0], old.positions[-1], seed=self.seed + node, nodes=_NODES).path
        if path is None:
            return None
        segment = PathSegment("free", path, old.part, old.touches, view)
        return shorter(segment, self.world.cell.speed, [self.seed, node]).path

    def _scene(self, node: int) -> Scene:
        """Return the scene in which a motion was planned."""
        plan, entry = self.plan, self.rows.nodes[node]
        attached: list[Attached | None] = [None] * len(plan.robots)
        for robot, load in (loads_beside(plan, entry.step) | {entry.robot: self.rows.load(node)}).items():
            if load is not None:
                assert load.grip is not None
                tool = tool_pose(self.world.cell.robots[robot], load.grip)
                attached[robot] = Attached(load.part, inverse_pose(tool) @ load.pose)
        return Scene(plan.keyframes[entry.step].configurations, self.rows.present(node), tuple(attached))

    def _take(self, node: int, motion: Trajectory) -> bool:
        """Replace a motion if the schedule with all conflicts, found anew, is shorter."""
        before = self.plan, self.rows, self.fixed, self.choices, self.graph
        entry, steps = self.rows.nodes[node], list(self.plan.steps)
        moves = [motion if k == entry.trajectory else old for k, old in enumerate(steps[entry.step].trajectories)]
        steps[entry.step] = replace(steps[entry.step], trajectories=tuple(moves))
        self.plan = replace(self.plan, steps=tuple(steps))
        self.rows = Itineraries(self.plan, self.world, like=self.rows)
        try:
            self._schedule(self.graph.starts())
            if self.graph.makespan < before[-1].makespan - _LEAST_GAIN:
                return True
        except PlanError:  # a deadlock, in this order of the conflicts
            pass
        self.plan, self.rows, self.fixed, self.choices, self.graph = before
        return False


def _beside(view: CollisionQuery, values: Array) -> int | None:
    """Return the obstacle of a collision that is none of the scene of a query; None without such a collision."""
    hit, many = int(view.hits(values)[0]), len(view.owners)
    if hit == CLEAR or hit >= many * len(view.links):
        return None
    return hit % many if view.owners[hit % many] <= BESIDE else None


def _deformed(path: Array, rng: np.random.Generator) -> Array:
    """Return a path that is moved by a smooth bump, in some joints, between its ends."""
    u = np.linspace(0.0, 1.0, len(path))
    centre, width = rng.uniform(0.05, 0.95), rng.uniform(0.15, 0.6)
    bump = (1 - np.clip((u - centre) / width, -1.0, 1.0) ** 2) ** 2 * np.clip(np.minimum(u, 1 - u) / 0.08, 0.0, 1.0)
    joints = rng.random(path.shape[1]) < rng.choice([0.3, 0.6, 1.0])
    return path + bump[:, None] * joints * rng.normal(size=path.shape[1]) * rng.choice(_FARTHEST)
