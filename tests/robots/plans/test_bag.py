"""Laws of bags: what a reader plays is the plan, arms do not jump, and a part is in one gripper at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falsework import Assembly
from falsework.robots import Cell, RobotPlan
from falsework.robots.exports.bag_view import PlacedParts
from falsework.robots.exports.mcap_bag import write_bag
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.part_shapes import place_parts
from tests.robots.plans.bag_reading import messages

NANO = 1_000_000_000


def moment(stamp: Any) -> int:
    """Nanoseconds of a time or a duration."""
    return stamp.sec * NANO + stamp.nanosec


@pytest.fixture(params=[False, True], ids=["disassembly", "assembly"])
def plan(request: pytest.FixtureRequest, robot_plan: RobotPlan) -> RobotPlan:
    return robot_plan.reverse() if request.param else robot_plan


@pytest.fixture
def bag(plan: RobotPlan, tmp_path: Path) -> Path:
    path = tmp_path / "plan.mcap"
    assert write_bag(plan, path) == len(messages(path))
    return path


def test_the_motions_are_those_of_the_plan_knot_by_knot(plan: RobotPlan, bag: Path) -> None:
    """Each as a trajectory and as MoveIt's, one after another without a pause, since the plan has no schedule."""
    names, moves = [robot.name for robot in plan.robots], list(plan.moves())
    topics = [name.replace(" ", "_") for name in names]
    for suffix in ("joint_trajectory", "robot_trajectory"):
        played = messages(bag, *(f"/{name}/{suffix}" for name in topics))
        assert [topic for topic, _, _ in played] == [f"/{topics[robot]}/{suffix}" for _, robot, _ in moves]
        now = 0.0
        for (_, time, message), (_, robot, trajectory) in zip(played, moves, strict=True):
            shown = getattr(message, "joint_trajectory", message)
            assert time == moment(shown.header.stamp) == pytest.approx(now * NANO, abs=1)
            assert shown.joint_names == [f"{names[robot]}_{joint}" for joint in plan.robots[robot].joint_names]
            assert [moment(point.time_from_start) for point in shown.points] == [
                round(seconds * NANO) for seconds in trajectory.times
            ]
            for key in ("positions", "velocities"):
                shown_rows = [getattr(point, key) for point in shown.points]
                np.testing.assert_allclose(shown_rows, getattr(trajectory, key), rtol=0, atol=1e-12)
            now += trajectory.seconds


def test_an_arm_goes_on_where_it_was(plan: RobotPlan, bag: Path) -> None:
    """From rest to rest."""
    last = {robot.name: plan.keyframes[0].configurations[k] for k, robot in enumerate(plan.robots)}
    played = messages(bag, *(f"/{name.replace(' ', '_')}/joint_trajectory" for name in last))
    assert played
    for _, _, message in played:
        name = message.header.frame_id
        assert message.points[0].positions == pytest.approx(last[name], abs=1e-9)
        assert np.abs([message.points[k].velocities for k in (0, -1)]).max() < 1e-9
        last[name] = message.points[-1].positions
    for k, robot in enumerate(plan.robots):
        assert last[robot.name] == pytest.approx(plan.keyframes[-1].configurations[k], abs=1e-9)


def test_a_part_is_taken_before_it_is_put_down_and_only_by_one_arm(plan: RobotPlan, bag: Path) -> None:
    """At times at which a motion begins or ends."""
    motions = [
        (time, time + moment(message.points[-1].time_from_start))
        for topic, time, message in messages(bag)
        if topic.endswith("/joint_trajectory")
    ]
    held: dict[str, str] = {}
    for _, time, scene in messages(bag, "/planning_scene"):
        (attached,) = scene.robot_state.attached_collision_objects
        name = attached.object.id
        assert scene.is_diff
        assert attached.object.operation in (0, 1)
        if attached.object.operation == 0:
            assert name not in held
            assert attached.link_name not in held.values()
            assert any(abs(time - begin) <= 1 for begin, _ in motions)
            held[name] = attached.link_name
        else:
            assert held.pop(name) == attached.link_name
            assert any(abs(time - end) <= 2 for _, end in motions)
    assert held == {}


def test_the_same_plan_makes_the_same_bag(plan: RobotPlan, bag: Path, tmp_path: Path) -> None:
    write_bag(plan, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == bag.read_bytes()


def test_viewers_of_a_bag_see_arms_and_parts_where_they_are(
    plan: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path
) -> None:
    """In types that RViz and Foxglove draw: each marker in a frame that is known, at the end each part at its place."""
    path, shapes = tmp_path / "view.mcap", place_parts(column, cell.placement)
    write_bag(plan, path, PlacedParts(shapes, cell))
    kinds = {topic: found.__msgtype__ for topic, _, found in messages(path)}
    assert kinds["/joint_states"] == "sensor_msgs/msg/JointState"
    assert kinds["/tf"] == "tf2_msgs/msg/TFMessage"
    assert kinds["/markers"] == "visualization_msgs/msg/MarkerArray"
    frames: dict[str, np.ndarray] = {}
    markers: dict[tuple[str, int], Any] = {}
    highest = dict.fromkeys(shapes.names, -np.inf)

    def corners_of(name: str) -> np.ndarray:
        points = np.array([(p.x, p.y, p.z) for p in markers[f"part_{name}", 0].points])
        return points @ frames[f"part_{name}"][:3, :3].T + frames[f"part_{name}"][:3, 3]

    for topic, _, found in messages(path, "/tf", "/markers"):
        for sent in getattr(found, "transforms", ()):
            assert sent.header.frame_id == "world"
            pose, turn, at = np.eye(4), sent.transform.rotation, sent.transform.translation
            pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
            pose[:3, 3] = at.x, at.y, at.z
            frames[sent.child_frame_id] = pose
        for sent in getattr(found, "markers", ()):
            assert sent.header.frame_id in frames
            assert sent.frame_locked
            if sent.action == 2:
                del markers[sent.ns, sent.id]
            else:
                assert len(sent.points) % 3 == 0
                markers[sent.ns, sent.id] = sent
        for name in shapes.names if topic == "/tf" else ():
            if (f"part_{name}", 0) in markers:
                highest[name] = max(highest[name], corners_of(name)[:, 2].max())
    there = {shapes.names[part] for part in np.flatnonzero(plan.states[-1])}
    assert {space.removeprefix("part_") for space, _ in markers if space.startswith("part_")} == there
    for name in there:
        assert corners_of(name) == pytest.approx(shapes.meshes[shapes.names.index(name)].triangles.reshape(-1, 3))
    moved = [
        name for name, high in highest.items() if high > shapes.meshes[shapes.names.index(name)].bounds[1, 2] + 0.05
    ]
    assert moved, "no part was lifted"
    for robot, entry in enumerate(cell.robots):
        end = flange_pose(entry.model, plan.keyframes[-1].configurations[robot], entry.base)
        assert frames[f"{entry.name}_tool0"] == pytest.approx(end)
        assert any(space.startswith(f"{entry.name}_") for space, _ in markers)
