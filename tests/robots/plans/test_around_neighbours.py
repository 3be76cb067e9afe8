"""Motions planned anew around other arms that move: shorter schedules, and what stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework.assembly.model import Assembly
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.keyframes.keyframe_graph import KeyframeSettings
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import block
from falsework.robots.motion.collision_world import CollisionQuery, CollisionWorld, Scene
from falsework.robots.planning.around_neighbours import plan_around_neighbours
from falsework.robots.planning.hybrid_planner import plan_robots
from falsework.robots.planning.hybrid_result import HybridSettings
from falsework.robots.planning.plan_together import _APPROACHES, _WITHDRAWALS, plan_together
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.schedule.build import schedule_plan
from falsework.robots.schedule.itinerary import Itineraries
from falsework.robots.schedule.kept_order import KeptOrder, Replacement
from falsework.robots.schedule.occupancy import occupied
from falsework.robots.schedule.simulation import simulate
from falsework.search.problem.task import Direction
from tests.robots.plans.orders import APART


class Case:
    """Cubes between two arms, and a plan in which the arms move at the same time."""

    def __init__(self, assembly: Assembly, cell: Cell, seed: int = 0) -> None:
        """Plan, without motions around neighbours."""
        self.assembly, self.cell = assembly, cell
        self.world = CollisionWorld(cell, place_parts(assembly, cell.placement))
        lines = KeyframeSettings(approaches=_APPROACHES, withdrawals=_WITHDRAWALS)
        settings = HybridSettings(Direction.DISASSEMBLY, seed=seed, together=True, keyframes=lines)
        found = plan_robots(assembly, cell, settings=settings).plan
        assert found is not None
        self.plan = found

    @property
    def graph(self) -> TemporalPlanGraph:
        """Its schedule."""
        assert self.plan.schedule is not None
        return self.plan.schedule

    def around(self, stop: Callable[[], bool] = lambda: False) -> RobotPlan:
        """Return the plan with motions around neighbours."""
        return plan_around_neighbours(self.plan, self.world, stop=stop)


@pytest.fixture(scope="module")
def crossing(make_boxes: Callable[..., Assembly], cell_of: Callable[..., Cell]) -> Case:
    """Four cubes in a square between two arms that stand close together: one carries parts where the other reaches."""
    return Case(make_boxes((-0.25, -0.25, 0), (0.05, -0.25, 0), (-0.25, 0.05, 0), (0.05, 0.05, 0)), cell_of(2, 0.9))


@pytest.fixture(scope="module")
def shortened(crossing: Case) -> RobotPlan:
    """The same with motions around neighbours."""
    return crossing.around()


@pytest.fixture(scope="module")
def blocked(make_boxes: Callable[..., Assembly], cell_of: Callable[..., Cell]) -> Case:
    """Two cubes in the middle of these arms: over one of them the arms can never pass each other."""
    return Case(make_boxes((-0.1, -0.3, 0), (-0.1, 0.1, 0)), cell_of(2, 0.9))


def motions(plan: RobotPlan) -> list[Trajectory]:
    """All motions in order."""
    return [motion for _, _, motion in plan.moves()]


def test_the_schedule_gets_shorter(crossing: Case, shortened: RobotPlan) -> None:
    assert shortened.makespan < crossing.plan.makespan - 0.05
    replaced = [pair for pair in zip(motions(crossing.plan), motions(shortened), strict=True) if pair[0] is not pair[1]]
    assert shortened.statistics["replanned_motions"] == len(replaced) > 0
    saves = crossing.plan.makespan - shortened.makespan
    assert shortened.statistics["replanning_saves"] == pytest.approx(saves, abs=1e-3)
    assert any(old.part is not None for old, _ in replaced)
    for old, new in replaced:
        assert old.kind == new.kind == "free"
        assert old.part == new.part
        assert new.positions[[0, -1]] == pytest.approx(old.positions[[0, -1]], abs=1e-9)


def test_the_independent_check_agrees(crossing: Case, shortened: RobotPlan) -> None:
    report = check_robot_plan(shortened, crossing.assembly, crossing.cell)
    assert report.good, report.problems
    assert simulate(shortened, runs=1000).good


def test_in_assembly_order_the_schedule_is_good_too(crossing: Case, shortened: RobotPlan) -> None:
    plan = schedule_plan(shortened.reverse(), crossing.assembly, crossing.cell)
    assert check_robot_plan(plan, crossing.assembly, crossing.cell).good
    again = plan_around_neighbours(plan, crossing.world)
    assert again.makespan <= plan.makespan
    assert check_robot_plan(again, crossing.assembly, crossing.cell).good


def test_equal_seeds_lead_to_equal_plans(crossing: Case, shortened: RobotPlan) -> None:
    again = crossing.around()
    for one, other in zip(motions(shortened), motions(again), strict=True):
        assert np.array_equal(one.positions, other.positions)
    assert again.schedule is not None
    assert shortened.schedule is not None
    assert again.schedule.edges == shortened.schedule.edges


def test_arms_that_can_never_pass_keep_their_motions(blocked: Case) -> None:
    found = blocked.around()
    assert found.statistics["replanned_motions"] == 0
    assert found.statistics["replanning_saves"] == 0
    assert found.schedule is blocked.plan.schedule
    assert motions(found) == motions(blocked.plan)


def test_plans_for_arms_that_move_together_have_such_motions(crossing: Case, shortened: RobotPlan) -> None:
    result = plan_together(crossing.assembly, crossing.cell, settings=APART)
    assert result.plan is not None
    assert result.plan.makespan == pytest.approx(shortened.makespan)
    assert result.statistics["replanned_motions"] == shortened.statistics["replanned_motions"]


def test_a_deadline_that_has_passed_leaves_the_plan(crossing: Case) -> None:
    found = crossing.around(stop=lambda: True)
    assert found.schedule is crossing.plan.schedule
    assert found.statistics["replanned_motions"] == 0


def test_a_deadline_that_passes_on_the_way_leaves_a_good_plan(crossing: Case, shortened: RobotPlan) -> None:
    found = crossing.around(stop=_after(2))
    assert shortened.makespan < found.makespan < crossing.plan.makespan
    assert check_robot_plan(found, crossing.assembly, crossing.cell).good


def _after(calls: int) -> Callable[[], bool]:
    """Return a condition that holds after some calls."""
    left = iter([False] * calls)
    return lambda: next(left, True)


def test_without_a_schedule_nothing_changes(crossing: Case) -> None:
    plan = replace(crossing.plan, schedule=None)
    found = plan_around_neighbours(plan, crossing.world)
    assert found.schedule is None
    assert found.statistics["replanned_motions"] == 0


@pytest.mark.parametrize("name", ["crossing", "blocked"])
def test_each_motion_in_its_own_place_leaves_the_makespan(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    rows = Itineraries(case.plan, case.world)
    order = KeptOrder(rows, case.graph)
    for node, motion in _free_motions(case, rows):
        place = Replacement(order, node)
        assert place.makespan(motion, np.inf) == pytest.approx(case.graph.makespan, abs=1e-6)
        assert place.makespan(motion, case.graph.makespan - 1e-3) == np.inf
        late = replace(motion, times=motion.times * 50, velocities=motion.velocities / 50)
        assert place.makespan(late, np.inf) >= late.seconds


def _free_motions(case: Case, rows: Itineraries) -> Iterator[tuple[int, Trajectory]]:
    for node, entry in enumerate(rows.nodes):
        if entry.trajectory is not None:
            motion = case.plan.steps[entry.step].trajectories[entry.trajectory]
            if motion.kind == "free":
                yield node, motion


def test_bodies_enclose_an_arm_on_its_way(crossing: Case) -> None:
    rows, starts = Itineraries(crossing.plan, crossing.world), crossing.graph.starts()
    scene = Scene.at_home(crossing.cell, crossing.world.parts)
    for node, motion in _free_motions(crossing, rows):
        robot, begin = rows.nodes[node].robot, float(starts[node])
        for share in (0.25, 0.5, 0.75):
            moment = begin + share * motion.seconds
            bodies = [body for _, body in occupied(rows, starts, robot, moment - 0.15, moment + 0.15)]
            now = scene.with_configuration(robot, motion.sample(np.array([share * motion.seconds]))[0])
            for _, _, piece in crossing.world.robot_pieces(robot, now):
                low, high = piece.min(axis=0), piece.max(axis=0)
                assert any(
                    (body.min(axis=0) <= low + 0.02).all() and (body.max(axis=0) >= high - 0.02).all()
                    for body in bodies
                )


def test_bodies_beside_a_scene_are_in_the_way(make_view: Callable[..., CollisionQuery]) -> None:
    view = make_view()
    home = view.model.home
    assert not view.collides(home)[0]
    tool = view.world.robot_pieces(0, view.scene)[-1][2].mean(axis=0)
    inside = view.world.view(view.scene, 0, beside=[block(tool - 0.02, tool + 0.02)])
    outside = view.world.view(view.scene, 0, beside=[block(tool + 5.0, tool + 5.1)])
    assert inside.collides(home)[0]
    assert not outside.collides(home)[0]
