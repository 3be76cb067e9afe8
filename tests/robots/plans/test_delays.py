"""Schedules under any delays: positions that can coincide, and proofs against a grid of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")


from falsework import Assembly
from falsework.errors import PlanError
from falsework.robots import Cell, Precedence, RobotPlan, schedule_plan, simulate
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.delays import BodyPath, SeparationProver, check_delays
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.reachable_positions import Overlap, ReachablePositions
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import Segment
from tests.robots.plans.sampled_schedule import check_schedule


@pytest.fixture(scope="module")
def planned(planned_in_turn: Callable[[Assembly, Cell], RobotPlan], column: Assembly, cell: Cell) -> RobotPlan:
    """Two arms take the column apart in turn, close to each other."""
    return planned_in_turn(column, cell)


@pytest.fixture(scope="module")
def scheduled(planned: RobotPlan, column: Assembly, cell: Cell) -> RobotPlan:
    """At the same time, where that is safe."""
    return schedule_plan(planned, column, cell)


@pytest.fixture(scope="module")
def judge(column: Assembly, cell: Cell) -> PinocchioCollisionChecker:
    """Pinocchio and Coal, without the floor that parts stand on: it is no matter of delays."""
    return PinocchioCollisionChecker(replace(cell, floor=None), place_parts(column, cell.placement), 0.001)


def graph_of(plan: RobotPlan) -> TemporalPlanGraph:
    """Its schedule."""
    assert plan.schedule is not None
    return plan.schedule


def with_edges(plan: RobotPlan, kept: Callable[[Precedence], bool], *more: Precedence) -> RobotPlan:
    """The plan with some of its precedences only, and more."""
    graph = graph_of(plan)
    edges = (*filter(kept, graph.edges), *more)
    return replace(plan, schedule=TemporalPlanGraph(graph.nodes, edges, graph.robots, 0.0))


def volumes(plan: RobotPlan) -> list[Precedence]:
    """Waits for the volume that another arm leaves."""
    return [edge for edge in graph_of(plan).edges if edge.why == "volume"]


def path_of(prover: SeparationProver, segment: Segment) -> BodyPath:
    """Bodies of an arm along its motion, or at rest."""
    bodies = prover.judge.arm(segment.robot, segment.load)
    return prover.path(bodies, segment.rest, segment.trajectory, segment.robot)


def sampled(segment: Segment, low: float, high: float) -> np.ndarray:
    """Configurations on a part of a segment, every 0.05 rad."""
    if segment.trajectory is None:
        return segment.rest[None]
    moments, values = segment.trajectory.dense(0.05)
    low, high = ((value - segment.low) * segment.trajectory.seconds for value in (low, high))
    inside = values[(moments > low) & (moments < high)]
    return np.concatenate([segment.trajectory.sample(np.array([low, high])), inside])


def collides(plan: RobotPlan, judge: PinocchioCollisionChecker, overlap: Overlap) -> bool:
    """Whether two arms collide at a sample of all positions that can coincide."""
    one, other = overlap.one, overlap.other
    query = judge.prepare(
        one.robot,
        plan.keyframes[0].configurations,
        np.zeros(len(plan.plan.boundary), bool),
        load=one.load,
        loads={} if other.load is None else {other.robot: other.load},
    )
    for values in sampled(other, *overlap.other_range):
        query.values[judge.slots[other.robot]] = values
        if any(query.hits(entry) for entry in sampled(one, *overlap.one_range)):
            return True
    return False


def test_no_delay_leads_to_a_collision(
    planned: RobotPlan, scheduled: RobotPlan, column: Assembly, cell: Cell, judge: PinocchioCollisionChecker
) -> None:
    for plan in (scheduled, scheduled.reverse(), schedule_plan(planned.reverse(), column, cell)):
        report = check_delays(plan, judge)
        assert report.problems == ()
        assert report.overlaps > len(graph_of(plan).nodes)
        assert report.early > 0
        assert report.distances > report.ranges > report.overlaps


def test_proofs_agree_with_samples_of_all_positions(scheduled: RobotPlan, judge: PinocchioCollisionChecker) -> None:
    plans = (with_edges(scheduled, lambda edge, left_out=wait: edge != left_out) for wait in volumes(scheduled))
    careless = next(plan for plan in plans if check_delays(plan, judge).problems)
    prover, found = SeparationProver(judge), []
    for overlap in ReachablePositions(careless).overlaps(0, 1):
        paths = path_of(prover, overlap.one), path_of(prover, overlap.other)
        ranges = [
            (path.position(low - segment.low), path.position(high - segment.low))
            for path, segment, (low, high) in zip(
                paths, (overlap.one, overlap.other), (overlap.one_range, overlap.other_range), strict=True
            )
        ]
        found.append(prover.meeting(*paths, *ranges) is not None)
        assert found[-1] == collides(careless, judge, overlap)
    assert 0 < sum(found) < len(found)


def test_a_missing_wait_is_found(
    scheduled: RobotPlan, column: Assembly, cell: Cell, judge: PinocchioCollisionChecker
) -> None:
    unsafe = 0
    for wait in volumes(scheduled):
        careless = with_edges(scheduled, lambda edge, wait=wait: edge != wait)
        report = check_delays(careless, judge)
        unsafe += bool(report.problems)
        late = np.ones(len(graph_of(scheduled).nodes))
        late[wait.before] = 10.0  # so that the other arm comes long before this one has left
        if check_schedule(careless, cell, judge, stretch=late)[0]:
            assert report.problems
        for problem in report.problems:
            assert problem.distance == 0 or problem.pair is not None
            assert "while arm" in problem.what or "may stand then" in problem.what
    assert unsafe >= 2
    assert not check_robot_plan(with_edges(scheduled, lambda edge: edge.why != "volume"), column, cell).good


def test_parts_that_still_stand_are_seen(scheduled: RobotPlan, judge: PinocchioCollisionChecker) -> None:
    """Without any other wait of that motion; some waits follow from those of other motions."""
    seen = []
    for early in (edge for edge in graph_of(scheduled).edges if edge.why == "part"):
        waits = with_edges(
            scheduled, lambda edge, early=early: edge.after != early.after or edge.why in ("arm", "state")
        )
        problems = check_delays(waits, judge, most=10_000).problems
        problems = [problem for problem in problems if "may stand then" in problem.what]
        seen += [problem.step == graph_of(scheduled).nodes[early.after].step for problem in problems[:1]]
    assert seen
    assert all(seen)


def test_order_is_required(scheduled: RobotPlan, judge: PinocchioCollisionChecker) -> None:
    problems = check_delays(with_edges(scheduled, lambda edge: edge.why == "arm"), judge).problems
    assert {problem.what for problem in problems} == {"it does not wait for the state of the previous step"}
    problems = check_delays(with_edges(scheduled, lambda edge: edge.why != "arm"), judge).problems
    assert "its motion does not wait for the motion before" in {problem.what for problem in problems}


def test_positions_that_can_coincide(planned: RobotPlan, scheduled: RobotPlan) -> None:
    """Motions one after the other: an arm moves while the other rests; without waits: everything coincides."""
    nodes = graph_of(scheduled).nodes
    chain = [Precedence(k, nodes[k].seconds, k + 1, "volume") for k in range(len(nodes) - 1)]
    one_by_one = ReachablePositions(with_edges(scheduled, lambda edge: False, *chain))
    assert not one_by_one.out_of_order()
    pairs = list(one_by_one.overlaps(0, 1))
    assert all(pair.one.trajectory is None or pair.other.trajectory is None for pair in pairs)
    moving = [node for node in nodes if node.trajectory is not None]
    assert sum(pair.one.trajectory is not pair.other.trajectory for pair in pairs) == len(moving)
    free = ReachablePositions(with_edges(scheduled, lambda edge: edge.why == "arm"))
    assert len(list(free.overlaps(0, 1))) == len(free.segments[0]) * len(free.segments[1])
    with pytest.raises(PlanError, match="no schedule whose delays"):
        ReachablePositions(planned)


def test_runs_keep_to_the_positions(scheduled: RobotPlan) -> None:
    assert simulate(scheduled, runs=50).outside == 0
    graph, reachable = graph_of(scheduled), ReachablePositions(scheduled)
    starts, late = graph.starts(), np.ones(len(graph.nodes))
    wait = volumes(scheduled)[0]
    assert reachable.contains(starts, late)
    starts[wait.after] = starts[wait.before]
    assert not reachable.contains(starts, late)


def test_no_point_moves_farther_than_its_bound(scheduled: RobotPlan, judge: PinocchioCollisionChecker) -> None:
    prover, rng = SeparationProver(judge), np.random.default_rng(0)
    segments = [entry for entry in ReachablePositions(scheduled).segments[0] if entry.trajectory is not None]
    for segment in segments[:4]:
        assert segment.trajectory is not None
        path = path_of(prover, segment)
        last = path.position(1.0)
        assert path.seconds(last) == pytest.approx(segment.trajectory.seconds)
        for _ in range(10):
            low, high = np.sort(rng.random(2)) * last
            bound = path.moved(high) - path.moved(low)
            one, other = path.place(low), path.place(high)
            for k, shape in enumerate(path.shapes):
                corners = shape.center + shape.radius * rng.normal(size=(8, 3)) / 3
                corners = corners[np.linalg.norm(corners - shape.center, axis=1) <= shape.radius]
                ends = [corners @ at[k].getRotation().T + at[k].getTranslation() for _, at in (one, other)]
                assert (np.linalg.norm(ends[1] - ends[0], axis=1) <= bound[k] + 1e-9).all()


def test_travel_of_joints_is_a_bound(scheduled: RobotPlan) -> None:
    for _, _, trajectory in scheduled.moves():
        times, _ = trajectory.dense(0.05)
        fine = trajectory.sample(np.linspace(times[:-1], times[1:], 9).T)
        way = np.abs(np.diff(fine, axis=1)).sum(axis=1)
        bound = trajectory.travel(times)
        assert (way <= bound + 1e-9).all()
        assert bound.sum() <= 2 * way.sum()
