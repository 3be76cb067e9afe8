"""The example that carries out a plan by ROS 2: what it gives to ROS, and what it does when an arm fails."""

from __future__ import annotations

import json
import runpy
import threading
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from falsework.robots import Cell, RobotPlan, export_plan
from falsework.robots.kinematics.forward import flange_pose

FILE = Path(__file__).resolve().parents[3] / "examples" / "13_ros2_control.py"


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return runpy.run_path(str(FILE))


@pytest.fixture(scope="module")
def content(robot_plan: RobotPlan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    (path,) = export_plan(robot_plan, tmp_path_factory.mktemp("goals"), "ros2-goals", joint_prefix="{robot}_")
    return json.loads(path.read_text())


@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_the_description_has_the_arms_of_the_cell(
    example: dict[str, Any], content: dict[str, Any], cell: Cell, tmp_path: Path
) -> None:
    """Their flanges are where the cell has them, and the mock hardware begins where the plan does."""
    pytest.importorskip("yourdfpy")
    from falsework.robots import load_urdf

    starts = {arm["robot"]: arm["start"] for arm in content["arms"]}
    text = example["description"](cell, starts)
    (tmp_path / "cell.urdf").write_text(text)
    rng = np.random.default_rng(0)
    for robot, arm in zip(cell.robots, content["arms"], strict=True):
        model = load_urdf(tmp_path / "cell.urdf", base="world", tip=f"{robot.name}_link_{robot.model.joints}")
        assert list(model.joint_names) == arm["joint_names"]
        values = rng.uniform(robot.model.lower, robot.model.upper)
        last = flange_pose(robot.model, values, robot.base) @ np.linalg.inv(robot.model.flange)
        np.testing.assert_allclose(flange_pose(model, values), last, atol=1e-9)
        np.testing.assert_allclose(model.upper, robot.model.upper)
    joints = ElementTree.fromstring(text).findall("ros2_control/joint")
    given = {joint.get("name"): float(joint.findtext("state_interface/param", "nan")) for joint in joints}
    wanted = {n: v for arm in content["arms"] for n, v in zip(arm["joint_names"], arm["start"], strict=True)}
    assert given == wanted
    values = yaml.safe_load(json.dumps(example["parameters"](content, text)))
    for arm in content["arms"]:
        assert values[f"{arm['robot']}_controller"]["ros__parameters"]["joints"] == arm["joint_names"]


def test_every_step_is_done_whoever_is_late(example: dict[str, Any], content: dict[str, Any], plan_steps: set) -> None:
    sent: list[tuple[str, int]] = []

    def send(robot: str, goal: dict[str, Any]) -> None:
        sent.append((robot, len(goal["trajectory"]["points"])))

    conductor = example["Conductor"](content, send)
    conductor.run()
    goals = [(arm["robot"], entry) for arm in content["arms"] for entry in arm["sequence"] if "goal" in entry]
    assert len(sent) == len(goals)
    assert set(conductor.done) == plan_steps


@pytest.fixture
def plan_steps(robot_plan: RobotPlan) -> set:
    return {(robot_plan.robots[step.robot].name, robot_plan.does(k)) for k, step in enumerate(robot_plan.steps)}


def test_an_arm_that_fails_stops_the_other(example: dict[str, Any], content: dict[str, Any]) -> None:
    """Also one that waits for it."""
    first = content["arms"][0]["robot"]

    def send(robot: str, goal: dict[str, Any]) -> None:
        if robot == first:
            raise RuntimeError("the controller of arm 1 has refused a goal")

    conductor, before = example["Conductor"](content, send), threading.active_count()
    with pytest.raises(RuntimeError, match="has refused a goal"):
        conductor.run()
    assert threading.active_count() <= before  # no arm waits for ever
