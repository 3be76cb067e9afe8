"""Exports: numbers survive a round trip, and the syntax is valid for its readers."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from falsework import Assembly, export
from falsework.errors import ExportWarning, InputError, PlanError
from falsework.robots import Cell, RobotPlan, export_plan
from falsework.robots.exports.commands import Grip, events_of
from falsework.robots.exports.controller import MAKERS
from falsework.robots.exports.export import FORMATS
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.robot_plan_file import save_robot_plan
from tests.robots.plans.bag_reading import corners, planning_scenes
from tests.robots.plans.program_grammar import Rapid, UrScript


def test_one_function_exports_robot_plans_too(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    save_robot_plan(robot_plan, tmp_path / "plan.json")
    export(robot_plan, tmp_path / "one", format="csv")
    export(tmp_path / "plan.json", tmp_path / "other", format="csv", cell=cell)
    with pytest.raises(PlanError, match="does not say where its cell is"):
        export(tmp_path / "plan.json", tmp_path / "unknown", format="csv")
    with pytest.raises(PlanError, match="for another cell"):
        export(tmp_path / "plan.json", tmp_path / "unknown", format="csv", cell=replace(cell, speed=0.5))
    export_plan(robot_plan, tmp_path / "three", "csv")
    texts = [[path.read_text() for path in sorted((tmp_path / name).iterdir())] for name in ("one", "three")]
    assert texts[0] == texts[1]
    assert len(list((tmp_path / "other").iterdir())) == len(texts[0])


@pytest.mark.parametrize("form", ["rapid", "urscript", "mcap"])
def test_one_function_exports_what_the_structure_adds(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, form: Any
) -> None:
    """Loads of parts in programs, and their shapes in bags, as the command does; what is missing is a warning."""
    ours = replace(cell, robots=tuple(replace(robot, maker=MAKERS.get(form)) for robot in cell.robots))
    whole = export_plan(robot_plan, tmp_path / "whole", form, structure=column, cell=ours)
    export(robot_plan, tmp_path / "one", column, format=form, cell=ours)
    for path in whole:
        assert (tmp_path / "one" / path.name).read_bytes() == path.read_bytes()
    with pytest.warns(ExportWarning, match=r"(programs have no loads|the bag has no shapes) of parts: "):
        export(robot_plan, tmp_path / "bare", format=form, cell=ours)
    bare = [(tmp_path / "bare" / path.name).read_bytes() for path in whole]
    assert all(len(less) < len(path.read_bytes()) for less, path in zip(bare, whole, strict=True))


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


def test_rapid_modules_are_whole_and_hold_the_knots(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    paths = export_plan(robot_plan, tmp_path, "rapid", cell=cell)
    assert [path.name for path in paths] == ["arm_1.mod", "arm_2.mod"]
    for robot, path in enumerate(paths):
        text = path.read_text()
        lines = [line.strip() for line in text.splitlines()]
        assert lines[0] == f"MODULE {path.stem}_arm"
        Rapid(text)
        targets = dict(re.findall(r"CONST jointtarget (\w+) := \[\[([^\]]*)\],\[9E9,9E9,9E9,9E9,9E9,9E9\]\];", text))
        used = re.findall(r"MoveAbsJ (\w+), v1000\\T:=([\d.]+), (\w+), \w+;", text)
        assert [name for name, _, _ in used] == list(targets)
        mine = [trajectory for _, which, trajectory in robot_plan.moves() if which == robot]
        knots = np.concatenate([trajectory.positions[1:] for trajectory in mine])
        degrees = np.array([[float(value) for value in text.split(",")] for text in targets.values()])
        np.testing.assert_allclose(degrees, np.degrees(knots), atol=1e-5)
        assert sum(zone == "fine" for _, _, zone in used) == len(mine)
        assert text.count("SetDO") == 2


COMMANDS = {
    "mod": r"WaitUntil GInput\(gi_(\w+)_count\)>=(\d+)|SetGO go_\w+_count, (\d+)|(fine, \w+_tool;|_gripper [TF])",
    "script": r"while not \((\w+)_count\(\) >= (\d+)\)|write_port_register\(128, (\d+)\)|(stopj\(|  gripper\([TF])",
}


def run_programs(paths: list[Path], seed: int) -> list[tuple[str, int]]:
    """Carry out programs that wait for each other's counts; their motions and grips in the order in which they begin.

    One command of a random program that need not wait is carried out at a time.
    """
    programs, counts, done = {}, {}, []
    for path in paths:
        text = path.read_text()
        start = text.index("SetGO go_" if path.suffix == ".mod" else "write_port_register(128, 1)")
        order = [text]
        if path.suffix == ".mod":  # procedures stand in the order in which they are called, after the handshake
            order = re.findall(r"  PROC \w+_step\d+\(\)\n(.*?)ENDPROC", text, re.DOTALL)
            assert re.findall(r"PROC (\w+_step\d+)\(\)", text) == re.findall(r"^    (\w+_step\d+);", text, re.MULTILINE)
        else:
            order = [text[start:]]
        programs[path.stem] = [m.groups() for part in order for m in re.finditer(COMMANDS[path.suffix[1:]], part)]
        counts[path.stem] = 3
    rng = np.random.default_rng(seed)
    begun = dict.fromkeys(programs, 0)
    while any(programs.values()):
        ready = [
            name
            for name, rest in programs.items()
            if rest and not (rest[0][0] and counts[rest[0][0]] < int(rest[0][1]))
        ]
        assert ready, "the programs wait for each other"
        name = ready[int(rng.integers(len(ready)))]
        _, _, count, event = programs[name].pop(0)
        if count:
            assert int(count) >= counts[name] or int(count) <= 3
            counts[name] = int(count) if int(count) > 3 else counts[name]
        elif event:
            done.append((name, begun[name]))
            begun[name] += 1
    return done


@pytest.mark.parametrize("form", ["rapid", "urscript"])
def test_programs_keep_the_order_of_the_states(robot_plan: RobotPlan, cell: Cell, tmp_path: Path, form: str) -> None:
    """However fast each controller is, motions that the plan has in one order come in that order."""
    for plan in (robot_plan, robot_plan.reverse()):
        paths = export_plan(plan, tmp_path / plan.direction.value, form, cell=cell, force=True)
        events = [(paths[step.robot].stem, event) for k, step in enumerate(plan.steps) for event in events_of(plan, k)]
        names, wanted = dict.fromkeys((path.stem for path in paths), 0), []
        for name, _ in events:
            wanted.append((name, names[name]))
            names[name] += 1
        for seed in range(5):
            done = run_programs(paths, seed)
            assert sorted(done) == sorted(wanted)
            moves = [entry for entry, (_, event) in zip(wanted, events, strict=True) if not isinstance(event, Grip)]
            assert [entry for entry in done if entry in set(moves)] == moves


def test_urscript_holds_the_motions(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    paths = export_plan(robot_plan, tmp_path, "urscript", rate=20.0, cell=cell, force=True)
    assert [path.name for path in paths] == ["arm_1.script", "arm_2.script"]
    for robot, path in enumerate(paths):
        text = path.read_text()
        lines = [line.strip() for line in text.splitlines()]
        assert lines[0] == f"def {path.stem}_arm():"
        UrScript(text)
        mine = [trajectory for _, which, trajectory in robot_plan.moves() if which == robot]
        ends = np.array([json.loads(found) for found in re.findall(r"movej\((\[.*?\])", text)])
        np.testing.assert_allclose(ends[1:], [trajectory.positions[-1] for trajectory in mine], atol=1e-6)


def test_what_cannot_be_exported(robot_plan: RobotPlan, tmp_path: Path) -> None:
    assert FORMATS == ("ros2-json", "ros2-yaml", "ros2-goals", "csv", "rapid", "urscript", "mcap")
    with pytest.raises(InputError, match="no export format 'krl'; choose ros2-json"):
        export_plan(robot_plan, tmp_path, "krl")
    with pytest.raises(InputError, match="rate of 0 positions"):
        export_plan(robot_plan, tmp_path, "csv", rate=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write into"):
        export_plan(robot_plan, tmp_path / "file" / "folder", "csv")


@pytest.mark.parametrize("assembles", [False, True])
def test_a_bag_has_the_shapes_of_the_parts_where_they_are(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, assembles: bool
) -> None:
    """A reader without a model of the structure sees each part where it stands, and in the gripper that carries it."""
    plan = robot_plan.reverse() if assembles else robot_plan
    (path,) = export_plan(plan, tmp_path, "mcap", structure=column, cell=cell)
    scenes, shapes = planning_scenes(path), place_parts(column, cell.placement)
    began, first = scenes[0]
    assert began == 0
    present = [shapes.names[part] for part in np.flatnonzero(plan.states[0])]
    assert [thing.id for thing in first.world.collision_objects] == present
    for thing in first.world.collision_objects:
        assert thing.header.frame_id == "world"
        assert len(thing.meshes[0].triangles) == len(shapes.meshes[shapes.names.index(thing.id)].faces)
        assert corners(thing) == pytest.approx(shapes.meshes[shapes.names.index(thing.id)].vertices)
    joints = dict(zip(first.robot_state.joint_state.name, first.robot_state.joint_state.position, strict=True))
    assert joints["arm 1_joint_1"] == plan.keyframes[0].configurations[0][0]
    taken = [scene.robot_state.attached_collision_objects[0] for _, scene in scenes[1:]]
    taken = [thing for thing in taken if thing.object.operation == 0]
    moves = [k for k in range(len(plan)) if plan.actions[k] >= len(shapes.names)]
    assert len(taken) == len(moves) > 0
    for thing, step in zip(taken, moves, strict=True):
        robot = plan.steps[step].robot
        assert thing.link_name == thing.object.header.frame_id == f"{cell.robots[robot].name}_tool0"
        grip = plan.keyframes[step + 1 if assembles else step].configurations[robot]
        flange = flange_pose(cell.robots[robot].model, grip, cell.robots[robot].base)
        placed = corners(thing.object) @ flange[:3, :3].T + flange[:3, 3]
        assert placed == pytest.approx(shapes.meshes[shapes.names.index(thing.object.id)].vertices)
    with pytest.raises(PlanError, match="another"):
        export_plan(plan, tmp_path, "mcap", structure="stack:blocks=2", cell=cell)


def test_a_bag_can_be_read_without_falsework(robot_plan: RobotPlan, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="bags need mcap; pip install 'falsework[schedule]'")
    typesys = pytest.importorskip("rosbags.typesys", reason="bags need rosbags; pip install 'falsework[schedule]'")
    (path,) = export_plan(robot_plan, tmp_path, "mcap")
    store, begins, scenes = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), [], []
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            if channel.topic == "/planning_scene":
                if not scenes:
                    store.register(typesys.get_types_from_msg(schema.data.decode(), schema.name))
                scenes.append(store.deserialize_cdr(message.data, schema.name))
            if schema.name == "trajectory_msgs/msg/JointTrajectory":
                found = store.deserialize_cdr(message.data, schema.name)
                begins.append(message.log_time * 1e-9)
                assert channel.topic == f"/{found.header.frame_id.replace(' ', '_')}/joint_trajectory"
                assert len(found.points[0].positions) == len(found.joint_names)
    motions = [trajectory.seconds for _, _, trajectory in robot_plan.moves()]
    assert begins == pytest.approx([sum(motions[:k]) for k in range(len(motions))], abs=1e-6)
    removed = [robot_plan.plan.part_names[part] for part in robot_plan.plan.inserted_parts[::-1]]
    attached = [scene.robot_state.attached_collision_objects[0].object for scene in scenes]
    assert all(scene.is_diff and scene.robot_state.is_diff for scene in scenes)
    assert [(thing.id, int(thing.operation)) for thing in attached] == [(k, o) for k in removed for o in (0, 1)]
    gone = [[thing.id for thing in scene.world.collision_objects] for scene in scenes]
    assert gone == [entry for name in removed for entry in ([], [name])]
