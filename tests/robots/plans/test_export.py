"""Exports: the numbers come back, and the syntax is what the readers of it want."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from falsework.errors import InputError
from falsework.interop import export
from falsework.robots.plans.export import FORMATS, export_plan
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.robot_plan_file import save_robot_plan


def test_one_function_exports_robot_plans_too(robot_plan: RobotPlan, tmp_path: Path) -> None:
    save_robot_plan(robot_plan, tmp_path / "plan.json")
    export(robot_plan, tmp_path / "one", format="csv")
    export(tmp_path / "plan.json", tmp_path / "other", format="csv")
    export_plan(robot_plan, tmp_path / "three", "csv")
    texts = [[path.read_text() for path in sorted((tmp_path / name).iterdir())] for name in ("one", "three")]
    assert texts[0] == texts[1]
    assert len(list((tmp_path / "other").iterdir())) == len(texts[0])


def load_yaml(text: str):
    return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def messages(data: dict) -> list[dict]:
    return [entry for step in data["steps"] for entry in step["sequence"] if "joint_trajectory" in entry]


@pytest.mark.parametrize("form", ["ros2-json", "ros2-yaml"])
def test_ros_messages_hold_the_knots(robot_plan: RobotPlan, tmp_path: Path, form: str) -> None:
    paths = export_plan(robot_plan, tmp_path, form)
    kind = form[5:]
    names = [f"step-{index + 1:03d}.{kind}" for index in range(len(robot_plan))]
    assert [path.name for path in paths] == [*names, f"plan.{kind}"]
    read = json.loads if kind == "json" else load_yaml
    whole = read((tmp_path / f"plan.{kind}").read_text())
    found = messages(whole)
    start = 0.0
    for entry, (_, robot, trajectory) in zip(found, robot_plan.moves(), strict=True):
        message = entry["joint_trajectory"]
        assert set(message) == {"header", "joint_names", "points"}
        assert entry["start"] == pytest.approx(start, abs=1e-6)
        assert len(message["joint_names"]) == len(robot_plan.robots[robot].joint_names)
        points = message["points"]
        np.testing.assert_allclose([point["positions"] for point in points], trajectory.positions, atol=1e-9)
        np.testing.assert_allclose([point["velocities"] for point in points], trajectory.velocities, atol=1e-9)
        times = [p["time_from_start"]["sec"] + p["time_from_start"]["nanosec"] * 1e-9 for p in points]
        np.testing.assert_allclose(times, trajectory.times, atol=1e-9)
        assert all(0 <= point["time_from_start"]["nanosec"] < 10**9 for point in points)
        start += trajectory.seconds
    assert whole["seconds"] == pytest.approx(robot_plan.seconds)
    for index, name in enumerate(names):
        assert read((tmp_path / name).read_text()) == whole["steps"][index]


def test_json_and_yaml_say_the_same(robot_plan: RobotPlan, tmp_path: Path) -> None:
    export_plan(robot_plan, tmp_path, "ros2-json")
    export_plan(robot_plan, tmp_path, "ros2-yaml")
    assert load_yaml((tmp_path / "plan.yaml").read_text()) == json.loads((tmp_path / "plan.json").read_text())


def test_grippers_open_and_close_in_turn(robot_plan: RobotPlan, tmp_path: Path) -> None:
    """Each part is gripped once and let go once, and assembly is the mirror image of disassembly."""
    orders = []
    for plan in (robot_plan, robot_plan.reverse()):
        export_plan(plan, tmp_path, "ros2-json")
        steps = json.loads((tmp_path / "plan.json").read_text())["steps"]
        orders.append([(e["gripper"], e["part"]) for step in steps for e in step["sequence"] if "gripper" in e])
    for order in orders:
        for part in {part for _, part in order}:
            assert [what for what, which in order if which == part] == ["close", "open"]
    swapped = {"open": "close", "close": "open"}
    assert orders[1] == [(swapped[what], part) for what, part in reversed(orders[0])]


def test_tables_hold_samples_of_all_robots(robot_plan: RobotPlan, tmp_path: Path) -> None:
    export_plan(robot_plan, tmp_path, "csv", rate=20.0)
    with (tmp_path / "plan.csv").open() as file:
        header, *rows = csv.reader(file)
    joints = sum(len(robot.joint_names) for robot in robot_plan.robots)
    assert len(header) == 5 + joints
    times = np.array([float(row[0]) for row in rows])
    assert (np.diff(times) >= 0).all()
    assert np.diff(times).max() <= 1 / 20 + 1e-5
    assert times[-1] == pytest.approx(robot_plan.seconds, abs=1e-5)
    last = np.array([float(value) for value in rows[-1][5:]])
    np.testing.assert_allclose(last, np.concatenate(robot_plan.keyframes[-1].configurations), atol=1e-6)
    steps = [list(csv.reader(path.open()))[1:] for path in sorted(tmp_path.glob("step-*.csv"))]
    assert [row for step in steps for row in step] == rows


def test_rapid_modules_are_whole_and_hold_the_knots(robot_plan: RobotPlan, tmp_path: Path) -> None:
    paths = export_plan(robot_plan, tmp_path, "rapid")
    assert [path.name for path in paths] == ["arm_1.mod", "arm_2.mod"]
    for robot, path in enumerate(paths):
        text = path.read_text()
        lines = [line.strip() for line in text.splitlines()]
        assert lines[0] == f"MODULE {path.stem}"
        assert lines[-1] == "ENDMODULE"
        assert text.isascii()
        for opening, closing in (("PROC ", "ENDPROC"), ("IF ", "ENDIF")):
            assert sum(line.startswith(opening) for line in lines) == lines.count(closing)
        for line in lines:
            keyword = re.match(r"(MODULE|ENDMODULE|PROC |ENDPROC|IF |ELSE|ENDIF|!)", line)
            assert keyword or line.endswith(";"), line
            assert line.count("[") == line.count("]")
            assert line.count("(") == line.count(")")
        names = re.findall(r"\b([A-Za-z]\w*)\b", re.sub(r'"[^"]*"|!.*', "", text))
        assert max(map(len, names)) <= 32
        targets = dict(re.findall(r"CONST jointtarget (\w+) := \[\[([^\]]*)\],\[9E9,9E9,9E9,9E9,9E9,9E9\]\];", text))
        used = re.findall(r"MoveAbsJ (\w+), v1000\\T:=([\d.]+), (\w+), \w+;", text)
        assert [name for name, _, _ in used] == list(targets)
        mine = [trajectory for _, which, trajectory in robot_plan.moves() if which == robot]
        knots = np.concatenate([trajectory.positions[1:] for trajectory in mine])
        degrees = np.array([[float(value) for value in text.split(",")] for text in targets.values()])
        np.testing.assert_allclose(degrees, np.degrees(knots), atol=1e-5)
        assert sum(zone == "fine" for _, _, zone in used) == len(mine)
        waits = [line for line in lines if line.startswith("WaitSyncTask")]
        assert len(waits) == len(robot_plan)
        assert text.count("SetDO") == 2


def test_what_cannot_be_exported(robot_plan: RobotPlan, tmp_path: Path) -> None:
    assert FORMATS == ("ros2-json", "ros2-yaml", "csv", "rapid", "mcap")
    with pytest.raises(InputError, match="no export format 'krl'; choose ros2-json"):
        export_plan(robot_plan, tmp_path, "krl")
    with pytest.raises(InputError, match="rate of 0 positions"):
        export_plan(robot_plan, tmp_path, "csv", rate=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write into"):
        export_plan(robot_plan, tmp_path / "file" / "folder", "csv")


def test_a_bag_can_be_read_without_falsework(robot_plan: RobotPlan, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="bags need mcap; pip install 'falsework[schedule]'")
    typesys = pytest.importorskip("rosbags.typesys", reason="bags need rosbags; pip install 'falsework[schedule]'")
    (path,) = export_plan(robot_plan, tmp_path, "mcap")
    store, begins, attached = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), [], 0
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            attached += channel.topic == "/attached_collision_object"
            if schema.name == "trajectory_msgs/msg/JointTrajectory":
                found = store.deserialize_cdr(message.data, schema.name)
                begins.append(message.log_time * 1e-9)
                assert channel.topic == f"/{found.header.frame_id}/joint_trajectory"
                assert len(found.points[0].positions) == len(found.joint_names)
    motions = [trajectory.seconds for _, _, trajectory in robot_plan.moves()]
    assert begins == pytest.approx([sum(motions[:k]) for k in range(len(motions))], abs=1e-6)
    assert attached == 2 * int((robot_plan.plan.actions >= len(robot_plan.plan.boundary)).sum())
