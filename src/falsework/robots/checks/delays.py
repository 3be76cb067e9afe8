"""Verification of a schedule under any delays: every position that it allows, checked by Pinocchio and Coal.

What arms collide with depends on the positions of two arms and on the parts that stand, not on times. So all that
delays can bring about is a set of pairs of positions, and of positions and parts; each of these is proven here to be
free of collisions, between samples too. Each motion among the parts that it was planned with is left to the check of
single motions.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.checks.separation import BodyPath, Meeting, SeparationProver
from falsework.robots.plans.plan_problem import PlanProblem
from falsework.robots.plans.reachable_positions import ReachablePositions
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import Segment


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
            found = self.prover.meeting(
                *paths,
                _positions(paths[0], overlap.one, overlap.one_range),
                _positions(paths[1], overlap.other, overlap.other_range),
            )
            if found is not None:
                self._say(found, overlap.one, paths[0], self._where(overlap.other, paths[1].seconds(found.other)))

    def structure(self, segment: Segment) -> None:
        """Check a motion against parts that it was not planned with."""
        states, step = self.plan.states, segment.step
        planned = states[step] != REMOVED
        action = int(self.plan.actions[step])
        for low, high, present in self.reachable.present(segment):
            parts = np.flatnonzero(present & ~planned & (np.arange(len(planned)) != action - len(planned))).tolist()
            if not parts or len(self.problems) >= self.most:
                continue
            self.early += len(parts)
            bodies = [self.judge.standing_part(part) for part in parts]
            path, still = self._path(segment), self.prover.path(bodies, np.zeros(len(segment.rest)))
            found = self.prover.meeting(path, still, _positions(path, segment, (low, high)), (0.0, 0.0))
            if found is not None:
                self._say(found, segment, path, "which may stand then")

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

    Raises:
        PlanError: the plan has no schedule.
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
