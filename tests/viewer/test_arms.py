"""Arms of a robot plan: where links and the carried part are, whatever the size and place of the structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework import Action, Assembly, Direction, Plan
from falsework.robots import Cell, RobotPlan
from falsework.robots.kinematics.forward import link_poses, tool_pose
from falsework.robots.model.shapes import pose
from falsework.robots.plans.robot_plan_file import save_robot_plan
from falsework.viewer import Timeline
from falsework.viewer.appearance import appearance_at, bounds_of
from falsework.viewer.arms import ArmPoses, Arms, appearance_with_arms, bounds_with_arms, solids_of_arms, wxyz_of
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
    arm_poses = arms.at(len(robot_plan) - 3.0)
    for link, found in zip(arms.links, arm_poses.poses, strict=True):
        robot = cell.robots[link.robot]
        frames = link_poses(robot.model, robot_plan.keyframes[3].configurations[link.robot], robot.base)
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
def test_a_carried_part_goes_with_the_gripper(
    robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan], direction: Direction
) -> None:
    """A point of the part keeps its place in the tool frame, and is in its place where the ride begins or ends."""
    arms = Arms(robot_plan, cell, Direction.DISASSEMBLY).turned(direction)
    plan = robot_plan if direction is Direction.DISASSEMBLY else robot_plan.reverse()
    parts = len(plan.plan.boundary)

    def poses(done: float) -> ArmPoses:
        """Return the poses after so many actions have been executed."""
        return arms.at(done if direction is Direction.ASSEMBLY else len(plan) - done)

    for index, action in enumerate(plan.actions.tolist()):
        if action < parts:
            assert not any(poses(index + share).carried for share in (0.2, 0.8))
            continue
        part, step = action % parts, plan.steps[index]
        robot = cell.robots[step.robot]
        point = arch[0].mass.center[part]
        in_tool = []
        shares = (0.1, 0.25, 0.4, 0.6, 0.75, 0.9)
        carrying = [share for share in shares if carried_parts(poses(index + share)) == [part]]
        assert len(carrying) == 3
        for share in carrying:
            (carried,) = poses(index + share).carried
            assert carried.robot == step.robot
            seen = carried.pose[:3, :3] @ point + carried.pose[:3, 3]
            world = cell.placement.pose[:3, :3] @ (seen * cell.placement.scale) + cell.placement.pose[:3, 3]
            number, left = int(share >= 0.5), (share % 0.5) * step.seconds
            values = step.trajectories[number].sample(np.array([left]))[0]
            in_tool.append(np.linalg.inv(tool_pose(robot, values)) @ [*world, 1.0])
        np.testing.assert_allclose(in_tool, np.broadcast_to(in_tool[0], (3, 4)), atol=1e-9)
        edge = index + 1e-9 if direction is Direction.DISASSEMBLY else index + 1 - 1e-9
        np.testing.assert_allclose(poses(edge).carried[0].pose, np.eye(4), atol=1e-6)


def test_the_part_is_seen_once(robot_plan: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    """In its place, in the gripper, or gone, never two of them."""
    assembly, plan = arch
    arms = Arms(robot_plan, cell, Direction.DISASSEMBLY)
    timeline = Timeline.from_plan(plan, assembly, Direction.DISASSEMBLY, arms.holders())
    last = max((step for step in plan if step.action is Action.INSERT), key=lambda step: step.number)
    place, part = last.number - 1, last.part
    for share, there, carried in ((1.0, True, False), (0.7, False, True), (0.3, False, False), (0.0, False, False)):
        arm_poses = arms.at(place + share)
        appearance = appearance_with_arms(appearance_at(timeline, place + share, travelling=False), arm_poses)
        assert bool(appearance.opacity[part] > 0) is there, share
        assert carried_parts(arm_poses) == [part] * carried, share
    backwards, turned = timeline.turned(Direction.ASSEMBLY), arms.turned(Direction.ASSEMBLY)
    for share, there, carried in ((0.0, False, False), (0.3, False, False), (0.7, False, True), (1.0, True, False)):
        arm_poses = turned.at(place + share)
        appearance = appearance_with_arms(appearance_at(backwards, place + share, travelling=False), arm_poses)
        assert bool(appearance.opacity[part] > 0) is there, share
        assert carried_parts(arm_poses) == [part] * carried, share


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
    insert = int(np.flatnonzero(robot_plan.plan.actions >= len(robot_plan.plan.boundary))[-1])
    assert len(solids_of_arms(arms, arms.at(insert + 1), arch[0])) == len(arms.links)
    assert len(solids_of_arms(arms, arms.at(insert + 0.8), arch[0])) == len(arms.links) + 1
    box = bounds_with_arms(arms, bounds_of(arch[0]))
    assert (box[0] <= bounds_of(arch[0])[0]).all()
    assert (box[1] - box[0]).max() > 1.5 / cell.placement.scale  # the arms stand 1.8 m apart
    assert arms.seconds(0) == pytest.approx(4.0)


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
    assert model.replan().found
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
