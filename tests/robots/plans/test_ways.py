"""Robot plans whose parts leave on paths of several moves, or several at one instant, each carried by its own arm."""

from __future__ import annotations

import csv
import json
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, Outcome, check, make_task, plan_robots
from falsework.assembly.library import shelf as built_in_shelf
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.library.voxels import surface
from falsework.errors import InputError, PlanError
from falsework.geometry.clearance.moves import PathMove
from falsework.geometry.paths.path_search import Found, PathSearch
from falsework.robots import Cell, HybridSettings, RobotPlan
from falsework.robots.exports.export import export_plan
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Placement
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.continued import continued
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_from_dict,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.timeline import interruption, schedule_of
from falsework.robots.plans.trajectory import Trajectory, move_fault
from falsework.robots.schedule.simulation import simulate
from tests.robots.plans.conftest import make_cell
from tests.robots.plans.program_grammar import Rapid
from tests.search.test_together import diverging

Cells = frozenset[tuple[int, int, int]]


def cells(x: range, y: range, z: range) -> Cells:
    return frozenset(product(x, y, z))


@cache
def tray() -> Assembly:
    """A bar with one end under a lip, before a wall: it leaves out from under the lip, then up."""
    bar, outer = cells(range(6), range(2), range(2)), cells(range(-1, 10), range(-1, 3), range(-1, 4))
    way = cells(range(9), range(2), range(2)) | cells(range(3, 9), range(2), range(2, 4))
    way |= cells(range(9, 10), range(-1, 3), range(2, 4))
    solids = [
        replace(surface(name, solid, (0.05,) * 3, (-0.2, -0.05, 0.05)), fixed=name == "tray")
        for name, solid in (("bar", bar), ("tray", outer - way))
    ]
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="tray")


@cache
def hatch() -> Assembly:
    """A lid between walls with its back end under a ledge: it tips up about that edge, and slides out."""
    made = gather(
        [
            box("lid", (-0.15, -0.1, 0.05), (0.15, 0.1, 0.07)),
            box("floor", (-0.2, -0.15, 0.0), (0.2, 0.15, 0.05), fixed=True),
            box("back", (-0.2, -0.15, 0.05), (-0.16, 0.15, 0.15), fixed=True),
            box("ledge", (-0.16, -0.15, 0.08), (-0.12, 0.15, 0.15), fixed=True),
            box("side", (-0.16, -0.15, 0.05), (0.15, -0.1, 0.08), fixed=True),
            box("side", (-0.16, 0.1, 0.05), (0.15, 0.15, 0.08), fixed=True),
            box("front", (0.15, -0.15, 0.05), (0.2, 0.15, 0.07), fixed=True),
        ]
    )
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="hatch")


def opened(assembly: Assembly, cell: Cell, *, concurrent: bool = True, **rules: Any) -> HybridResult:
    task = make_task(assembly, cell.robot_count, removable_only_if_clear=True, **rules)
    return plan_robots(assembly, cell, task=task, concurrent=concurrent)


def value(result: HybridResult) -> RobotPlan:
    assert result.value is not None, result.reason
    return result.value


@pytest.fixture(scope="module")
def cell() -> Cell:
    return make_cell(payload=20.0)


@pytest.fixture(scope="module")
def bent(cell: Cell) -> RobotPlan:
    return value(opened(tray(), cell, concurrent=False, moves=2))


@pytest.fixture(scope="module")
def tipped(cell: Cell) -> RobotPlan:
    return value(opened(hatch(), cell, concurrent=False, moves=2, turns=True))


@pytest.fixture(scope="module")
def spread(cell: Cell) -> tuple[Assembly, Cell, RobotPlan]:
    """Two parts that leave at one instant, one up to the left and one up to the right."""
    small = replace(cell, placement=Placement((0.0, 0.0, 0.15), scale=0.1))
    assembly = diverging(1.0, 0.3, 0.5).replace(density=600.0)
    return assembly, small, value(opened(assembly, small, parts_at_once=2))


@pytest.fixture(scope="module")
def lifted() -> tuple[Assembly, Cell, RobotPlan]:
    """Two boards that only lift off together, and come apart in the air; no arm can carry both."""
    assembly, weak = built_in_shelf(shelves=0).replace(density=600.0), make_cell(payload=2.6)
    return assembly, weak, value(opened(assembly, weak, parts_at_once=2))


def tools(plan: RobotPlan, cell: Cell, step: int, order: int) -> np.ndarray:
    leg = plan.steps[step].trajectories[order]
    return tool_pose(cell.robots[plan.steps[step].robot], leg.dense(0.01)[1])


def moved(plan: RobotPlan, step: int, order: int, robot: int, change: Callable[[Trajectory], Trajectory]) -> RobotPlan:
    """Change a trajectory of a robot."""
    entry, steps = plan.steps[step], list(plan.steps)

    def changed(legs: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
        return tuple(change(leg) if k == order else leg for k, leg in enumerate(legs))

    if robot == entry.robot:
        steps[step] = replace(entry, trajectories=changed(entry.trajectories))
    else:
        partners = [
            replace(one, trajectories=changed(one.trajectories)) for one in entry.partners if one.robot == robot
        ]
        steps[step] = replace(entry, partners=tuple(partners))
    return replace(plan, steps=tuple(steps))


def bowed(leg: Trajectory) -> Trajectory:
    """The same with one joint off in the middle by less than a degree."""
    positions = leg.positions.copy()
    middle = len(positions) // 2
    positions[middle, 1] += 0.012
    return replace(leg, positions=positions)


def test_an_arm_carries_a_part_out_and_then_up(bent: RobotPlan, cell: Cell) -> None:
    assembly = tray()
    assert not assembly.clearance.can_leave(np.array([[1, 2]], np.uint8))[0, 0]
    report = check(assembly, bent, cell)
    assert report.good, report.problems
    assert [leg.kind for leg in bent.steps[0].trajectories] == ["free", "line", "line"]
    up, out = (tools(bent, cell, 0, order)[[0, -1], :3, 3] for order in (1, 2))
    np.testing.assert_allclose(out[0] - out[1], (0.15, 0.0, 0.0), atol=1e-4)
    np.testing.assert_allclose((up[1] - up[0])[:2], 0.0, atol=1e-4)
    assert (up[1] - up[0])[2] < -0.1
    again = robot_plan_from_dict(json.loads(json.dumps(robot_plan_to_dict(bent))))
    assert again.plan.exit_paths == bent.plan.exit_paths
    assert check(assembly, again, cell).good


def test_an_arm_turns_a_part_about_an_edge(tipped: RobotPlan, cell: Cell) -> None:
    report = check(hatch(), tipped, cell)
    assert report.good, report.problems
    (turn, slide) = tipped.plan.exit_paths[0]
    assert turn.turns
    assert not slide.turns
    ends = tools(tipped, cell, 0, 2)[[0, -1], :3, :3]
    about = Rotation.from_matrix(ends[0] @ ends[1].T).as_rotvec()
    np.testing.assert_allclose(about, turn.angle * np.array(turn.direction), atol=1e-3)
    reverse = tipped.reverse()
    assert reverse.direction is Direction.DISASSEMBLY
    assert check(hatch(), reverse, cell).good


@pytest.mark.parametrize("order", [1, 2])
def test_a_tool_beside_its_way_is_refused(bent: RobotPlan, tipped: RobotPlan, cell: Cell, order: int) -> None:
    for plan, assembly in ((bent, tray()), (tipped, hatch())):
        forged = moved(plan, 0, order, plan.steps[0].robot, bowed)
        problems = [problem.what for problem in check(assembly, forged, cell).problems]
        assert any("the tool is" in what and f"move {3 - order} of its way" in what for what in problems), problems


def test_a_plan_whose_way_is_another_is_refused(bent: RobotPlan, cell: Cell) -> None:
    """Motions follow the way of the plan, which is swept."""
    out, up = bent.plan.exit_paths[0]
    for way, text in (
        ((replace(out, distance=0.1), up), "it ends 50.0 mm beyond its end"),
        ((replace(out, distance=0.3), up), "before its end"),
        ((out, up, up), "its way out has 3 moves, and its part is on 2 lines"),
    ):
        ways = (way, *bent.plan.exit_paths[1:])
        report = check(tray(), replace(bent, plan=replace(bent.plan, exit_paths=ways)), cell)
        assert any(text in problem.what for problem in report.problems), text


def test_a_keyframe_elsewhere_is_refused(bent: RobotPlan, spread: tuple[Assembly, Cell, RobotPlan], cell: Cell) -> None:
    for plan, assembly, there in ((bent, tray(), cell), (spread[2], spread[0], spread[1])):
        for row in range(len(plan.keyframes)):
            frames = list(plan.keyframes)
            values = [*frames[row].configurations]
            values[0] = values[0] + 0.01
            frames[row] = replace(frames[row], configurations=tuple(values))
            report = check(assembly, replace(plan, keyframes=tuple(frames)), there)
            assert any("jumps by" in problem.what for problem in report.problems)


def test_a_way_beyond_reach_names_its_move() -> None:
    far = replace(make_cell(1), placement=Placement((0.33, 0.0, 0.0)))
    result = opened(tray(), far, concurrent=False, moves=2)
    assert result.value is None
    assert "move 1 of 2 (a line): " in result.reason, result.reason


def test_a_deadline_ends_the_search_for_a_way(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    search = PathSearch.run

    def slow(self: PathSearch, moves: int, *, turns: bool = False) -> Found:
        time.sleep(2.0)
        return search(self, moves, turns=turns)

    monkeypatch.setattr(PathSearch, "run", slow)
    task = make_task(tray(), 1, moves=2)
    result = plan_robots(tray(), cell, task=task, concurrent=False, deadline=1.0)
    assert result.value is None
    assert "the deadline has passed" in result.reason


def test_parts_leave_at_one_instant_along_different_directions(spread: tuple[Assembly, Cell, RobotPlan]) -> None:
    assembly, cell, plan = spread
    report = check(assembly, plan, cell)
    assert report.good, report.problems
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    step = plan.steps[joint]
    assert sorted(step.robots) == [0, 1]
    assert plan.does(joint) == "insert a-0 and b-1"
    ways = {}
    for robot in step.robots:
        ends = tool_pose(cell.robots[robot], step.of(robot)[0].positions[[0, -1]])[:, :3, 3]
        ways[plan.part_of(joint, robot)] = ends[0] - ends[1]
    np.testing.assert_allclose(ways[0] / np.linalg.norm(ways[0]), np.array([1, 0, 1]) / np.sqrt(2), atol=1e-3)
    np.testing.assert_allclose(ways[1], ways[0] * (-1, 1, 1), atol=1e-3)
    (node,) = [node for node in plan.schedule.nodes if node.others] if plan.schedule else [None]
    assert node is not None
    assert node.step == joint
    assert simulate(plan, runs=50).good


def test_boards_that_lift_off_together_come_apart_in_the_air(lifted: tuple[Assembly, Cell, RobotPlan]) -> None:
    """The deadlock of the shelf opens by two arms that hold one board each, where neither can carry both."""
    assembly, cell, plan = lifted
    report = check(assembly, plan, cell)
    assert report.good, report.problems
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    assert len(plan.steps[joint].trajectories) == 2
    assert [step.transit for step in plan.steps[joint - 2 : joint]] == [True, True]
    assert check(assembly, plan.reverse(), cell).good


def test_an_interrupted_assembly_goes_on_with_parts_at_one_instant(lifted: tuple[Assembly, Cell, RobotPlan]) -> None:
    """From where both arms carry their boards; what was begun and what follows are one plan."""
    assembly, cell, plan = lifted
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    graph = schedule_of(plan)
    begins = next(start for start, node in zip(graph.starts(), graph.nodes, strict=True) if node.step == joint)
    now = interruption(plan, begins - 0.05)
    assert sorted(part for part in now.held if part is not None) == [2, 3]
    task = make_task(assembly, 2, target=now.state, parts_at_once=2)
    given = {"configurations": now.configurations, "held": now.held, "gripped": now.gripped}
    rest = value(plan_robots(assembly, cell, task=task, **given))
    whole, fails = continued(rest, plan, now.done, assembly)
    assert fails is None
    assert whole.plan.parts_at_once == 2
    report = check(assembly, whole, cell)
    assert report.good, report.problems


def test_arms_that_are_out_of_step_are_refused(spread: tuple[Assembly, Cell, RobotPlan], tmp_path: Path) -> None:
    assembly, cell, plan = spread
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    other = plan.steps[joint].partners[0].robot
    slow = replace(moved(plan, joint, 0, other, lambda leg: replace(leg, times=1.5 * leg.times)), schedule=None)
    report = check(assembly, slow, cell)
    assert any("does not move at the same times as" in problem.what for problem in report.problems)
    save_robot_plan(slow, tmp_path / "slow.json")
    with pytest.raises(PlanError, match="does not move at the same times as"):
        load_robot_plan(tmp_path / "slow.json")
    bent = moved(plan, joint, 0, other, bowed)
    assert any("is no straight line" in problem.what for problem in check(assembly, bent, cell).problems)
    alone = replace(plan.steps[joint], partners=())
    steps = (*plan.steps[:joint], alone, *plan.steps[joint + 1 :])
    report = check(assembly, replace(plan, steps=steps, schedule=None), cell)
    assert any("it moves several parts with one robot" in problem.what for problem in report.problems)


def test_parts_that_meet_in_their_common_motion_are_refused(lifted: tuple[Assembly, Cell, RobotPlan]) -> None:
    """One board ahead of the other on the same way: each would be free where the other one rests, before and after."""
    assembly, cell, plan = lifted
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    step = plan.steps[joint]
    share = np.linspace(0.0, 1.0, 80)

    def ahead(by: float) -> Callable[[Trajectory], Trajectory]:
        def warped(leg: Trajectory) -> Trajectory:
            at = (share + by * np.sin(np.pi * share) ** 2) * leg.seconds
            rate = (1 + by * np.pi * np.sin(2 * np.pi * share))[:, None] / 3
            times, positions, velocities = 3 * share * leg.seconds, leg.sample(at), leg.rates(at) * rate
            return replace(leg, times=times, positions=positions, velocities=velocities)

        return warped

    for by, good in ((0.0, True), (0.12, False)):
        forged = moved(plan, joint, 1, step.robot, ahead(by))
        forged = replace(moved(forged, joint, 1, step.partners[0].robot, ahead(0.0)), schedule=None)
        problems = check(assembly, forged, cell).problems
        assert any("part top-2 collides with part top-3" in problem.what for problem in problems) != good, problems


def test_exports_say_it_or_refuse(spread: tuple[Assembly, Cell, RobotPlan], bent: RobotPlan, tmp_path: Path) -> None:
    _, cell, plan = spread
    with pytest.raises(InputError, match="several robots move at the same instant, which urscript cannot say"):
        export_plan(plan, tmp_path, "urscript", cell=cell)
    for form in ("rapid", "urscript"):
        assert export_plan(bent, tmp_path / form, form, cell=make_cell(payload=20.0), force=True)
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    export_plan(plan, tmp_path / "json", "ros2-json", cell=cell)
    told = json.loads((tmp_path / "json" / f"step-{joint + 1:03d}.json").read_text())["sequence"]
    assert len({entry["start"] for entry in told}) == 1
    assert {entry["robot"] for entry in told} == {"arm 1", "arm 2"}
    (goals,) = export_plan(plan, tmp_path / "goals", "ros2-goals", cell=cell)
    arms = json.loads(goals.read_text())["arms"]
    both = [[entry for entry in arm["sequence"] if "at_once_with" in entry] for arm in arms]
    assert both[0]
    for first, second in zip(*both, strict=True):
        assert (first["at_once_with"], second["at_once_with"]) == (["arm 2"], ["arm 1"])
        ends = [one["goal"]["trajectory"]["points"][-1]["time_from_start"] for one in (first, second)]
        assert ends[0] == ends[1]
    export_plan(plan, tmp_path / "csv", "csv", cell=cell)
    rows = [*csv.DictReader((tmp_path / "csv" / f"step-{joint + 1:03d}.csv").open())]
    assert {row["moving"] for row in rows} == {"arm 2 and arm 1"}
    assert all(rows[0][f"arm {k}_joint_1"] != rows[-1][f"arm {k}_joint_1"] for k in (1, 2))
    pytest.importorskip("mcap")
    assert export_plan(plan, tmp_path / "bag", "mcap", cell=cell)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_multimove_controller_keeps_arms_in_step(
    lifted: tuple[Assembly, Cell, RobotPlan], tmp_path: Path, reverse: bool
) -> None:
    """Both programs meet, make as many moves with the same identities, times and zones, and part; others are free."""
    assembly, cell, plan = lifted
    plan = plan.reverse() if reverse else plan
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    blocks, moves = [], r"MoveAbsJ \w+\\ID:=(\d+), v1000\\T:=([\d.]+), (\w+), \w+;"
    for path in export_plan(plan, tmp_path, "rapid", structure=assembly, cell=cell):
        text = path.read_text()
        Rapid(text)
        found = re.findall(r"SyncMoveOn (\w+), (\w+);\n(.*?)SyncMoveOff (\w+);", text, re.DOTALL)
        blocks.append([(on, tasks, off, re.findall(moves, body)) for on, tasks, body, off in found])
        assert len(re.findall(moves, text)) == sum(len(block[3]) for block in blocks[-1])
        assert [len(block[3]) for block in blocks[-1]] == [len(leg.times) - 1 for leg in plan.steps[joint].trajectories]
        assert all(block[3][-1][2] == "fine" for block in blocks[-1])
        assert '_tasks{2} := [["T_ROB1"],["T_ROB2"]];' in text
        assert "arms of one MultiMove controller, with the motion tasks arm_1 T_ROB1, arm_2 T_ROB2" in text
        assert bool(re.search(r"GripLoad arm_\d_load\d;\n    SyncMoveOn", text)) == reverse
    assert blocks[0] == blocks[1]
    assert len({block[0] for block in blocks[0]}) == 2


def test_fewer_arms_than_parts_at_one_instant() -> None:
    one = replace(make_cell(1, payload=20.0), placement=Placement((0.0, 0.0, 0.15), scale=0.1))
    assembly = diverging(1.0, 0.3, 0.5).replace(density=600.0)
    result = plan_robots(assembly, one, task=make_task(assembly, 1, parts_at_once=2))
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert "test cell has 1 arm, and parts that leave at the same instant, each held, need one each" in result.reason


def test_ways_are_found_again_in_files(spread: tuple[Assembly, Cell, RobotPlan]) -> None:
    assembly, cell, plan = spread
    again = robot_plan_from_dict(json.loads(json.dumps(robot_plan_to_dict(plan))))
    assert [step.robots for step in again.steps] == [step.robots for step in plan.steps]
    assert check(assembly, again, cell).good
    data = robot_plan_to_dict(plan)
    (joint,) = [k for k, step in enumerate(plan.steps) if step.partners]
    data["steps"][joint]["partners"][0]["robot"] = 7
    with pytest.raises(PlanError, match=r"steps\[\d\].robot is 7; it must be a number from 0 to 1"):
        robot_plan_from_dict(data)


def test_a_turn_is_told_from_another() -> None:
    turn = PathMove((), (0.0, 1.0, 0.0), 0.0, 0.5, (0.1, 0.0, 0.0))
    there = [turn.displacement(share) for share in np.linspace(0.0, 1.0, 30)]
    assert move_fault(np.array(there), turn, whole=True) == ""
    assert move_fault(np.array(there[:20]), turn) == ""
    assert "before its end" in move_fault(np.array(there[:20]), turn, whole=True)
    assert "turns back" in move_fault(np.array([*there, *there[::-1]]), turn)
    assert "beyond its end" in move_fault(np.array(there), replace(turn, angle=0.4))
    assert "beside it" in move_fault(np.array(there), replace(turn, point=(0.2, 0.0, 0.0)))
    assert "the tool is" in move_fault(np.array(there), PathMove((), (0.0, 0.0, 1.0), 0.1))


def test_settings_take_it_apart_in_order(cell: Cell) -> None:
    assembly = hatch()
    task = make_task(assembly, 2, moves=2, turns=True)
    plan = value(plan_robots(assembly, cell, task=task, settings=HybridSettings(Direction.DISASSEMBLY)))
    assert plan.direction is Direction.DISASSEMBLY
    assert check(assembly, plan, cell).good
