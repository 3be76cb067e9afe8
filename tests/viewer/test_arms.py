"""Arms of a robot plan: where links and the carried part are, whatever the size and place of the structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework import Action, Assembly, Direction, Plan
from falsework.robots import Cell, RobotPlan
from falsework.robots.kinematics.forward import link_poses
from falsework.robots.model.cell import Placement
from falsework.robots.model.shapes import pose, wxyz_of
from falsework.robots.plans.robot_plan_file import save_robot_plan
from falsework.viewer import Timeline
from falsework.viewer.appearance import appearance_at, bounds_of
from falsework.viewer.arms import ArmPoses, Arms, appearance_with_arms, bounds_with_arms, solids_of_arms
from falsework.viewer.page.page_text import legend_text
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.timeline import NO_ROBOT


def to_structure(cell: Cell, points: np.ndarray) -> np.ndarray:
    """The placement undone, written out by hand."""
    turn = cell.placement.pose[:3, :3]
    return (points - cell.placement.pose[:3, 3]) @ turn / cell.placement.scale


def carried_parts(arm_poses: ArmPoses) -> list[int]:
    return [carried.part for carried in arm_poses.carried]


def test_links_are_where_forward_kinematics_puts_them(robot_plan: RobotPlan, cell: Cell) -> None:
    arms = Arms(robot_plan, cell, Direction.DISASSEMBLY)
    arm_poses = arms.at(0.0)  # the end of the disassembly
    for link, found in zip(arms.links, arm_poses.poses, strict=True):
        robot = cell.robots[link.robot]
        frames = link_poses(robot.model, robot_plan.keyframes[-1].configurations[link.robot], robot.base)
        gripper = link.frame == robot.model.joints + 1
        frame = frames[-1] @ robot.model.flange if gripper else frames[link.frame]
        pieces = robot.gripper.pieces if gripper else robot.model.pieces[link.frame]
        world = np.concatenate(pieces) @ frame[:3, :3].T + frame[:3, 3]
        seen = link.vertices @ found[:3, :3].T + found[:3, 3]
        np.testing.assert_allclose(seen, to_structure(cell, world), atol=1e-9)
        np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_link_is_a_closed_mesh_that_faces_outwards(robot_plan: RobotPlan, cell: Cell) -> None:
    for link in Arms(robot_plan, cell, Direction.DISASSEMBLY).links:
        corners = link.vertices[link.faces] - link.vertices.mean(axis=0)
        assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


@pytest.mark.parametrize("direction", list(Direction))
def test_the_part_is_seen_once(
    robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan], direction: Direction
) -> None:
    """In its place, in the gripper, or gone, never two of them; every part that moves is carried for a time."""
    assembly, plan = arch
    arms = Arms(robot_plan, cell, Direction.DISASSEMBLY).turned(direction)
    timeline = Timeline.from_plan(plan, assembly, direction, arms.holders())
    every: set[int] = set()
    for seconds in np.linspace(0.0, arms.clock.makespan, 150):
        arm_poses, place = arms.at_time(seconds), arms.clock.position(seconds)
        appearance = appearance_with_arms(appearance_at(timeline, place, travelling=False), arm_poses)
        carried = carried_parts(arm_poses)
        assert not appearance.opacity[carried].any()
        state = timeline.states[timeline.row(place)]
        seen = {*np.flatnonzero(appearance.opacity > 0).tolist(), *carried}
        assert set(np.flatnonzero(state).tolist()) <= seen
        every |= set(carried)
    assert every == {step.part for step in plan if step.action is Action.INSERT}


def test_holders_are_those_of_the_keyframes(robot_plan: RobotPlan, cell: Cell) -> None:
    for direction in Direction:
        who = Arms(robot_plan, cell, direction).holders()
        for row, frame in zip(robot_plan.rows, robot_plan.keyframes, strict=True):
            for robot, part in enumerate(frame.held):
                if part is not None:
                    assert who[row, part] == robot
            assert (who[row] != NO_ROBOT).sum() == sum(part is not None for part in frame.held)


def test_meshes_and_bounds(robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    arms = Arms(robot_plan, cell, Direction.DISASSEMBLY)
    times = np.linspace(0.0, arms.clock.makespan, 60)
    assert {len(solids_of_arms(arms, arms.at_time(time), arch[0])) - len(arms.links) for time in times} == {0, 1}
    box = bounds_with_arms(arms, bounds_of(arch[0]))
    assert (box[0] <= bounds_of(arch[0])[0]).all()
    assert (box[1] - box[0]).max() > 1.5 / cell.placement.scale  # the arms stand 1.8 m apart
    assert arms.clock.makespan == pytest.approx(robot_plan.seconds)


def test_contact_sheets_have_the_arms(robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    """As many pictures as those of single steps, of the same poses."""
    pytest.importorskip("PIL", reason="pictures need Pillow; pip install 'falsework[picture]'")
    from falsework.viewer.pictures.contact_sheet import CELL, contact_sheet, draw

    arms = Arms(robot_plan, cell, Direction.ASSEMBLY)
    timeline = Timeline.from_plan(robot_plan.plan, arch[0], who=arms.holders())
    box = bounds_with_arms(arms, bounds_of(arch[0]))
    for place in (0, len(timeline)):
        extra = solids_of_arms(arms, arms.at(place), arch[0])
        look = appearance_with_arms(appearance_at(timeline, place, travelling=False), arms.at(place))
        alone = draw(arch[0], look, CELL, bounds=box, extra=extra)
        there = (alone < 0.6).any(axis=2)
        sheet = contact_sheet(timeline, [place], arms=arms)[26:326]
        plain = contact_sheet(timeline, [place])[26:326]
        np.testing.assert_array_equal(sheet[there], np.rint(np.clip(alone, 0, 1) * 255).astype(np.uint8)[there])
        assert (sheet != plain).any()


def test_a_new_plan_has_no_arms_until_one_goes_back(
    robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]
) -> None:
    assembly, plan = arch
    arms = Arms(robot_plan, cell, Direction.ASSEMBLY)
    model = ViewerState(Timeline.from_plan(plan, assembly, Direction.ASSEMBLY, arms.holders()), plan=plan, arms=arms)
    model.turn(Direction.DISASSEMBLY)
    assert model.arms is not None
    assert model.arms.direction is Direction.DISASSEMBLY
    model.go_to(0.5)
    assert model.arm_poses() is not None
    model.go_to(0)
    assert model.replan().plan is not None
    assert model.arms is None
    assert model.arm_poses() is None
    model.go_back()
    assert model.arms is not None


def test_from_a_file(
    robot_plan: RobotPlan, cell: Cell, tmp_path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from falsework.cli.main import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("falsework.robots.cells.cell_file.load_cell", lambda name: cell)
    save_robot_plan(
        replace(robot_plan, plan=replace(robot_plan.plan, source={"built_in": "arch:blocks=5"})), "robot_plan.json"
    )
    assert main(["picture", "robot_plan.json", "--step", "2", "--width", "160"]) == 2
    assert "--cell" in capsys.readouterr().err
    pytest.importorskip("PIL", reason="pictures need Pillow")
    words = ["robot_plan.json", "--cell", "mine.toml"]
    assert main(["picture", *words, "--step", "2", "--width", "160"]) == 0
    assert main(["picture", *words, "--width", "80", "--rate", "2", "--step-seconds", "0.5", "--out", "plan.gif"]) == 0


def test_quaternions() -> None:
    np.testing.assert_allclose(wxyz_of(np.eye(3)), (1, 0, 0, 0))
    np.testing.assert_allclose(wxyz_of(pose(yaw=np.pi / 2)[:3, :3]), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)), atol=1e-12)


def test_the_page_says_where_the_cell_builds_another_size(
    robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]
) -> None:
    def legend(placement: Placement) -> str:
        arms = Arms(robot_plan, replace(cell, placement=placement), Direction.ASSEMBLY)
        model = ViewerState(Timeline.from_plan(robot_plan.plan, arch[0]), plan=robot_plan.plan, arms=arms)
        assert "as modelled" not in legend_text(model, {})  # no force or mass is shown
        model.selected = 0
        return legend_text(model, {})

    assert "as modelled" not in legend(Placement())
    text = legend(Placement(scale=0.1, density=700.0))
    assert "the cell builds it at 0.1 of its size with 700 kg/m3." in text
