"""Arms that put a part down on the way and grip it again: plans, their independent check, schedules, rejected input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, plan_robots
from falsework.assembly import REMOVED, complete_state
from falsework.errors import PlanError
from falsework.geometry.arrays import apply
from falsework.robots import Cell, HybridSettings, KeyframeGraph, Obstacle, RobotPlan, RobotStep, export_plan
from falsework.robots.checks.check import CheckReport, check_robot_plan
from falsework.robots.checks.delays import check_delays
from falsework.robots.checks.handling import unrest
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.exports.commands import Grip, events_of
from falsework.robots.kernels.coordination import conflicts, still
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import block, least_turn
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.loads import Load, load_of, lying_motions
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_from_dict,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.robot_plan_model import robot_plan_schema
from falsework.robots.plans.timeline import activities_at, bars_of, event_times
from falsework.robots.schedule.conflicts import Itineraries, choices
from falsework.robots.schedule.swept_bodies import SweptBodies
from falsework.search.plans.plan_check import validate_plan
from falsework.viewer.arms import Arms
from tests.robots.plans.bag_reading import corners, planning_scenes
from tests.robots.plans.roofed_slab import SLAB, make_task, slab, tabled

REMOVAL = 1
"""The step of the small plan that takes the slab away."""


def planned(assembly: Assembly, cell: Cell, *, allow_regrasp: bool) -> HybridResult:
    """Search for a plan that takes everything away."""
    task = make_task(assembly, cell, allow_regrasp=allow_regrasp)
    return plan_robots(assembly, cell, task=task, settings=HybridSettings(Direction.DISASSEMBLY, attempts=3))


@pytest.fixture(scope="module")
def alone() -> Assembly:
    """The slab."""
    return slab()


@pytest.fixture(scope="module")
def one(cell_of: Callable[..., Cell]) -> Cell:
    """One arm, and a table below each of its drop-off poses."""
    return tabled(cell_of(1))


@pytest.fixture(scope="module")
def plan(alone: Assembly, one: Cell) -> RobotPlan:
    """A plan in which the slab is put down."""
    found = planned(alone, one, allow_regrasp=True).value
    assert found is not None
    return found


@pytest.fixture(scope="module")
def stack() -> Assembly:
    """The slab and two tiles."""
    return slab(tiles=2)


@pytest.fixture(scope="module")
def two(cell_of: Callable[..., Cell]) -> Cell:
    """Two arms."""
    return tabled(cell_of(2))


@pytest.fixture(scope="module")
def timed(stack: Assembly, two: Cell) -> RobotPlan:
    """A plan in which one arm puts the slab down while the other moves."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

    task = make_task(stack, two, allow_regrasp=True)
    settings = HybridSettings(Direction.DISASSEMBLY, attempts=3)
    found = plan_robots(stack, two, task=task, settings=settings, concurrent=True).value
    assert found is not None
    assert sum(step.put_down is not None for step in found.steps) == 1
    return found


def detour_of(plan: RobotPlan) -> tuple[int, RobotStep, np.ndarray, range]:
    """The step in which a part is put down: its index, itself, the pose, and the motions meanwhile."""
    index = next(k for k, step in enumerate(plan.steps) if step.put_down is not None)
    pose = plan.steps[index].put_down
    assert pose is not None
    return index, plan.steps[index], pose, lying_motions(plan, index)


def with_step(plan: RobotPlan, **changes: Any) -> RobotPlan:
    """The plan with another step in place of the one in which a part is put down."""
    index, step, _, _ = detour_of(plan)
    return replace(plan, steps=(*plan.steps[:index], replace(step, **changes), *plan.steps[index + 1 :]))


def what(report: CheckReport) -> str:
    """The problems of a report in one text."""
    return "; ".join(problem.what for problem in report.problems)


def test_without_it_there_is_no_plan(alone: Assembly, one: Cell) -> None:
    """The arm reaches the slab by its edges only, and with these grasps no drop-off pose is free."""
    found = planned(alone, one, allow_regrasp=False)
    assert found.value is None
    assert found.explanation is not None
    assert "remove slab-0" in found.explanation.text
    graph, state = KeyframeGraph(alone, one), complete_state(alone.boundary)
    ways = np.array([grip.grasp.approach for grip in graph.grips(0, SLAB, state)])
    assert len(ways)
    assert np.abs(ways[:, 2]).max() < 1e-6
    (hold, *_) = graph.edges(graph.start(state, one.homes, (None,)), SLAB)
    assert next(graph.edges(hold.node, SLAB + alone.part_count), None) is None
    logged = {entry.what for entry in graph.reasons.counts if entry.action == "remove"}
    assert "every drop-off pose collides" in logged


def test_the_part_is_put_down_and_gripped_in_another_way(plan: RobotPlan, alone: Assembly, one: Cell) -> None:
    index, step, pose, lying = detour_of(plan)
    assert index == REMOVAL
    assert plan.does(index) == "remove slab-0, put down and gripped again on the way"
    assert [trajectory.part for trajectory in step.trajectories] == [
        None if number in lying else SLAB for number in range(len(step.trajectories))
    ]
    parts = place_parts(alone, one.placement)
    corners, center = apply(pose, parts.meshes[SLAB].vertices), apply(pose, parts.center[:1])[0]
    assert corners[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    low = corners[corners[:, 2] < 1e-6, :2]
    assert len(low) >= 3
    inside = (low.min(axis=0) < center[:2]).all() and (center[:2] < low.max(axis=0)).all()
    assert inside
    first, last = (load_of(plan, index, k) for k in (0, len(step.trajectories) - 1))
    assert first is not None
    assert last is not None
    assert first.grip is not None
    assert last.grip is not None
    np.testing.assert_array_equal(first.pose, np.eye(4))
    np.testing.assert_array_equal(last.pose, pose)
    np.testing.assert_allclose(last.grip, step.trajectories[lying.stop].positions[0], rtol=0, atol=1e-12)
    report = check_robot_plan(plan, alone, one)
    assert report.good, what(report)
    assert validate_plan(plan.plan, alone).good


def test_in_reverse_it_is_gripped_for_its_place(plan: RobotPlan, alone: Assembly, one: Cell) -> None:
    back = plan.reverse()
    report = check_robot_plan(back, alone, one)
    assert report.good, what(report)
    index, step, pose, lying = detour_of(back)
    first, last = (load_of(back, index, k) for k in (0, len(step.trajectories) - 1))
    assert first is not None
    assert last is not None
    assert first.grip is not None
    np.testing.assert_array_equal(first.pose, pose)
    np.testing.assert_allclose(first.grip, step.trajectories[lying.start - 1].positions[-1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(last.pose, np.eye(4))
    np.testing.assert_array_equal(last.grip, back.keyframes[index + 1].configurations[0])
    again = back.reverse()
    assert [t.part for t in again.steps[REMOVAL].trajectories] == [t.part for t in plan.steps[REMOVAL].trajectories]


def test_it_is_not_put_down_where_it_can_be_delivered(alone: Assembly, cell_of: Callable[..., Cell]) -> None:
    free = planned(alone, cell_of(1), allow_regrasp=True).value
    assert free is not None
    assert all(step.put_down is None for step in free.steps)
    graph, state = KeyframeGraph(alone, cell_of(1)), complete_state(alone.boundary)
    graph.allow_regrasp = True
    hold = next(graph.edges(graph.start(state, cell_of(1).homes, (None,)), SLAB))
    assert all(edge.put_down is None for edge in graph.edges(hold.node, SLAB + alone.part_count))


def test_without_a_floor_there_is_no_place(alone: Assembly, one: Cell) -> None:
    assert planned(alone, replace(one, floor=None), allow_regrasp=True).value is None


def test_files_keep_it(plan: RobotPlan, tmp_path: Path) -> None:
    save_robot_plan(plan, tmp_path / "plan.json")
    read = load_robot_plan(tmp_path / "plan.json")
    np.testing.assert_allclose(detour_of(read)[2], detour_of(plan)[2], atol=1e-11)
    assert [step.put_down is None for step in read.steps] == [True, False]
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator(robot_plan_schema()).validate(json.loads((tmp_path / "plan.json").read_text()))


def test_files_that_were_tampered_with_are_refused(plan: RobotPlan) -> None:
    index, _, pose, lying = detour_of(plan)

    def refused(message: str, alter: Callable[[dict[str, Any], list[dict[str, Any]]], None]) -> None:
        data = json.loads(json.dumps(robot_plan_to_dict(plan)))
        alter(data["steps"][index], data["steps"][index]["trajectories"])
        with pytest.raises(PlanError, match=message):
            robot_plan_from_dict(data)

    refused("not rigid", lambda step, _: step.update(put_down=(2 * np.eye(4)).tolist()))
    mirrored = pose @ np.diag([1.0, 1.0, -1.0, 1.0])
    refused("not rigid", lambda step, _: step.update(put_down=mirrored.tolist()))
    refused(r"put_down is \[1.0, 2.0\]; give a list", lambda step, _: step.update(put_down=[1.0, 2.0]))
    refused("put_down", lambda step, _: step.update(put_down=np.full((4, 4), np.inf).tolist()))
    refused("carry it, leave it and carry it on", lambda _, moves: moves[-1].update(part=None))
    refused("carry it, leave it and carry it on", lambda _, moves: moves[0].update(part=None))
    refused("more than once", lambda _, moves: moves[lying.start + 1].update(part=SLAB))
    refused("on which it may touch it", lambda _, moves: moves[lying.start].update(touches=None))
    refused("on which it may touch it", lambda _, moves: moves[lying.stop - 1].update(kind="free"))
    refused("lifted again, on a line", lambda _, moves: moves[lying.stop].update(kind="free"))
    data = json.loads(json.dumps(robot_plan_to_dict(plan)))
    data["steps"][0]["put_down"] = pose.tolist()
    with pytest.raises(PlanError, match="neither leaves the structure nor comes to it"):
        robot_plan_from_dict(data)


@pytest.mark.parametrize("backwards", [False, True])
def test_the_check_sees_a_part_that_does_not_lie_where_its_robot_has_it(
    plan: RobotPlan, alone: Assembly, one: Cell, backwards: bool
) -> None:
    plan = plan.reverse() if backwards else plan
    _, _, pose, _ = detour_of(plan)
    aside = pose.copy()
    aside[0, 3] += 0.02
    assert "lies 20.0 mm away from where its robot has it" in what(
        check_robot_plan(with_step(plan, put_down=aside), alone, one)
    )
    above = pose.copy()
    above[2, 3] += 0.03
    assert "does not rest where it is put down: it is 30.0 mm above the floor" in what(
        check_robot_plan(with_step(plan, put_down=above), alone, one)
    )


def test_the_check_sees_a_part_that_would_not_rest(plan: RobotPlan, alone: Assembly, one: Cell) -> None:
    """The floor is 0.05 m lower than where the slab is put down; all other motions stay free."""
    low = replace(one, floor=-0.05)
    report = check_robot_plan(replace(plan, cell_identity=cell_identity(low)), alone, low)
    assert what(report) == "slab-0 does not rest where it is put down: it is 50.0 mm above the floor"


def test_the_check_sees_a_place_that_is_not_free(plan: RobotPlan, alone: Assembly, one: Cell) -> None:
    _, _, pose, _ = detour_of(plan)
    parts = place_parts(alone, one.placement)
    x, y = apply(pose, parts.center[:1])[0][:2]
    stone = Obstacle("stone", (block((x - 0.01, y - 0.01, 0.0), (x + 0.01, y + 0.01, 0.02)),))
    crowded = replace(one, obstacles=(*one.obstacles, stone))
    report = check_robot_plan(replace(plan, cell_identity=cell_identity(crowded)), alone, crowded)
    assert "slab-0 is put down in stone" in what(report)
    judge, load = PinocchioCollisionChecker(crowded, parts, 0.001), Load(SLAB, None, pose)
    assert judge.obstructs(load, np.arange(len(parts.names)) != SLAB) == "stone"
    assert PinocchioCollisionChecker(one, parts, 0.001).obstructs(load, np.arange(len(parts.names)) != SLAB) is None
    home = Load(SLAB, None, np.eye(4) + 0.0)
    home.pose[2, 3] = -0.05
    assert judge.obstructs(home, np.arange(len(parts.names)) != SLAB) == "part plinth-1"
    assert judge.obstructs(home, np.zeros(len(parts.names), bool)) is None


@pytest.mark.parametrize("backwards", [False, True])
def test_the_check_sees_a_gripper_that_takes_nothing(
    plan: RobotPlan, alone: Assembly, one: Cell, backwards: bool
) -> None:
    """The gripper closes where its approach begins; the motions go on without a jump."""
    plan = plan.reverse() if backwards else plan
    _, step, _, lying = detour_of(plan)
    moves = list(step.trajectories)
    before, after = (lying.start - 1, lying.start) if backwards else (lying.stop - 1, lying.stop)
    off = moves[after].positions[-1] if backwards else moves[before].positions[0]
    for number, knot in ((before, -1), (after, 0)):
        positions = moves[number].positions.copy()
        positions[knot] = off
        moves[number] = replace(moves[number], positions=positions)
    report = check_robot_plan(with_step(plan, trajectories=tuple(moves)), alone, one)
    assert "mm away from slab-0, which lies on the floor" in what(report)


def test_the_check_sees_a_part_that_is_not_lifted_from_where_it_lies(
    plan: RobotPlan, alone: Assembly, one: Cell
) -> None:
    """The slab is put down with one grasp, and the file says that it lies turned by a quarter about the vertical."""
    _, _, pose, _ = detour_of(plan)
    parts = place_parts(alone, one.placement)
    middle = apply(pose, parts.center[:1])[0]
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    report = check_robot_plan(with_step(plan, put_down=turn @ pose), alone, one)
    assert "from where its robot has it" in what(report)
    assert "does not rest" not in what(report)


def test_a_part_stands_on_a_face_of_some_width_only() -> None:
    """A cube of 1 m: on a face, on an edge, and with its weight beside the face."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    middle = np.full(3, 0.5)
    assert unrest(corners, middle, 0.0) == ""
    assert "no floor" in unrest(corners, middle, None)
    assert "below the floor" in unrest(corners, middle, 0.1)
    assert "well above the face" in unrest(corners, np.array([0.99, 0.5, 0.5]), 0.0)
    assert "well above the face" in unrest(corners, np.array([1.5, 0.5, 0.5]), 0.0)
    edge = corners @ Rotation.from_euler("x", 45, degrees=True).as_matrix().T
    edge -= edge.min(axis=0)
    assert "an edge or a corner" in unrest(edge, edge.mean(axis=0), 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_faces_are_turned_downwards_by_the_least_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for normal in (*rng.normal(size=(20, 3)), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
        unit = normal / np.linalg.norm(normal)
        turn = least_turn(unit, np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]))
        np.testing.assert_allclose(turn @ unit, (0.0, 0.0, -1.0), atol=1e-7)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-7)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert Rotation.from_matrix(turn).magnitude() == pytest.approx(np.arccos(np.clip(-unit[2], -1, 1)), abs=1e-6)


def test_a_schedule_keeps_other_arms_away_whatever_the_delays(timed: RobotPlan, stack: Assembly, two: Cell) -> None:
    from falsework.robots import schedule_plan, simulate

    for plan in (timed, timed.reverse(), schedule_plan(timed.reverse(), stack, two)):
        assert plan.schedule is not None
        assert (np.diff(event_times(plan, plan.schedule)) >= 0).all()
        report = check_robot_plan(plan, stack, two)
        assert report.good, what(report)
        assert simulate(plan, runs=20).good


def test_another_arm_meets_the_part_while_it_lies(timed: RobotPlan, stack: Assembly, two: Cell) -> None:
    """In every model of what a robot occupies: the part is there while it lies, in motions and rests, and only then."""
    graph = timed.schedule
    assert graph is not None
    index, step, pose, lying = detour_of(timed)
    starts = graph.starts()
    nodes = {graph.nodes[k].trajectory: k for k in graph.of_robot(step.robot) if graph.nodes[k].step == index}
    begin = starts[nodes[lying.start]]
    end = starts[nodes[lying.stop - 1]] + graph.nodes[nodes[lying.stop - 1]].seconds
    for moment in np.linspace(begin + 1e-4, end - 1e-4, 40):
        arm = list(activities_at(timed, starts, float(moment)))[step.robot]
        assert arm.load is not None
        assert arm.load.lies
    for moment in (begin - 1e-3, end + 1e-3):
        arm = list(activities_at(timed, starts, float(moment)))[step.robot]
        assert arm.load is not None
        assert not arm.load.lies
    parts = place_parts(stack, two.placement)
    load = load_of(timed, index, lying.start + 1)
    bodies = SweptBodies(CollisionWorld(two, parts))
    away = step.trajectories[lying.start + 1].positions[0]
    probe = still((apply(pose, parts.pieces[SLAB][0]),))
    for given, met in ((load, True), (None, False)):
        swept = bodies.resting(step.robot, away, given)
        assert conflicts((swept, swept), (probe, probe), 0.0)[0, 0] == met
    judge, other = PinocchioCollisionChecker(two, parts, 0.001), 1 - step.robot
    tool = np.diag([1.0, -1.0, -1.0, 1.0])
    tool[:3, 3] = apply(pose, parts.center[:1])[0]
    values = inverse(two.robots[other], tool[None])[0]
    assert len(values)
    assert load is not None
    nothing = np.zeros(len(parts.names), bool)
    hit = judge.prepare(other, two.homes, nothing, loads={step.robot: load}).hits(values[0])
    assert hit is not None
    assert hit[1] == "part slab-0"
    frames = list(two.homes)
    frames[other] = values[0]  # the other arm rests in the part, which this one has put down
    assert judge.prepare(step.robot, frames, nothing, load=load).hits(away) is not None
    assert judge.prepare(step.robot, frames, nothing).hits(away) is None
    assert sum(body.name == "part slab-0" for body in judge.arm(step.robot, load)) == 1


def test_a_part_in_the_way_of_another_arm_is_found_whatever_the_delays(
    timed: RobotPlan, stack: Assembly, two: Cell
) -> None:
    """The slab lies where the other arm carries a tile meanwhile: the check sees it, and a new schedule would wait."""
    _, step, pose, _ = detour_of(timed)
    parts, other = place_parts(stack, two.placement), 1 - step.robot
    judge = PinocchioCollisionChecker(two, parts, 0.001)
    carries = [t for entry in timed.steps if entry.robot == other for t in entry.trajectories if t.part is not None]
    middle = carries[-1].sample(np.array([0.6 * carries[-1].seconds]))[0]
    there = pose.copy()
    there[:3, 3] += judge.flange(other, middle)[:3, 3] - apply(pose, parts.center[:1])[0]
    assert not check_delays(timed, judge).problems
    moved = with_step(timed, put_down=there)
    found = check_delays(moved, judge).problems
    assert any("part slab-0" in (problem.pair or ()) for problem in found)
    rows = Itineraries(moved, CollisionWorld(two, parts))
    assert len(choices(rows)) > len(choices(Itineraries(timed, CollisionWorld(two, parts))))


def test_controllers_open_and_close_the_gripper_on_the_way(
    plan: RobotPlan, alone: Assembly, one: Cell, tmp_path: Path
) -> None:
    def grips(given: RobotPlan, index: int) -> list[bool | None]:
        events = events_of(given, index)
        return [event.close if isinstance(event, Grip) else None for event in events]

    _, step, _, lying = detour_of(plan)
    count = len(step.trajectories)
    wanted: list[bool | None] = [None] * count
    wanted.insert(lying.stop, True)
    wanted.insert(lying.start, False)
    assert grips(plan, REMOVAL) == [*wanted, False]
    back = plan.reverse()
    assert grips(back, 0) == [True, *(None if grip is None else not grip for grip in reversed(wanted))]
    export_plan(plan, tmp_path, "ros2-json")
    sequence = json.loads((tmp_path / "step-002.json").read_text())["sequence"]
    assert [entry.get("gripper") for entry in sequence if "gripper" in entry] == ["open", "close", "open"]
    export_plan(plan, tmp_path / "rapid", "rapid", cell=one, structure=alone)
    program = (tmp_path / "rapid" / "arm_1.mod").read_text()
    body = program[program.index("PROC arm_1_step2()") : program.index("PROC arm_1_run()")]
    loads = re.findall(r"GripLoad (\w+);", body)
    assert loads == ["arm_1_load1", "load0", "arm_1_load2", "load0"]  # gripped in two ways, so with two centres
    assert len(set(re.findall(r"PERS loaddata \w+ := (.*);", program))) == 2
    assert [line.split()[-1] for line in body.splitlines() if "_gripper " in line] == ["FALSE;", "TRUE;", "FALSE;"]
    export_plan(plan, tmp_path / "csv", "csv")


@pytest.mark.parametrize("assembles", [False, True])
def test_a_bag_attaches_the_part_twice(
    plan: RobotPlan, alone: Assembly, one: Cell, tmp_path: Path, assembles: bool
) -> None:
    """With its mesh where the gripper has it: where it is put down, and taken up again, it is where it lies."""
    plan = plan.reverse() if assembles else plan
    (path,) = export_plan(plan, tmp_path, "mcap", structure=alone, cell=one)
    scenes = [scene for _, scene in planning_scenes(path)[1:]]
    attached = [thing for scene in scenes for thing in scene.robot_state.attached_collision_objects]
    assert [thing.object.operation for thing in attached] == [0, 1, 0, 1]
    assert [len(scene.world.collision_objects) for scene in scenes] == [0, 0, 0, 0 if assembles else 1]
    _, step, pose, lying = detour_of(plan)
    ends = step.trajectories[lying.start].positions[0], step.trajectories[lying.stop].positions[0]
    there = apply(pose, place_parts(alone, one.placement).meshes[SLAB].vertices)
    entry = one.robots[step.robot]
    for thing, values in zip((attached[0], attached[2]), ends, strict=True):
        flange = flange_pose(entry.model, values, entry.base)
        np.testing.assert_allclose(apply(flange, corners(thing.object)), there, atol=1e-6)


def test_a_chart_shows_the_part_carried_twice(timed: RobotPlan) -> None:
    index, step, _, lying = detour_of(timed)
    graph = timed.schedule
    assert graph is not None
    starts = graph.starts()
    number = next(k for k, node in enumerate(graph.nodes) if (node.step, node.trajectory) == (index, lying.start + 1))
    bars = [bar for bar in bars_of(timed) if bar.robot == step.robot]
    assert next(bar.does for bar in bars if bar.begin == starts[number] and bar.end > bar.begin) == "moves"
    assert sum(bar.does == "carries" and bar.part == SLAB for bar in bars) == len(step.trajectories) - len(lying)


@pytest.mark.parametrize("direction", list(Direction))
def test_the_page_shows_the_part_all_the_way(plan: RobotPlan, one: Cell, direction: Direction) -> None:
    """The part moves without a jump, and lies still in between."""
    arms = Arms(plan, one, Direction.DISASSEMBLY).turned(direction)
    shown = [arms.at_time(time).carried for time in np.linspace(0.0, arms.clock.makespan, 4000)]
    carried = np.flatnonzero([len(entry) for entry in shown])
    assert (np.diff(carried) == 1).all()
    assert max(map(len, shown)) == 1
    poses = np.array([shown[row][0].pose for row in carried])
    assert np.abs(np.diff(poses, axis=0)).max() < 0.03
    assert (np.abs(poses - detour_of(plan)[2]).max(axis=(1, 2)) < 1e-9).sum() > 100


def test_states_do_not_know_it(plan: RobotPlan) -> None:
    """The slab has left the structure when it is put down: the abstract plan is that of a removal."""
    assert len(plan) == len(plan.plan) == 2
    assert plan.states[REMOVAL + 1][SLAB] == REMOVED
