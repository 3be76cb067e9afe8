"""Facts that exports take from the cell: makers, loads of tools, signals; losses that they name; goals of ROS 2."""

from __future__ import annotations

import csv
import itertools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falsework import Assembly
from falsework.cli.main import main
from falsework.errors import InputError, PlanError
from falsework.robots import Cell, CellRobot, Gripper, RobotPlan, Signals, export_plan
from falsework.robots.exports.commands import Grip, events_of
from falsework.robots.exports.export import export_notes
from falsework.robots.exports.payloads import ToolLoad, part_loads, rapid_load, together, tool_load, ur_payload
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.cell import maker_of
from falsework.robots.model.shapes import block
from falsework.robots.plans.robot_plan_file import save_robot_plan
from tests.robots.plans.program_grammar import Rapid


def renamed(cell: Cell, name: str, **changes: Any) -> Cell:
    """The cell with arms of another description."""
    robots = (
        replace(robot, model=replace(robot.model, name=name, source="arm.urdf"), **changes) for robot in cell.robots
    )
    return replace(cell, robots=tuple(robots))


def planned_for(plan: RobotPlan, cell: Cell) -> RobotPlan:
    """The plan as if it were for another cell."""
    from falsework.robots.model.cell import cell_identity
    from falsework.robots.plans.robot_plan import records_of

    return replace(plan, robots=records_of(cell), cell_identity=cell_identity(cell))


@pytest.mark.parametrize(
    ("name", "maker"),
    [
        ("abb_irb2600_12_165", "ABB"),
        ("irb1200-7/0.7", "ABB"),
        ("crb15000", "ABB"),
        ("ABB GoFa", "ABB"),
        ("ur5e", "Universal Robots"),
        ("ur5e_robot", "Universal Robots"),
        ("ur", "Universal Robots"),
        ("UR10", "Universal Robots"),
        ("panda", None),
        ("urban_arm", None),
        ("iiwa14", None),
        ("crane", None),
        ("abba", None),
    ],
)
def test_makers_by_the_name_of_a_description(cell: Cell, name: str, maker: str | None) -> None:
    """A name that only begins alike says nothing; what the cell states counts more."""
    robot = renamed(cell, name).robots[0]
    assert maker_of(robot) == (maker, maker is not None)
    assert maker_of(replace(robot, maker="Franka")) == ("Franka", False)


@pytest.mark.parametrize("form", ["rapid", "urscript"])
def test_programs_are_for_arms_of_their_maker(robot_plan: RobotPlan, cell: Cell, tmp_path: Path, form: str) -> None:
    wanted = {"rapid": "ABB", "urscript": "Universal Robots"}[form]
    other = {"rapid": "ur5e", "urscript": "irb2600"}[form]
    for name, changes, message in (
        (
            "panda",
            {},
            rf"{form} programs are for arms of {wanted}, and the maker of robot arm 1, panda, is unknown; if it is "
            rf'one, write maker = "{wanted}"',
        ),
        (
            "panda",
            {"maker": "Franka"},
            rf"{form} programs are for arms of {wanted}, and robot arm 1 \(panda\) is of Franka",
        ),
        (other, {}, rf"robot arm 1 \({other}\) is of .*; choose another format"),
    ):
        given = renamed(cell, name, **changes)
        plan = planned_for(robot_plan, given)
        with pytest.raises(InputError, match=message):
            export_plan(plan, tmp_path / "no", form, cell=given)
        assert not (tmp_path / "no").exists()
        assert export_plan(plan, tmp_path / "forced", form, cell=given, force=True)
    stated = renamed(cell, "panda", maker=wanted.lower())
    assert export_plan(planned_for(robot_plan, stated), tmp_path / "stated", form, cell=stated)
    with pytest.raises(PlanError, match=rf"{form} programs have the loads and signals of a cell; give the cell"):
        export_plan(robot_plan, tmp_path / "no", form, force=True)


def test_loads_of_tools_are_those_of_the_cell(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    """Principal moments and axes of RAPID make up the inertia of the cell; URScript has it as it is."""
    turn = Rotation.from_rotvec([0.3, -0.4, 0.9]).as_matrix()
    inertia = turn @ np.diag([0.02, 0.03, 0.04]) @ turn.T
    gripper = replace(cell.robots[0].gripper, mass=1.25, center_of_mass=np.array([0.01, -0.02, 0.06]), inertia=inertia)
    given = replace(cell, robots=tuple(replace(robot, gripper=gripper) for robot in cell.robots))
    plan = planned_for(robot_plan, given)
    text = export_plan(plan, tmp_path / "rapid", "rapid", cell=given)[0].read_text()
    found = re.search(r"tooldata arm_1_tool := \[TRUE,\[.*\]\],\[([\d.]+),\[(.*?)\],\[(.*?)\],(.*)\]\];", text)
    assert found is not None
    mass, center, (w, x, y, z), moments = ([float(value) for value in group.split(",")] for group in found.groups())
    assert mass == [1.25]
    assert center == [10.0, -20.0, 60.0]
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, inertia, atol=1e-6)
    text = export_plan(plan, tmp_path / "ur", "urscript", cell=given, force=True)[0].read_text()
    payload = re.search(r"  set_target_payload\(1\.2500, \[(.*?)\], \[(.*?)\]\)", text)
    assert payload is not None
    assert [float(value) for value in payload[1].split(",")] == [0.01, -0.02, 0.06]
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    np.testing.assert_allclose([float(value) for value in payload[2].split(",")], inertia[rows, columns], rtol=1e-4)


@pytest.mark.parametrize("assembles", [False, True])
def test_loads_of_parts_are_set_while_they_are_carried(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, assembles: bool
) -> None:
    """Masses in the cell; centres at the places of the parts, seen from the flange; none before and after."""
    given = replace(cell, placement=replace(cell.placement, density=500.0))
    plan = planned_for(robot_plan.reverse() if assembles else robot_plan, given)
    loads = part_loads(plan, column, given)
    carrying = {
        (k, step.robot, m)
        for k, step in enumerate(plan.steps)
        for m, leg in enumerate(step.trajectories)
        if leg.part is not None
    }
    assert set(loads) == carrying
    for (step, _, _), load in loads.items():
        entry, part = plan.steps[step], int(plan.actions[step]) % len(plan.plan.boundary)
        grip = plan.keyframes[step + assembles].configurations[entry.robot]
        robot = given.robots[entry.robot]
        assert load.mass == pytest.approx(2 * column.mass.mass[part])
        flange = flange_pose(robot.model, grip, robot.base)
        np.testing.assert_allclose(flange[:3, :3] @ load.center + flange[:3, 3], column.mass.center[part], atol=1e-9)
        world = flange[:3, :3] @ load.inertia @ flange[:3, :3].T
        np.testing.assert_allclose(world, 2 * column.mass.inertia[part], atol=1e-9)
    for path in export_plan(plan, tmp_path / "rapid", "rapid", cell=given, structure=column):
        text = path.read_text()
        set_ones = re.findall(r"GripLoad (\w+);", text)
        declared = re.findall(r"PERS loaddata (\w+) := \[([\d.]+),", text)
        assert [name for name in set_ones if name != "load0"] == [name for name, _ in declared]
        assert all(float(mass) == pytest.approx(2 * column.mass.mass[0], abs=1e-4) for _, mass in declared)
    for path in export_plan(plan, tmp_path / "ur", "urscript", cell=given, structure=column, force=True):
        masses = [float(mass) for mass in re.findall(r"set_target_payload\(([\d.]+),", path.read_text())]
        assert masses[0] == 1.0
        assert set(masses[1:]) <= {1.0, round(1.0 + 2 * float(column.mass.mass[0]), 4)}
        assert all(a != b for a, b in itertools.pairwise(masses))
    assert "GripLoad" not in export_plan(plan, tmp_path / "none", "rapid", cell=given)[0].read_text()
    with pytest.raises(PlanError, match="another"):
        export_plan(plan, tmp_path / "other", "rapid", cell=given, structure="stack:blocks=2")


def test_two_loads_are_one() -> None:
    """Two point masses on an axis: their inertia is that of a dumbbell."""
    first = ToolLoad(1.0, np.array([0.0, 0.0, 0.1]), np.zeros((3, 3)))
    second = ToolLoad(3.0, np.array([0.0, 0.0, 0.5]), np.zeros((3, 3)))
    both = together(first, second)
    assert both.mass == 4.0
    np.testing.assert_allclose(both.center, [0, 0, 0.4])
    np.testing.assert_allclose(both.inertia, np.diag([0.12, 0.12, 0.0]), atol=1e-12)


def test_a_load_that_the_cell_lacks(cell: Cell) -> None:
    """The shapes, of one density, give the centre; RAPID accepts no tool without mass; both are said."""
    pieces = (block((0, 0, 0), (0.1, 0.1, 0.1)), block((0, 0, 0.1), (0.1, 0.1, 0.4)))
    load = tool_load(Gripper("g", "suction", pieces, np.eye(4), 1.0))
    np.testing.assert_allclose(load.center, [0.05, 0.05, 0.2], atol=1e-9)
    assert rapid_load(load).startswith("[0.0010,[50.000,50.000,200.000],[1,0,0,0],0,0,0]")
    assert ur_payload(load) == "set_target_payload(0.0000, [0.050000, 0.050000, 0.200000], [0, 0, 0, 0, 0, 0])"


def with_seventh(plan: RobotPlan, cell: Cell, place: int, names: list[str], *, slides: bool) -> tuple[RobotPlan, Cell]:
    """The plan and the cell with one more joint in each arm, at a place of its chain, that stays at 0.5."""

    def more(values: np.ndarray, value: float) -> np.ndarray:
        return np.insert(values, place, value, axis=-1)

    def wider(robot: CellRobot) -> CellRobot:
        model, home = robot.model, more(robot.home, 0.5)
        limits: dict[str, Any] = {
            name: more(getattr(model, name), 1.0) for name in ("upper", "velocity", "acceleration")
        }
        chain: dict[str, Any] = {
            name: np.insert(getattr(model, name), place, getattr(model, name)[0], 0) for name in ("origins", "axes")
        }
        links: dict[str, Any] = {
            name: (*getattr(model, name), getattr(model, name)[-1]) for name in ("link_names", "pieces")
        }
        prismatic = np.insert(model.prismatic, place, slides)
        shape: dict[str, Any] = {
            "joint_names": tuple(names),
            "prismatic": prismatic,
            "lower": more(model.lower, -1.0),
            "home": home,
        }
        return replace(robot, model=replace(model, **limits, **chain, **links, **shape), home=home)

    cell = replace(cell, robots=tuple(map(wider, cell.robots)))
    frames = [
        replace(frame, configurations=tuple(more(values, 0.5) for values in frame.configurations))
        for frame in plan.keyframes
    ]
    steps = [
        replace(
            step,
            trajectories=tuple(
                replace(leg, positions=more(leg.positions, 0.5), velocities=more(leg.velocities, 0.0))
                for leg in step.trajectories
            ),
        )
        for step in plan.steps
    ]
    return planned_for(replace(plan, keyframes=tuple(frames), steps=tuple(steps)), cell), cell


@pytest.mark.parametrize(
    ("place", "names", "slides", "external"),
    [
        (0, ["rail", *(f"joint_{k}" for k in range(1, 7))], True, "500.00000"),
        (2, [f"yumi_joint_{k}_l" for k in (1, 2, 7, 3, 4, 5, 6)], False, f"{np.degrees(0.5):.5f}"),
    ],
    ids=["track", "seventh axis"],
)
def test_rapid_has_tracks_and_seventh_axes_apart(
    robot_plan: RobotPlan, cell: Cell, tmp_path: Path, place: int, names: list[str], slides: bool, external: str
) -> None:
    """A track in mm, whatever its place in the chain; the axes of the arm are those of the plan without it."""
    plan, wide = with_seventh(robot_plan, cell, place, names, slides=slides)
    for robot, path in enumerate(export_plan(plan, tmp_path, "rapid", cell=wide, force=True)):
        text = path.read_text()
        Rapid(text)
        assert f"  ! joint {names[place]} is external axis a" in text
        targets = re.findall(r"CONST jointtarget \w+ := \[\[([^\]]*)\],\[([^,]*),9E9", text)
        knots = [knot for _, arm, leg in robot_plan.moves() if arm == robot for knot in leg.positions[1:]]
        assert {seventh for _, seventh in targets} == {external}
        shown = np.array([[float(value) for value in six.split(",")] for six, _ in targets])
        np.testing.assert_allclose(shown, np.degrees(knots), atol=1e-4)


@pytest.mark.parametrize(
    ("form", "names", "slides", "message"),
    [
        ("rapid", list("abcdefg"), False, "its joints do not tell which one that is: a, b, c, d, e, f, g; give them"),
        ("urscript", list("abcdefg"), True, "urscript programs are for arms of six turning joints; arm 1 has 7 joints"),
    ],
)
def test_axes_that_a_language_cannot_move(
    robot_plan: RobotPlan, cell: Cell, tmp_path: Path, form: str, names: list[str], slides: bool, message: str
) -> None:
    plan, wide = with_seventh(robot_plan, cell, 0, names, slides=slides)
    with pytest.raises(InputError, match=message) as caught:
        export_plan(plan, tmp_path / "no", form, cell=wide, force=True)
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "no").glob("*"))


def test_signals_of_grippers_are_settings(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    def set_up(signals: Signals) -> Cell:
        first, second = cell.robots
        return replace(cell, robots=(replace(first, signals=signals), second))

    given = set_up(Signals(grip="do_vacuum", closed=False, seconds=1.25))
    texts = [path.read_text() for path in export_plan(robot_plan, tmp_path / "rapid", "rapid", cell=given)]
    closing = re.search(r"IF closed THEN\n\s+SetDO (\w+), (\d);\n\s+ELSE\n\s+SetDO (\w+), (\d);", texts[0])
    assert closing is not None
    assert closing.groups() == ("do_vacuum", "0", "do_vacuum", "1")
    assert "WaitTime\\InPos, 1.25;" in texts[0]
    assert "  ! digital output do_vacuum at 0 closes the gripper" in texts[0]
    assert "  ! group input gi_arm_2_count, 16 bits, is connected to go_arm_2_count" in texts[0]
    noted = export_notes(robot_plan, "rapid", given)
    assert noted[-2].startswith(
        "set up the controller of arm 1: digital output do_vacuum at 0 closes the gripper; group"
    )
    assert "SetDO do_arm_2_grip, 1;" in texts[1]
    given = set_up(Signals(grip="tool 1", closed=False, address="10.0.0.7"))
    texts = [p.read_text() for p in export_plan(robot_plan, tmp_path / "ur", "urscript", cell=given, force=True)]
    assert "set_tool_digital_out(1, not closed)" in texts[0]
    assert "set_standard_digital_out(0, closed)" in texts[1]
    assert 'modbus_add_signal("10.0.0.7", 255' in texts[1]
    assert 'modbus_add_signal("arm_2.local", 255' in texts[0]
    assert "  # its register 128 is read at 10.0.0.7 by the others" in texts[0]
    for form, grip, message in (
        ("rapid", "tool 0", r"signals\.grip of robot arm 1 is 'tool 0'; for rapid give the name of a digital output"),
        ("urscript", "do_vacuum", r"signals\.grip of robot arm 1 is 'do_vacuum'; for urscript give standard, config"),
        ("urscript", "tool 9", r"is 'tool 9'; for urscript"),
    ):
        with pytest.raises(InputError, match=message):
            export_plan(robot_plan, tmp_path / "no", form, cell=set_up(Signals(grip=grip)), force=True)
        assert not list((tmp_path / "no").glob("*"))


@pytest.mark.parametrize("form", ["rapid", "urscript"])
def test_programs_say_how_an_arm_is_mounted(robot_plan: RobotPlan, cell: Cell, form: str) -> None:
    """Loads and forces of a controller rest on it; upright is what controllers take without being told."""
    first, second = cell.robots
    base = first.base.copy()
    base[:3, :3] = base[:3, :3] @ Rotation.from_euler("y", 30, degrees=True).as_matrix()
    tilted = replace(cell, robots=(replace(first, base=base), second))
    notes = [note for note in export_notes(robot_plan, form, tilted) if note.startswith("set up the controller")]
    told = ["it is mounted 30 degrees off upright, as the cell has its base" in note for note in notes]
    assert told == [True, False]


@pytest.fixture(scope="module")
def timed(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> RobotPlan:
    """The plan with a schedule."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    from falsework.robots import schedule_plan

    return schedule_plan(robot_plan, column, cell)


@pytest.mark.parametrize("form", ["csv", "ros2-json", "ros2-yaml", "ros2-goals", "rapid", "urscript", "mcap"])
def test_formats_without_a_schedule_say_so(
    robot_plan: RobotPlan, timed: RobotPlan, cell: Cell, tmp_path: Path, form: str
) -> None:
    """In the notes, and in the file; a plan without a schedule loses nothing."""
    lost = f"{form} has one motion after the other, {timed.seconds:.1f} s; the schedule of the plan takes"
    loses = form in ("csv", "ros2-json", "ros2-yaml")
    assert any(lost in note for note in export_notes(timed, form, cell)) is loses
    assert not any("schedule" in note for note in export_notes(robot_plan, form, cell))
    if loses:
        paths = export_plan(timed, tmp_path / "timed", form, cell=cell)
        plain = export_plan(robot_plan, tmp_path / "plain", form, cell=cell)
        if form == "csv":
            first = [next(csv.reader(path.open()))[0] for path in (paths[-1], plain[-1])]
            assert first == ["time_without_schedule", "time"]
        else:
            assert lost in paths[-1].read_text()
            assert "schedule" not in plain[-1].read_text()


def run_goals(content: dict[str, Any], seed: int) -> list[tuple[str, str]]:
    """Carry out goals, one at a time of a random arm that need not wait; what each did, in the order of its end."""
    rest = {arm["robot"]: list(arm["sequence"]) for arm in content["arms"]}
    counts = dict.fromkeys(rest, content["count_from"])
    done, rng = [], np.random.default_rng(seed)
    while any(rest.values()):
        ready = [
            name
            for name, own in rest.items()
            if own and not ("wait_for" in own[0] and counts[own[0]["wait_for"]] < own[0]["count"])
        ]
        assert ready, "the arms wait for each other"
        name = ready[int(rng.integers(len(ready)))]
        entry = rest[name].pop(0)
        if "count" in entry and "wait_for" not in entry:
            counts[name] = entry["count"]
        elif "goal" in entry or "gripper" in entry:
            done.append((name, json.dumps(entry)))
    return done


@pytest.mark.parametrize("assembles", [False, True])
def test_goals_of_ros2_keep_the_order(timed: RobotPlan, tmp_path: Path, assembles: bool) -> None:
    """Whatever the delays: motions that the sequential plan has are all there, each arm's in order, states in order."""
    plan = timed.reverse() if assembles else timed
    (path,) = export_plan(plan, tmp_path, "ros2-goals")
    content = json.loads(path.read_text())
    assert (content["format"], content["direction"]) == ("falsework.ros2-goals/1", plan.direction.value)
    goals = [entry["goal"] for arm in content["arms"] for entry in arm["sequence"] if "goal" in entry]
    assert all(set(goal) == {"trajectory", "path_tolerance", "goal_tolerance", "goal_time_tolerance"} for goal in goals)
    for robot, arm in enumerate(content["arms"]):
        mine = [event for k, step in enumerate(plan.steps) if step.robot == robot for event in events_of(plan, k)]
        kinds = ["gripper" if isinstance(event, Grip) else "goal" for event in mine]
        entries = [entry for entry in arm["sequence"] if "goal" in entry or "gripper" in entry]
        assert [next(iter(entry)) for entry in entries] == kinds
        assert arm["joint_names"] == list(plan.robots[robot].joint_names)
        at = np.array(arm["start"])
        for entry in entries:
            if "goal" in entry:
                points = entry["goal"]["trajectory"]["points"]
                np.testing.assert_allclose(points[0]["positions"], at, atol=1e-6)
                at = np.array(points[-1]["positions"])
    parts = [
        (plan.robots[step.robot].name, plan.plan.part_names[int(plan.actions[k]) % len(plan.plan.boundary)])
        for k, step in enumerate(plan.steps)
        if plan.grip(k) is not None
    ]
    for seed in range(4):
        grips = [(name, json.loads(text)) for name, text in run_goals(content, seed) if "gripper" in json.loads(text)]
        held = "close" if not assembles else "open"
        seen = [(name, entry["part"]) for name, entry in grips if entry["gripper"] == held]
        assert [pair for pair in seen if pair in parts] == parts


def test_names_of_joints_are_those_of_drivers_or_have_a_prefix(robot_plan: RobotPlan, tmp_path: Path) -> None:
    names = {}
    for form in ("ros2-json", "ros2-goals"):
        for prefix in ("", "{robot}_", "left_"):
            path = export_plan(robot_plan, tmp_path / f"{form}{len(names)}", form, joint_prefix=prefix)[-1]
            names[form, prefix] = re.search(r'"joint_names": \[\s*"([^"]*)"', path.read_text())[1]  # type: ignore[index]
    assert set(names.values()) == {"joint_1", "left_joint_1", names["ros2-json", "{robot}_"]}
    assert names["ros2-json", "{robot}_"].startswith("arm ")
    with pytest.raises(
        InputError, match="a prefix of joints is for ros2-json, ros2-yaml and ros2-goals, not csv; leave"
    ):
        export_plan(robot_plan, tmp_path, "csv", joint_prefix="left_")
    with pytest.raises(
        InputError, match=r"the prefix '\{arm\}_' has braces; \{robot\} stands for the name of the robot"
    ):
        export_plan(robot_plan, tmp_path, "ros2-goals", joint_prefix="{arm}_")


def test_on_the_command_line(
    timed: RobotPlan, cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("falsework.robots.cells.cell_file.load_cell", lambda name: cell)
    save_robot_plan(timed, "plan.json")
    words = ["robots", "export", "plan.json", "--cell", "mine.toml", "--out", "out", "--format"]
    assert main([*words, "urscript"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "robot arm 1 (irb2600-12/1.65) is of ABB" in err
    assert main([*words, "urscript", "--force"]) == 0
    assert "tool load in programs lacks center_of_mass" in capsys.readouterr().err
    assert main([*words, "csv", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert "csv has one motion after the other" in record["notes"][-1]


def test_notes_name_a_maker_that_is_taken_from_a_name(robot_plan: RobotPlan, cell: Cell) -> None:
    def notes(given: Cell) -> str:
        return "\n".join(export_notes(robot_plan, "rapid", given))

    assert "is taken to be" not in notes(cell)
    assert "robot arm 1 is taken to be of ABB after the name abb_irb2600 of its description" in notes(
        renamed(cell, "abb_irb2600")
    )
    assert "is taken to be" not in notes(renamed(cell, "abb_irb2600", maker="ABB"))
    assert isinstance(cell.robots[0], CellRobot)
