"""Verification of a schedule under any delays: every position that it allows, checked by Pinocchio and Coal.

What arms collide with depends on the positions of two arms and on the parts that stand, not on times. So all that
delays can bring about is a set of pairs of positions, and of positions and parts; each of these is proven here to be
free of collisions, between samples too. Each motion among the parts that it was planned with is left to the check of
single motions.

No point of a body moves farther within a range of a motion than the sum over the joints of joint travel times lever
arm. Where the distance of two bodies at the middle of two ranges exceeds what both can move from there, they do not
meet anywhere in these ranges; otherwise the ranges are halved.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from falsework.robots.checks.handling import place_lines
from falsework.robots.checks.pinocchio_checker import (
    WORLD,
    CollisionBody,
    PinocchioCollisionChecker,
    convex_shape,
    import_pinocchio,
)
from falsework.robots.model.shapes import Array
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.reachable_positions import ReachablePositions
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import Segment
from falsework.robots.plans.trajectory import JOINS, Trajectory

NEAREST = 2e-4
"""Distance above which bodies can be proven to keep apart, metres."""
_STEP = 0.01
"""Largest joint step between two samples of a motion, rad or m; ranges are halved between samples too."""
_ACCURACY = 1e-5
"""Bound on the error of a distance, metres; the tolerance of Coal's GJK is 1e-6."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of a body for distances."""

    exact: Any
    hull: Any
    """Its convex hull, the same where it is convex: faster, and nowhere farther away."""
    center: Array
    """Centre of a sphere around it, in its own frame, shape (3,)."""
    radius: float


class BodyPath:
    """Bodies along a motion, or at rest, placed by Pinocchio.

    A position on the path is the index of a sample, or lies between two of them.
    """

    def __init__(
        self,
        judge: PinocchioCollisionChecker,
        bodies: Sequence[CollisionBody],
        shapes: Sequence[Shape],
        values: Array,
        trajectory: Trajectory | None,
        robot: int,
    ) -> None:
        """Bound what bodies of an arm, or of none, move in a motion, or at rest in a configuration, shape (joints,)."""
        self.names, self.shapes = tuple(body.name for body in bodies), shapes
        self.radii = np.array([shape.radius for shape in shapes])
        self._judge, self._robot, self._trajectory = judge, robot, trajectory
        self._joints = [body.joint for body in bodies]
        self._frames = np.array([body.placement for body in bodies])
        self._centers = np.array([shape.center for shape in shapes])
        self._times, self._samples = np.zeros(1), np.asarray(values, dtype=np.float64)[None]
        self._moved = np.zeros((1, len(bodies)))
        if trajectory is not None:
            self._times, self._samples = trajectory.dense(_STEP)
            levers = np.array([_levers(judge, robot, *given) for given in zip(bodies, shapes, strict=True)])
            steps = trajectory.travel(self._times) @ levers.T
            self._moved = np.concatenate([self._moved, np.cumsum(steps, axis=0)])
        self._placed: dict[float, tuple[Array, list[Any]]] = {}

    def position(self, share: float) -> float:
        """Return the position at a share of the duration."""
        return self.position_at(share * self._times[-1])

    def position_at(self, seconds: float) -> float:
        """Return the position at a nominal time, seconds from the start of the motion."""
        return float(np.interp(seconds, self._times, np.arange(len(self._times))))

    @property
    def last(self) -> float:
        """The last position."""
        return len(self._times) - 1.0

    def seconds(self, position: float) -> float:
        """Return the nominal time of a position, seconds from the start of the motion."""
        return float(np.interp(position, np.arange(len(self._times)), self._times))

    def moved(self, position: float) -> Array:
        """Return a bound on the length of the way of any point to a position, for each body, metres."""
        low = int(position)
        if low == position:
            return self._moved[low]
        return self._moved[low] + (position - low) * (self._moved[low + 1] - self._moved[low])

    def place(self, position: float) -> tuple[Array, list[Any]]:
        """Return the bodies at a position: centres of their spheres, shape (bodies, 3), and transforms of Coal."""
        if position not in self._placed:
            low = int(position)
            values = self._samples[low]
            if low != position and self._trajectory is not None:
                values = self._trajectory.sample(np.array([self.seconds(position)]))[0]
            poses = self._judge.frames(self._robot, values, self._joints) @ self._frames
            centers = np.einsum("bij,bj->bi", poses[:, :3, :3], self._centers) + poses[:, :3, 3]
            coal = import_pinocchio()[1]
            self._placed[position] = centers, [coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in poses]
        return self._placed[position]


@dataclass(frozen=True)
class Meeting:
    """Positions on two paths at which two bodies collide or are nearer than `NEAREST`."""

    one: float
    other: float
    bodies: tuple[str, str]
    distance: float
    """Metres; 0 where they collide."""


class SeparationProver:
    """Proofs that bodies keep apart over ranges of two paths."""

    def __init__(self, judge: PinocchioCollisionChecker) -> None:
        self.judge = judge
        self._coal = import_pinocchio()[1]
        self._request = self._coal.DistanceRequest(False, False)
        self._shapes: dict[int, Shape] = {}
        self.ranges = 0
        """Number of pairs of ranges examined so far."""
        self.distances = 0
        """Number of distances computed so far by Coal."""

    def path(
        self, bodies: Sequence[CollisionBody], values: Array, trajectory: Trajectory | None = None, robot: int = 0
    ) -> BodyPath:
        """Return the path of bodies; arguments as those of `BodyPath`."""
        return BodyPath(self.judge, bodies, [self._shape(body.shape) for body in bodies], values, trajectory, robot)

    def meeting(self, one: BodyPath, other: BodyPath, *ranges: tuple[float, float]) -> Meeting | None:
        """Return positions in two ranges of two paths at which bodies meet; None where they are proven to keep apart.

        Without ranges, at equal times of two motions.
        """
        as_one = not ranges
        one_range, other_range = ranges or ((0.0, one.last), (0.0, other.last))
        first, second = np.indices((len(one.names), len(other.names))).reshape(2, -1)
        left = [(*one_range, *other_range, first, second)]
        while left:
            low, high, bottom, top, first, second = left.pop()
            self.ranges += 1
            a = _middle(low, high)
            b = other.position_at(one.seconds(a)) if as_one else _middle(bottom, top)
            at, there = one.moved(a), other.moved(b)
            mine = np.maximum(one.moved(high) - at, at - one.moved(low))[first]
            theirs = np.maximum(other.moved(top) - there, there - other.moved(bottom))[second]
            (centers, here), (others, where) = one.place(a), other.place(b)
            apart = np.linalg.norm(centers[first] - others[second], axis=1)
            keep = mine + theirs + _ACCURACY
            unproven = []
            for k in np.flatnonzero(apart - one.radii[first] - other.radii[second] <= keep).tolist():
                i, j = int(first[k]), int(second[k])
                gap = self._gap(one.shapes[i], here[i], other.shapes[j], where[j], keep[k])
                if gap > keep[k]:
                    continue
                if gap <= 0 or keep[k] <= NEAREST / 2:
                    return Meeting(a, b, (one.names[i], other.names[j]), max(gap, 0.0))
                unproven.append(k)
            if unproven:
                first, second = first[unproven], second[unproven]
                far, wide = float(mine[unproven].max()), float(theirs[unproven].max())
                rows = [(low, a), (a, high)] if as_one or 2 * far >= wide else [(low, high)]
                columns = [(bottom, b), (b, top)] if as_one or 2 * wide >= far else [(bottom, top)]
                pairs = zip(rows, columns, strict=True) if as_one else itertools.product(rows, columns)
                left += [(*row, *column, first, second) for row, column in pairs]
        return None

    def _gap(self, one: Shape, here: Any, other: Shape, where: Any, keep: float) -> float:
        """Return the distance of two bodies, or a lower bound above `keep`, metres; not positive where they overlap."""
        gap = self._distance(one.hull, here, other.hull, where)
        if gap > keep or (one.hull is one.exact and other.hull is other.exact):
            return gap
        return self._distance(one.exact, here, other.exact, where)

    def _distance(self, one: Any, here: Any, other: Any, where: Any) -> float:
        self.distances += 1
        return float(self._coal.distance(one, here, other, where, self._request, self._coal.DistanceResult()))

    def _shape(self, exact: Any) -> Shape:
        if id(exact) not in self._shapes:
            hull = exact
            if isinstance(exact, self._coal.BVHModelOBBRSS):
                hull = convex_shape(np.array([exact.vertex(k) for k in range(exact.num_vertices)]))
            exact.computeLocalAABB()
            self._shapes[id(exact)] = Shape(exact, hull, np.array(exact.aabb_center), float(exact.aabb_radius))
        return self._shapes[id(exact)]


def _middle(low: float, high: float) -> float:
    """Return the middle of a range, a sample where one lies inside."""
    middle = (low + high) / 2
    return float(round(middle)) if high - low >= 2 else middle


def _levers(judge: PinocchioCollisionChecker, robot: int, body: CollisionBody, shape: Shape) -> Array:
    """Return bounds on what a point of a body moves per rad or metre of each joint of its arm, shape (joints,)."""
    model, description = judge.model, judge.cell.robots[robot].model
    found = np.zeros(description.joints)
    joint, center = body.joint, body.placement[:3, :3] @ shape.center + body.placement[:3, 3]
    lever = float(np.linalg.norm(center)) + shape.radius
    while joint != WORLD:
        k = model.joints[joint].idx_q - judge.slots[robot].start
        found[k] = 1.0 if description.prismatic[k] else lever
        slide = max(abs(description.lower[k]), abs(description.upper[k])) if description.prismatic[k] else 0.0
        lever += float(np.linalg.norm(model.jointPlacements[joint].translation) + slide)
        joint = model.parents[joint]
    return found


@dataclass(frozen=True)
class DelayReport:
    """Result of a check under any delays."""

    problems: tuple[PlanProblem, ...]
    overlaps: int
    """Number of pairs of motions and rests of two arms that can take place at the same time."""
    early: int
    """Number of pairs of a motion and a part that can still stand, or stand already, other than in the plan's order."""
    ranges: int
    """Number of pairs of ranges of motions that were examined."""
    distances: int
    """Number of distances that Coal computed."""
    seconds: float
    """Duration of the check."""


class _DelayChecker:
    """Walk through all that a schedule allows."""

    def __init__(self, plan: RobotPlan, judge: PinocchioCollisionChecker, most: int) -> None:
        self.plan, self.judge, self.most = plan, judge, most
        self.reachable, self.prover = ReachablePositions(plan), SeparationProver(judge)
        self.problems: list[PlanProblem] = []
        self.overlaps = self.early = 0
        self._paths: dict[Segment, BodyPath] = {}

    def arms(self, one: int, other: int) -> None:
        """Check two arms against each other."""
        for overlap in self.reachable.overlaps(one, other):
            if len(self.problems) >= self.most:
                return
            self.overlaps += 1
            paths = self._path(overlap.one), self._path(overlap.other)
            pairs = [paths]
            if overlap.as_one or self._beside(overlap.one, overlap.other) or self._beside(overlap.other, overlap.one):
                # The parts touch, and leave each other, or pass, as the check of single motions has them do.
                bare = [self._path(replace(segment, load=None)) for segment in (overlap.one, overlap.other)]
                pairs = [(paths[0], bare[1]), (bare[0], paths[1])]
            ranges: tuple[tuple[float, float], ...] = ()
            if not overlap.as_one:
                ranges = (
                    _positions(paths[0], overlap.one, overlap.one_range),
                    _positions(paths[1], overlap.other, overlap.other_range),
                )
            found = next(filter(None, (self.prover.meeting(*pair, *ranges) for pair in pairs)), None)
            if found is not None:
                self._say(found, overlap.one, paths[0], self._where(overlap.other, paths[1].seconds(found.other)))

    def _beside(self, moving: Segment, resting: Segment) -> bool:
        """Return whether an arm moves its part on a way, or has it aside, beside one that rests with its own aside."""
        plan, step, load = self.plan, moving.step, resting.load
        if moving.load is None or load is None or resting.trajectory is not None:
            return False
        frames, both = [step, step + 1], {moving.robot: moving.load.part, resting.robot: load.part}
        if moving.trajectory is None:
            return any(both.items() <= plan.aside(k).items() for k in range(len(plan.keyframes)))
        on_way = [plan.steps[step].of(moving.robot)[order] for order in place_lines(plan, step, moving.robot)]
        still = [plan.keyframes[k].configurations[resting.robot] - resting.rest for k in frames]
        there = all(plan.aside(k).get(resting.robot) == load.part for k in frames)
        return there and float(np.abs(still).max()) <= JOINS and any(moving.trajectory is leg for leg in on_way)

    def structure(self, segment: Segment) -> None:
        """Check a motion against parts that it was not planned with."""
        planned = self.plan.standing[segment.step : segment.step + 2].any(axis=0)
        known = self._waiting(segment.step, segment.step + 1)
        for low, high, first, last in self.reachable.present(segment):
            parts = np.flatnonzero(self.plan.standing[first : last + 1].any(axis=0) & ~planned).tolist()
            bodies = [self.judge.standing_part(part) for part in parts]
            waits = self._waiting(first, last)
            bodies += [
                self.judge.standing_part(part, pose) for (part, key), pose in waits.items() if (part, key) not in known
            ]
            if not bodies or len(self.problems) >= self.most:
                continue
            self.early += len(bodies)
            path, still = self._path(segment), self.prover.path(bodies, np.zeros(len(segment.rest)))
            found = self.prover.meeting(path, still, _positions(path, segment, (low, high)), (0.0, 0.0))
            if found is not None:
                self._say(found, segment, path, "which may stand then")

    def _waiting(self, first: int, last: int) -> dict[tuple[int, bytes], Array]:
        """Return the displacements of all parts that wait at some keyframes."""
        waits = [entry for frame in self.plan.keyframes[first : last + 1] for entry in frame.waits]
        return {(part, pose.tobytes()): pose for part, pose in waits}

    def _path(self, segment: Segment) -> BodyPath:
        if segment not in self._paths:
            bodies = self.judge.arm(segment.robot, segment.load)
            self._paths[segment] = self.prover.path(bodies, segment.rest, segment.trajectory, segment.robot)
        return self._paths[segment]

    def _where(self, segment: Segment, seconds: float) -> str:
        name, load = self.plan.robots[segment.robot].name, ""
        if segment.load is not None:
            how = "beside" if segment.load.lies else "with"
            load = f" {how} part {self.judge.parts.names[segment.load.part]}"
        if segment.trajectory is None:
            return f"while {name} rests{load} after step {segment.step + 1}"
        return f"while {name} is {seconds:.2f} s into a motion{load} of step {segment.step + 1}"

    def _say(self, found: Meeting, segment: Segment, path: BodyPath, meanwhile: str) -> None:
        met = "collides with" if found.distance <= 0 else f"comes within {1000 * found.distance:.2f} mm of"
        what = f"{found.bodies[0]} {met} {found.bodies[1]}, {meanwhile}"
        seconds = None if segment.trajectory is None else path.seconds(found.one)
        name = self.plan.robots[segment.robot].name
        self.problems.append(
            PlanProblem(segment.step, name, what, pair=found.bodies, seconds=seconds, distance=found.distance)
        )


def check_delays(plan: RobotPlan, judge: PinocchioCollisionChecker, *, most: int = 20) -> DelayReport:
    """Check a schedule under any delays: each arm as late as it likes, in any motion, others waiting by the graph.

    Proven for all of these executions: the motions of each arm and the states come in their order; no arm, nor the
    part that it carries, comes near another arm, its part, or a part that stands only because of a delay. Bodies have
    their full size, arms are compared between samples too, and a distance below `NEAREST` counts as a problem. Each
    arm against itself, its surroundings, and the parts that its motion was planned with is not checked here;
    `check_robot_plan` does both.
    """
    began = time.perf_counter()
    checker = _DelayChecker(plan, judge, most)
    reachable, nodes = checker.reachable, checker.reachable.graph.nodes
    checker.problems += [
        PlanProblem(nodes[index].step, plan.robots[nodes[index].robot].name, what)
        for index, what in reachable.out_of_order()[:most]
    ]
    if not checker.problems:  # otherwise positions that can coincide are not known
        for one in range(len(plan.robots)):
            for other in range(one + 1, len(plan.robots)):
                checker.arms(one, other)
            for segment in reachable.segments[one]:
                if segment.trajectory is not None:
                    checker.structure(segment)
    return DelayReport(
        tuple(checker.problems),
        checker.overlaps,
        checker.early,
        checker.prover.ranges,
        checker.prover.distances,
        time.perf_counter() - began,
    )


def _positions(path: BodyPath, segment: Segment, progress: tuple[float, float]) -> tuple[float, float]:
    """Return the positions on a path at two values of progress."""
    low, high = (path.position(value - segment.low) for value in progress)
    return low, high
