"""Robot plans in which parts wait half way out, while arms take others aside, and go on later."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, check, make_task, plan_robots
from falsework.assembly.library.blocks import box, gather
from falsework.errors import InputError, PlanError
from falsework.geometry.clearance.moves import PathMove
from falsework.robots import Cell, RobotPlan
from falsework.robots.exports.export import export_plan
from falsework.robots.keyframes.keyframe_graph import KeyframeGraph
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.plans.continued import continued
from falsework.robots.plans.robot_plan_file import robot_plan_from_dict, robot_plan_to_dict
from falsework.robots.plans.timeline import interruption, schedule_of, waiting_at
from falsework.robots.schedule.simulation import simulate
from falsework.search.plans.plan_check import validate_plan
from falsework.viewer.arms import Arms
from falsework.viewer.palette import INSTALLED
from tests.robots.plans.conftest import boxes, make_cell
from tests.robots.plans.test_ways import value


@cache
def pit(*, pad: bool = False) -> Assembly:
    """A bar in a pit, half below a lid that stays in the end, and that no arm holds then; beside it perhaps a pad."""
    walls = [
        ((-0.5, -0.5, 0.0), (-0.3, 0.5, 0.1)),
        ((0.1, -0.5, 0.0), (0.5, 0.5, 0.1)),
        ((-0.3, -0.5, 0.0), (0.1, -0.1, 0.1)),
        ((-0.3, 0.1, 0.0), (0.1, 0.5, 0.1)),
    ]
    made = gather(
        [
            box("bar", (-0.3, -0.1, 0.0), (0.1, 0.1, 0.1)),
            box("lid", (0.0, -0.1, 0.1), (0.26, 0.1, 0.2)),
            *([box("pad", (0.3, 0.25, 0.1), (0.45, 0.4, 0.2))] if pad else []),
            box("ground", (-0.6, -0.6, -0.05), (0.6, 0.6, 0.0), fixed=True),
            *(box("wall", low, high, fixed=True) for low, high in walls),
        ]
    )
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="pit")


def planned(assembly: Assembly, cell: Cell, *leaving: int, moves: int = 2, waiting: bool = True) -> RobotPlan:
    target = np.where(assembly.boundary, 2, 1)
    target[list(leaving)] = 0
    task = make_task(assembly, cell.robot_count, target=target, moves=moves, waiting=waiting)
    return value(plan_robots(assembly, cell, task=task, concurrent=cell.robot_count > 1))


@pytest.fixture(scope="module")
def cell() -> Cell:
    return make_cell(payload=20.0)


@pytest.fixture(scope="module")
def lone() -> Cell:
    return make_cell(bases=1, payload=20.0)


@pytest.fixture(scope="module")
def lidded(cell: Cell) -> RobotPlan:
    return planned(pit(), cell, 0)


@pytest.fixture(scope="module")
def alone(lone: Cell) -> RobotPlan:
    return planned(pit(), lone, 0)


def refused(plan: RobotPlan, cell: Cell, text: str) -> None:
    report = check(pit(), replace(plan, schedule=None), cell)
    problems = [problem.what for problem in report.problems]
    assert any(text in what for what in problems), problems


def does(plan: RobotPlan) -> list[str]:
    return [plan.does(step) for step in range(len(plan))]


def test_an_arm_lays_a_lid_aside_that_nothing_holds_and_lays_it_back(lidded: RobotPlan, cell: Cell) -> None:
    for plan in (lidded, lidded.reverse()):
        report = check(pit(), plan, cell)
        assert report.good, report.problems
    assert does(lidded)[:7] == [
        "take lid-1",
        "move lid-1 aside",
        "let go of lid-1",
        "insert bar-0",
        "take lid-1",
        "move lid-1 back",
        "let go of lid-1",
    ]
    assert {lidded.steps[0].robot, lidded.steps[4].robot} == {1}
    assert lidded.steps[3].robot == 0
    ((part, pose),) = lidded.keyframes[4].waits
    assert part == 1
    np.testing.assert_allclose(pose[:3, 3], (0.1, 0.0, 0.0), atol=1e-9)
    assert simulate(lidded, runs=50).good


def test_one_arm_lets_go_of_the_part_that_leaves_while_it_moves_another(alone: RobotPlan, lone: Cell) -> None:
    for plan in (alone, alone.reverse()):
        report = check(pit(), plan, lone)
        assert report.good, report.problems
    assert does(alone)[3:9] == [
        "insert bar-0",
        "let go of bar-0",
        "take lid-1",
        "move lid-1 back",
        "let go of lid-1",
        "take bar-0",
    ]
    assert {part for part, _ in alone.keyframes[5].waits} == {0, 1}
    assert alone.keyframes[5].held == (None,)


@pytest.mark.parametrize("name", ["lidded", "alone"])
def test_files_keep_what_waits(name: str, request: pytest.FixtureRequest) -> None:
    plan: RobotPlan = request.getfixturevalue(name)
    robots = request.getfixturevalue("cell" if name == "lidded" else "lone")
    data = json.loads(json.dumps(robot_plan_to_dict(plan)))
    again = robot_plan_from_dict(data)
    for one, other in zip(again.keyframes, plan.keyframes, strict=True):
        assert [part for part, _ in one.waits] == [part for part, _ in other.waits]
    assert check(pit(), again, robots).good
    frame = next(frame for frame in data["keyframes"] if frame.get("waits"))
    whole = frame["waits"]
    for waits, text in (
        ([], "although no gripper takes it or lets go of it"),
        ([*whole, *whole], "has a part that waits in two places"),
        ([{"part": 99, "pose": np.eye(4).tolist()}], "it must be null or a part from 0 to"),
        ([{"part": 1, "pose": [[1.0]] * 4}], "has shape"),
        ([{"part": 1, "pose": (2 * np.eye(4)).tolist()}], "cannot wait half way out as a keyframe says"),
        ([{"part": 2, "pose": np.eye(4).tolist()}], "cannot wait half way out as a keyframe says"),
    ):
        frame["waits"] = waits
        with pytest.raises(PlanError, match=text) as caught:
            robot_plan_from_dict(data)
        assert "\n" not in str(caught.value)


def test_the_page_pictures_and_exports_show_what_waits(lidded: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    arms, starts = Arms(lidded, cell, lidded.direction), schedule_of(lidded).starts()
    nodes = schedule_of(lidded).nodes
    insert = next(k for k, node in enumerate(nodes) if node.step == 3)
    moment = float(starts[insert]) + nodes[insert].seconds / 2
    (seen,) = [part for part in arms.at_time(moment).carried if part.part == 1]
    assert seen.color == INSTALLED
    np.testing.assert_allclose(seen.pose[:3, 3], (0.1, 0.0, 0.0), atol=1e-6)
    assert [load.part for load in waiting_at(lidded, moment)] == [1]
    assert not waiting_at(lidded, 0.0)
    assert not waiting_at(lidded, lidded.makespan + 1.0)
    for form in ("rapid", "urscript", "ros2-goals", "csv", "mcap"):
        assert export_plan(lidded, tmp_path / form, form, structure=pit(), cell=cell, force=True)
    program = (tmp_path / "rapid" / "arm_2.mod").read_text()
    assert program.count("let go of lid-1") >= 2


def test_an_interruption_waits_until_nothing_waits(alone: RobotPlan) -> None:
    known = 0
    for seconds in np.linspace(0.0, alone.makespan, 25):
        now = interruption(alone, float(seconds))
        frames = [k for k, done in enumerate(alone.done) if done == now.done]
        ends = [k for k in frames if np.array_equal(alone.keyframes[k].configurations[0], now.configurations[0])]
        assert any(not alone.keyframes[k].waits for k in ends) or not ends
        assert all(grip is None for grip in now.gripped)
        known += bool(ends)
    assert known >= 3


def test_a_plan_that_goes_on_keeps_the_rule_of_the_steps_that_are_done(lone: Cell) -> None:
    """The bar is in, past the lid that waited; then a pad is laid down, for which nothing waits."""
    assembly = pit(pad=True)
    end = np.where(assembly.boundary, 2, 1)
    first, middle = (np.where(np.isin(np.arange(len(end)), gone), 0, end) for gone in ([0, 2], [2]))
    tasks = (
        make_task(assembly, 1, start=middle, target=first, moves=2, waiting=True),
        make_task(assembly, 1, start=end, target=middle, removable_only_if_clear=True),
    )
    begun, rest = (value(plan_robots(assembly, lone, task=task, concurrent=False)) for task in tasks)
    assert (begun.plan.waiting, rest.plan.waiting) == (True, False)
    whole, fails = continued(rest, begun, 2, assembly)
    assert fails is None
    report = validate_plan(whole.plan, assembly)
    assert report.good, report.reason


def test_without_the_rule_or_with_other_poses_a_plan_is_refused(lidded: RobotPlan, cell: Cell) -> None:
    """A lid that waits beside its way, one that nobody lays back, and a plan whose rules let nothing wait."""
    refused(replace(lidded, plan=replace(lidded.plan, waiting=False)), cell, "carries a part that is in place")
    frames, far = list(lidded.keyframes), np.eye(4)
    far[0, 3] = 0.2
    for k, frame in enumerate(frames):
        frames[k] = replace(frame, waits=tuple((part, far) for part, _ in frame.waits))
    refused(replace(lidded, keyframes=tuple(frames)), cell, "mm away from where its robot has it")
    way = lidded.plan.exit_paths[0]
    for moves in ((replace(way[0], distance=0.05), way[1]), way[1:]):
        changed = replace(lidded.plan, exit_paths=(moves, *lidded.plan.exit_paths[1:]))
        refused(replace(lidded, plan=changed), cell, "of its way")


def test_a_held_part_waits_only_while_no_other_robot_is_free(alone: RobotPlan, lone: Cell) -> None:
    """The states have the bar held in other moves, so that letting go of it there is not known to be safe."""
    step = next(k for k in range(len(alone)) if alone.does(k) == "take bar-0")
    frames, steps = list(alone.keyframes), list(alone.steps)
    swapped = replace(steps[step], trajectories=steps[step].trajectories[:-1])
    refused(
        replace(alone, steps=(*steps[:step], swapped, *steps[step + 1 :])), lone, "is taken, or let go of, otherwise"
    )
    lost = replace(frames[5], waits=tuple(entry for entry in frames[5].waits if entry[0] != 0), held=(0,))
    refused(replace(alone, keyframes=(*frames[:5], lost, *frames[6:])), lone, "its way")


def test_a_part_that_leaves_is_taken_again_where_it_waits() -> None:
    """One arm moves a cube on, lets go of it, puts another one into its place, takes it there, and delivers it."""
    assembly, cell = boxes((-0.3, -0.2, 0.0), (-0.3, 0.05, 0.0)), make_cell(bases=1)
    graph = KeyframeGraph(assembly, cell)
    state = np.where(assembly.boundary, 2, 1).astype(np.uint8)
    held = next(graph.edges(graph.start(state, cell.homes, (None,)), 0)).node
    way = (
        PathMove((0,), (1.0, 0.0, 0.0), 0.3),
        PathMove((1,), (0.0, -1.0, 0.0), 0.25),
        PathMove((0,), (0.0, 0.0, 1.0), np.inf),
    )
    first = next(graph.ways_in_turn.edges(held, way))
    chain = [first, *first.node.following]
    hands = [edge.node.hands for edge in chain]
    assert hands == [(0,), (None,), (1,), (1,), (None,), (0,), (None,), (1,), (1,), (None,)]
    (part, pose), (other, there) = chain[4].node.waits
    assert (part, other) == (0, 1)
    np.testing.assert_allclose(pose[:3, 3], (0.3, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(there[:3, 3], (0.0, -0.25, 0.0), atol=1e-9)
    taken = tool_pose(cell.robots[0], chain[5].node.configurations[0])
    assert np.abs(taken[:2, 3] - (-0.2 + 0.3, -0.1)).max() < 0.1  # on its top, where it waits
    assert not chain[-1].node.waits
    assert not chain[-1].node.carried
    assert chain[-1].node.state.tolist() == [0, 1, 2]


@pytest.mark.parametrize("moves", [1])
def test_a_way_of_one_move_has_nothing_that_waits(cell: Cell, moves: int) -> None:
    with pytest.raises(InputError, match="waits half way out only on a way of several moves") as caught:
        planned(pit(), cell, 0, moves=moves)
    assert "\n" not in str(caught.value)
