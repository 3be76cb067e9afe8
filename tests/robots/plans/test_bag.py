"""Laws of bags: what a reader plays is the plan, arms do not jump, and a part is in one gripper at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework.robots import RobotPlan
from falsework.robots.exports.mcap_bag import write_bag
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
