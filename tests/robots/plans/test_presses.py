"""Presses of robot plans: times, wrenches in the cell, loads on grippers, and the commands in all exports."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Direction, StabilitySettings, Task, export, load_structure, make_task, plan_robots
from falsework.assembly import HELD, REMOVED, Loads, complete_state
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.store import save_assembly
from falsework.cli.main import main
from falsework.cli.robot_reports import holds_record, holds_text
from falsework.errors import CellError, PlanError
from falsework.robots import Cell, HybridSettings, KeyframeGraph, Placement, RobotPlan, export_plan
from falsework.robots.exports.commands import Begin, Grip, Pressing, PublishCount, Wait, commands_of
from falsework.robots.exports.export import export_notes
from falsework.robots.kinematics.forward import flange_pose, tool_pose
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.cell_holds import CellScale, boundless, stability_in
from falsework.robots.plans.continued import continued
from falsework.robots.plans.robot_forces import grip_loads, overloads, timed_presses
from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan
from falsework.robots.plans.timeline import event_times, interruption, schedule_of
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import HoldSettings
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, Press
from tests.robots.plans.bag_reading import wrenches
from tests.robots.plans.orders import APART
from tests.robots.plans.program_grammar import Rapid, UrScript
from tests.robots.plans.test_export import load_yaml, run_programs

WRENCH = (-12.0, 3.0, 4.0, 0.5, -0.2, 0.3)
"""Of arm 2 on the cube beside the column, while arm 1 lets go of the upper cube."""
SIDE, UPPER = 2, 1


@pytest.fixture(scope="module")
def pressed(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> RobotPlan:
    """Assembly in which arm 2 holds one cube all the time, and presses it when arm 1 has placed the last one."""
    grip = robot_plan.grip_of(1, SIDE)
    assert grip is not None
    start = complete_state(column.boundary)
    start[SIDE] = HELD
    end = start.copy()
    end[:SIDE] = REMOVED
    task = Task.from_rules(column.boundary, 2, start=start, target=end, clearance=column.clearance)
    home = cell.homes[0]
    plan = plan_robots(
        column,
        cell,
        task=task,
        configurations=(home, grip),
        held=(None, SIDE),
        settings=APART,
    ).value
    assert plan is not None
    plan = plan.reverse()
    (step,) = (k for k in range(len(plan)) if plan.actions[k] == UPPER)
    assert plan.does(step) == "release block-1"
    return with_press(plan, step, Press(SIDE, WRENCH))


def with_press(plan: RobotPlan, step: int, press: Press) -> RobotPlan:
    presses: list[tuple[Press, ...]] = [()] * len(plan.plan)
    presses[int(plan.rows[step])] = (press,)
    holds = replace(plan.plan.claim.holds, mode=HoldMode.FORCE)  # with a moment
    claim = replace(plan.plan.claim, holds=holds)
    # What robots bear was found without the press.
    return replace(plan, plan=replace(plan.plan, presses=tuple(presses), claim=claim, loads=()))


def limited(cell: Cell, **limits: Any) -> Cell:
    grippers = [replace(robot.gripper, **limits) for robot in cell.robots]
    robots = tuple(replace(robot, gripper=gripper) for robot, gripper in zip(cell.robots, grippers, strict=True))
    return replace(cell, robots=robots)


def in_cell(plan: RobotPlan, cell: Cell) -> RobotPlan:
    return replace(plan, cell_identity=cell_identity(cell))


def last_step(plan: RobotPlan) -> int:
    return len(plan) - 1


def test_a_press_is_kept_in_files_and_certified(pressed: RobotPlan, column: Assembly, tmp_path: Path) -> None:
    save_robot_plan(pressed, tmp_path / "plan.json")
    again = load_robot_plan(tmp_path / "plan.json")
    assert again.plan.presses == pressed.plan.presses
    assert validate_plan(again.plan, column).good


def test_the_press_in_the_cell(pressed: RobotPlan, column: Assembly, cell: Cell) -> None:
    """Turned and scaled with the structure; the moment about the tool agrees with statics."""
    graph = schedule_of(pressed)
    (press,) = timed_presses(pressed, column, cell, graph)
    step = last_step(pressed)
    assert (press.step, press.robot, press.part) == (step, 1, SIDE)
    np.testing.assert_allclose(press.wrench, WRENCH)
    assert press.start == pytest.approx(event_times(pressed, graph)[step])
    assert press.end == pytest.approx(pressed.seconds)
    tool = tool_pose(cell.robots[1], pressed.keyframes[step].configurations[1])
    inside = press.wrench_in(tool)
    np.testing.assert_allclose(tool[:3, :3] @ inside[:3], WRENCH[:3], atol=1e-9)
    lever = column.mass.center[SIDE] - tool[:3, 3]
    np.testing.assert_allclose(tool[:3, :3] @ inside[3:], WRENCH[3:] + np.cross(lever, WRENCH[:3]), atol=1e-9)

    turned = replace(cell, placement=Placement(yaw=np.pi / 2, scale=2.0, density=500.0))
    (grown,) = timed_presses(in_cell(pressed, turned), column, turned, graph)
    x, y, z = WRENCH[:3]
    np.testing.assert_allclose(grown.wrench[:3], 16 * np.array([-y, x, z]), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(grown.wrench[3:]), 32 * np.linalg.norm(WRENCH[3:]))
    assert timed_presses(pressed.reverse(), column, cell, schedule_of(pressed.reverse())) == ()


def test_the_offset_gives_the_wrench(pressed: RobotPlan, column: Assembly, cell: Cell) -> None:
    """A spring at the centre of mass whose set point moves with the tool bears force and moment."""
    (press,) = timed_presses(pressed, column, cell, schedule_of(pressed))
    shift, angle = np.split(press.offset, 2)
    shift, angle = press.tool[:3, :3] @ shift, press.tool[:3, :3] @ angle
    center = shift + np.cross(angle, press.center - press.tool[:3, 3])
    np.testing.assert_allclose(PRESS_STIFFNESS * center, WRENCH[:3], rtol=1e-9)
    own = column.mass.inertia[SIDE] / column.mass.mass[SIDE]
    np.testing.assert_allclose(PRESS_STIFFNESS * own @ angle, WRENCH[3:], rtol=1e-9)


@pytest.mark.parametrize("reserve", [1.1, 3.0])
def test_grippers_bear_the_larger_of_the_loads_with_the_reserve_and_without(
    pressed: RobotPlan, column: Assembly, cell: Cell, reserve: float
) -> None:
    """As the plan says of its robots: with less friction less of what they pressed may be left."""

    def with_reserve(value: float) -> RobotPlan:
        claim = replace(pressed.plan.claim, reserve=value)
        return replace(pressed, plan=replace(pressed.plan, claim=claim))

    loads, plain = (grip_loads(with_reserve(value), column, cell) for value in (reserve, 1.0))
    assert [load.keyframe for load in loads] == [load.keyframe for load in plain]
    for load, true in zip(loads, plain, strict=True):
        assert load.force_n >= true.force_n * (1 - 1e-9)
        assert load.moment_nm >= true.moment_nm * (1 - 1e-9)


def test_grippers_bear_presses(pressed: RobotPlan, column: Assembly, cell: Cell) -> None:
    """What a robot bears after a press includes it, less what the part gives way; limits count for both."""
    bare = replace(pressed, plan=replace(pressed.plan, presses=()))
    loads, before = grip_loads(pressed, column, cell), grip_loads(bare, column, cell)
    assert len(loads) == len(before) + 1
    (alone,) = (load for load in loads if load.presses)
    np.testing.assert_allclose(alone.force, WRENCH[:3])
    (press,) = timed_presses(pressed, column, cell, schedule_of(pressed))
    np.testing.assert_allclose(press.tool[:3, :3].T @ alone.moment, press.wrench_in(press.tool)[3:], atol=1e-9)

    def held(loads: list) -> np.ndarray:
        return next(load.force for load in loads if load.keyframe == len(pressed) and not load.presses)

    added = held(loads) - held(before)
    assert WRENCH[0] < added[0] < -1e-3  # towards the column, less than was commanded
    assert overloads(loads, pressed, limited(cell, force=100.0)) == []
    weak = limited(cell, force=0.9 * alone.force_n)
    said = [str(problem) for problem in overloads(loads, pressed, weak)]
    assert any("pressing block-2 takes a force of 13 N; its gripper bears 11.7 N" in text for text in said)
    weak = limited(cell, moment=0.9 * alone.moment_nm)
    assert any("pressing block-2 takes a moment" in str(problem) for problem in overloads(loads, pressed, weak))


@pytest.mark.parametrize("form", ["ros2-json", "ros2-yaml", "csv", "rapid", "urscript", "mcap"])
def test_no_export_exceeds_a_gripper_or_lacks_what_a_press_needs(
    pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, form: str
) -> None:
    weak = limited(cell, force=12.0)
    with pytest.raises(PlanError, match="pressing block-2 takes a force of 13 N; its gripper bears 12 N"):
        export_plan(in_cell(pressed, weak), tmp_path, form, structure=column, cell=weak)
    missing: tuple[dict[str, Any], ...] = ({"cell": cell}, {"structure": column}, {})
    for given in missing:
        with pytest.raises(PlanError, match=r"robots press in this plan.*give its (structure|cell)"):
            export_plan(pressed, tmp_path, form, **given)
    assert export_plan(pressed.reverse(), tmp_path, form, cell=cell, force=True)  # in disassembly no robot presses


def test_presses_that_no_robot_can_carry_out(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    step = last_step(pressed)
    forged = {
        with_press(pressed, step, Press(0, WRENCH)): "block-0 is pressed, but no robot holds it all the time",
        with_press(pressed, step - 1, Press(SIDE, WRENCH)): "block-2 is pressed while no other part is let go of",
    }
    for plan, message in forged.items():
        with pytest.raises(PlanError, match=message):
            export_plan(plan, tmp_path, "csv", structure=column, cell=cell)


@pytest.mark.parametrize("form", ["ros2-json", "ros2-yaml"])
def test_ros_files_have_presses(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, form: str) -> None:
    kind, step = form[5:], last_step(pressed)
    read = json.loads if kind == "json" else load_yaml
    export_plan(pressed, tmp_path, form, structure=column, cell=cell)
    steps = read((tmp_path / f"plan.{kind}").read_text())["steps"]
    assert [len(entry["presses"]) for entry in steps] == [0] * step + [1]
    assert steps[step] == read((tmp_path / f"step-{step + 1:03d}.{kind}").read_text())
    (found,) = steps[step]["presses"]
    (press,) = timed_presses(pressed, column, cell, schedule_of(replace(pressed, schedule=None)))
    assert (found["robot"], found["part"]) == ("arm 2", "block-2")
    assert found["start"] == pytest.approx(press.start)
    assert found["end"] == pytest.approx(press.end)
    motions = [entry["start"] for entry in steps[step]["sequence"] if "start" in entry]
    assert found["start"] == pytest.approx(motions[0])
    np.testing.assert_allclose(found["world"]["force"] + found["world"]["torque"], WRENCH)
    np.testing.assert_allclose(found["center"], column.mass.center[SIDE], atol=1e-12)
    np.testing.assert_allclose(found["tool"]["force"] + found["tool"]["torque"], press.wrench_in(press.tool))


def test_a_plan_that_goes_on_keeps_what_was_pressed(pressed: RobotPlan, column: Assembly, cell: Cell) -> None:
    """The new steps are proven with the presses with which the others were done, not with those found anew."""
    (first,) = (k for k in range(len(pressed)) if pressed.actions[k] == 0)
    begun = with_press(pressed, first, Press(SIDE, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0)))
    instant = float(event_times(begun, schedule_of(begun))[first])
    now = interruption(begun, instant + 0.01)
    assert now.done == int(begun.rows[first]) + 1
    task = make_task(column, 2, start=complete_state(column.boundary), target=now.state)
    arms: dict[str, Any] = {"configurations": now.configurations, "held": now.held, "gripped": now.gripped}
    rest = plan_robots(column, cell, task=task, settings=HybridSettings(Direction.ASSEMBLY, attempts=4), **arms).value
    assert rest is not None
    whole, falls_at = continued(rest, begun, now.done, column)
    assert falls_at is None
    assert whole.plan.presses[now.done - 1] == begun.plan.presses[now.done - 1] != ()
    assert validate_plan(whole.plan, column).good


def test_a_table_of_presses(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    paths = export_plan(pressed, tmp_path, "csv", structure=column, cell=cell)
    assert paths[-1].name == "presses.csv"
    with paths[-1].open() as file:
        header, row = csv.reader(file)
    assert header[:5] == ["start", "end", "step", "robot", "part"]
    assert row[2:5] == [str(len(pressed)), "arm 2", "block-2"]
    (press,) = timed_presses(pressed, column, cell, schedule_of(replace(pressed, schedule=None)))
    numbers = dict(zip(header, row, strict=True))
    axes = [f"{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"]
    np.testing.assert_allclose([float(numbers[f"world_{axis}"]) for axis in axes], WRENCH)
    inside = [float(numbers[f"tool_{axis}"]) for axis in axes]
    np.testing.assert_allclose(inside, press.wrench_in(press.tool), atol=1e-6)
    np.testing.assert_allclose([float(row[0]), float(row[1])], [press.start, press.end], atol=1e-6)
    assert numbers["mode"] == "force"
    np.testing.assert_allclose([float(numbers[f"center_{axis}"]) for axis in "xyz"], press.center, atol=1e-6)


def test_a_bag_has_set_points_of_the_wrench(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    """At the flange, whose frame a reader knows from the description of the arm; zero from the end on."""
    (path,) = export_plan(pressed, tmp_path, "mcap", structure=column, cell=cell)
    (press,) = timed_presses(pressed, column, cell, schedule_of(pressed))
    (begun, first), (ended, last) = wrenches(path, "/arm_2/wrench_setpoint")
    assert first.header.frame_id == "arm 2_tool0"
    robot = cell.robots[1]
    flange = flange_pose(robot.model, pressed.keyframes[-1].configurations[1], robot.base)
    for message, wanted in ((first, press.wrench_in(flange)), (last, np.zeros(6))):
        force, torque = message.wrench.force, message.wrench.torque
        np.testing.assert_allclose([force.x, force.y, force.z, torque.x, torque.y, torque.z], wanted, atol=1e-9)
    assert (begun, ended) == pytest.approx((press.start * 1e9, press.end * 1e9), abs=1)
    assert first.header.stamp.sec + 1e-9 * first.header.stamp.nanosec == pytest.approx(press.start)


def test_a_module_moves_the_set_point(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    paths = export_plan(pressed, tmp_path, "rapid", structure=column, cell=cell)
    text = paths[1].read_text()
    assert {"MoveL", "RelTool", "CalcRobT"} <= Rapid(text).called
    (press,) = timed_presses(pressed, column, cell, schedule_of(pressed))
    assert "! press block-2 with 13 N, (-12, 3, 4) N in the cell, at 1 MN/m" in text
    numbers = r"(-?\d+\.\d+)"
    form = rf"MoveL RelTool\(CalcRobT\((\w+), arm_2_tool\), {', '.join([numbers] * 3)}"
    form += "".join(rf"\\R{axis}:={numbers}" for axis in "xyz") + r"\), v5, fine, arm_2_tool;"
    (found,) = re.findall(form, text)
    np.testing.assert_allclose(np.array(found[1:4], float), 1e3 * press.offset[:3], atol=1e-6)
    np.testing.assert_allclose(np.array(found[4:], float), np.degrees(press.offset[3:]), atol=1e-5)
    (held,) = re.findall(rf"CONST jointtarget {found[0]} := \[\[([^\]]*)\]", text)
    values = np.radians([float(value) for value in held.split(",")])
    np.testing.assert_allclose(values, pressed.keyframes[-1].configurations[1], atol=1e-6)
    assert "RelTool" not in paths[0].read_text()
    names = re.findall(r"PROC (\w+_step\d+)\(\)", text)
    assert names == re.findall(r"^    (\w+_step\d+);", text, re.MULTILINE) == [f"arm_2_step{len(pressed)}"]
    body = text[text.index("PROC arm_2_step") : text.index("ENDPROC", text.index("PROC arm_2_step"))]
    assert body.index("MoveL") < body.index("SetGO") < body.index("! stay where the press of block-2 has ended")


def test_two_presses_add_up_in_a_module(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    (first,) = (k for k in range(len(pressed)) if pressed.actions[k] == 0)
    presses = [*pressed.plan.presses]
    presses[int(pressed.rows[first])] = (Press(SIDE, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0)),)
    plan = replace(pressed, plan=replace(pressed.plan, presses=tuple(presses)))
    text = export_plan(plan, tmp_path, "rapid", structure=column, cell=cell)[1].read_text()
    both = timed_presses(plan, column, cell, schedule_of(plan))
    shifts = [float(x) for x in re.findall(r"RelTool\(CalcRobT\(\w+, arm_2_tool\), (-?[\d.]+),", text)]
    np.testing.assert_allclose(shifts, 1e3 * np.cumsum([press.offset[0] for press in both]), atol=1e-6)


def test_a_script_controls_the_force(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    """Along z of a frame at the tool that points where the press does, relative to what was measured before."""
    from scipy.spatial.transform import Rotation

    paths = export_plan(pressed, tmp_path, "urscript", structure=column, cell=cell, force=True)
    text = paths[1].read_text()
    UrScript(text)
    form = r"force_mode\(pose_trans\(get_target_tcp_pose\(\), p\[([^\]]*)\]\), \[0, 0, 1, 0, 0, 0\], "
    ((pose, force),) = re.findall(form + r"\[0, 0, ([\d.]+), 0, 0, 0\], 2, \[[^\]]*\]\)", text)
    assert float(force) == pytest.approx(np.linalg.norm(WRENCH[:3]))
    numbers = np.array([float(value) for value in pose.split(",")])
    np.testing.assert_allclose(numbers[:3], 0.0)
    tool = tool_pose(cell.robots[1], pressed.keyframes[-1].configurations[1])
    along = tool[:3, :3] @ Rotation.from_rotvec(numbers[3:]).as_matrix()[:, 2]
    np.testing.assert_allclose(along, np.array(WRENCH[:3]) / np.linalg.norm(WRENCH[:3]), atol=1e-5)
    words = ("zero_ftsensor()", "force_mode(pose", "write_port_register(128, 4)", "end_force_mode()")
    order = [text.index(word) for word in words]
    assert order == sorted(order)
    assert "force_mode" not in paths[0].read_text()


@pytest.mark.parametrize("form", ["rapid", "urscript"])
def test_a_gripper_opens_only_while_the_other_arm_presses(
    pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, form: str
) -> None:
    """The arm that lets go waits for the press, which ends after that: in the commands, and without a deadlock."""
    step, presses = last_step(pressed), timed_presses(pressed, column, cell, schedule_of(pressed))
    presser = list(commands_of(pressed, 1, presses))
    begin, end = (k for k, command in enumerate(presser) if isinstance(command, Pressing))
    assert isinstance(presser[begin - 1], Wait | Begin)
    (told,) = (command for command in presser[begin:end] if isinstance(command, PublishCount))
    (waited,) = (command for command in presser[begin:end] if isinstance(command, Wait))
    other = list(commands_of(pressed, 0, presses))
    place = max(k for k, command in enumerate(other) if isinstance(command, Begin) and command.step == step)
    opens = next(k for k in range(place, len(other)) if isinstance(other[k], Grip))
    assert Wait(1, told.count) in other[place:opens]
    assert other[opens + 1] == PublishCount(waited.count)
    paths = export_plan(pressed, tmp_path, form, structure=column, cell=cell, force=True)
    for seed in range(5):
        assert run_programs(paths, seed)


def test_steps_name_the_arm_that_presses(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    """As the cell does, not as the plan numbers robots; newtons are those in the cell, where they are given."""
    step = last_step(pressed)
    assert pressed.does(step) == "release block-1; arm 2 presses block-2"
    small = replace(cell, placement=Placement(scale=0.5))
    for path in export_plan(in_cell(pressed, small), tmp_path, "rapid", structure=column, cell=small):
        said = [line for line in path.read_text().splitlines() if "press" in line and " N" in line]
        assert all("press block-2 with 1.625 N, (-1.5, 0.375, 0.5) N in the cell" in line for line in said)
    (record,) = (
        entry
        for entry in holds_record(grip_loads(in_cell(pressed, small), column, small), pressed, small)
        if entry["press_n"] is not None
    )
    assert (record["robot"], record["press_n"]) == ("arm 2", pytest.approx(1.625))
    assert "arm 2 bears up to" in holds_text(record)
    assert ", presses with up to 1.62 N; limits" in holds_text(record)


def test_scripts_say_that_they_leave_moments_out(pressed: RobotPlan, cell: Cell) -> None:
    lost = "URScript has the force along one direction alone"
    assert [any(lost in note for note in export_notes(pressed, form, cell)) for form in ("urscript", "rapid")] == [
        True,
        False,
    ]
    claim = replace(pressed.plan.claim, holds=HoldSettings())
    along = replace(pressed, plan=replace(pressed.plan, claim=claim))
    assert not any(lost in note for note in export_notes(along, "urscript", cell))


def test_one_function_exports_presses_too(pressed: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path) -> None:
    save_robot_plan(pressed, tmp_path / "plan.json")
    export(tmp_path / "plan.json", tmp_path / "out", column, format="csv", cell=cell)
    assert (tmp_path / "out" / "presses.csv").is_file()


def test_limits_of_holds_are_those_of_the_weakest_gripper(column: Assembly, cell: Cell) -> None:
    """In the units of the structure, whatever its scale and density in the cell."""
    settings = StabilitySettings(holds=HoldSettings(stiffness=1e6))
    free = stability_in(cell, column, settings)
    assert free == settings
    small = replace(cell, placement=Placement(scale=0.5, density=500.0))
    scale = CellScale.from_cell(column, small)
    assert (scale.force, scale.moment, scale.stiffness) == pytest.approx((0.25, 0.125, 0.5))
    first, second = small.robots
    first = replace(first, gripper=replace(first.gripper, force=80.0, moment=9.0))
    second = replace(second, gripper=replace(second.gripper, force=90.0, moment=7.0))
    holds = stability_in(replace(small, robots=(first, second)), column, settings).holds
    assert (holds.force, holds.moment, holds.stiffness) == pytest.approx((80.0 / 0.25, 7.0 / 0.125, 1e6 / 0.5))
    given = replace(settings, holds=HoldSettings(force=20.0))
    assert stability_in(replace(small, robots=(first, second)), column, given).holds.force == pytest.approx(80.0)
    weak = replace(second, gripper=replace(second.gripper, force=4.0))
    with pytest.raises(CellError, match=r"the gripper of arm 2 bears 4 N, less than part block-2 weighs .* 4\.905 N"):
        stability_in(replace(small, robots=(first, weak)), column, settings)
    with pytest.raises(CellError, match="the gripper of arm 2 bears 4 N"):
        plan_robots(column, replace(small, robots=(first, weak)), settings=APART)


def test_what_grippers_without_limits_bear_is_said(cell: Cell) -> None:
    """Fifty weights only where nothing else limits what robots bear."""
    first, second = cell.robots
    mixed = replace(cell, robots=(first, replace(second, gripper=replace(second.gripper, name="weak", force=14.0))))
    assert boundless(cell).endswith("bear fifty weights of the heaviest part in planning: cup")
    assert boundless(cell, 20.0).endswith("bear at most 20 N in planning: cup")
    assert boundless(mixed, 20.0).endswith("bear at most 14 N in planning: cup")
    assert boundless(limited(cell, force=14.0)) == ""


@pytest.fixture(scope="module")
def gap() -> Assembly:
    """A cube between a wall and another one, and one below it that comes later: before, only friction carries it."""
    solids = [
        box("block", low, np.asarray(low) + 0.2) for low in ((-0.1, -0.1, 0.2), (0.1, -0.1, 0.2), (-0.1, -0.1, 0))
    ]
    solids.append(box("wall", (-0.2, -0.1, 0.25), (-0.1, 0.1, 0.4), fixed=True))
    solids.append(box("pedestal", (-0.1, -0.1, -0.2), (0.1, 0.1, 0.0), fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, friction=0.6, name="gap")


@pytest.mark.parametrize("together", [False, True])
def test_arms_press_where_the_search_needs_it(gap: Assembly, cell: Cell, together: bool) -> None:
    """The lowest cube is not delivered yet, so the upper one has to stand without it, pressed against the wall.

    Presses of the plan are those of its own order, also where the order of steps was searched anew.
    """
    raised = replace(cell, placement=Placement(position=(0.0, 0.0, 0.2)))
    start, end = (np.array(state, np.uint8) for state in ((1, 2, 1, 2, 2), (0, 2, 0, 2, 2)))
    grip = KeyframeGraph(gap, raised).grips(1, 1, start)[0].configuration

    def planned(cell: Cell, holds: HoldSettings) -> tuple[RobotPlan, list[int]]:
        """Return the plan and the order in which parts come."""
        task = Task.from_rules(gap.boundary, 2, start=start, target=end, missing=[2])
        given: dict[str, Any] = {"configurations": (cell.homes[0], grip), "held": (None, 1), "concurrent": together}
        limits = HybridSettings(Direction.DISASSEMBLY, attempts=2)
        stability = StabilitySettings(reserve=1.1, holds=holds)
        found = plan_robots(gap, cell, task=task, settings=limits, stability=stability, **given).value
        assert found is not None
        return found.reverse(), found.plan.inserted_parts.tolist()

    plan, order = planned(raised, HoldSettings())
    assert order == [0, 2]
    assert [[press.part for press in presses] for presses in plan.plan.presses] == [[], [1], [], []]
    assert plan.plan.claim.reserve == 1.1
    assert validate_plan(plan.plan, gap).good
    (press,) = timed_presses(plan, gap, raised, schedule_of(plan))
    assert (press.robot, press.part) == (1, 1)
    assert press.wrench[0] < -20.0  # against the wall
    grippers = limited(raised, force=1.1 * max(load.force_n for load in grip_loads(plan, gap, raised)))
    assert planned(grippers, HoldSettings())[1] == [0, 2]
    # Grippers that carry a cube, but cannot press as hard, and robots that may not press, need the lowest cube first.
    assert planned(limited(raised, force=22.0), HoldSettings())[1] == [2, 0]
    bare, order = planned(raised, HoldSettings(mode=HoldMode.LOCKED))
    assert order == [2, 0]
    assert not any(bare.plan.presses)


def test_a_plan_without_the_reserve_where_none_keeps_it(cell: Cell, make_boxes: Callable[..., Assembly]) -> None:
    """A cube that an earthquake pushes with 0.52 of its weight, on a friction of 0.55."""
    alone = make_boxes((-0.1, -0.1, 0.0))
    shaken = alone.replace(loads=Loads.from_arrays(alone.part_count, acceleration=(0.52, 0.0, 0.0)))
    plan = plan_robots(shaken, cell, settings=APART).value
    assert plan is not None
    assert plan.plan.claim.reserve == 1.0
    calm = plan_robots(alone, cell, settings=APART).value
    assert calm is not None
    assert calm.plan.claim.reserve == 1.1


def test_the_command_needs_the_structure_of_a_plan_with_presses(
    pressed: RobotPlan,
    column: Assembly,
    cell: Cell,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_assembly(column, tmp_path / "boxes")
    save_robot_plan(pressed, tmp_path / "plan.json")
    monkeypatch.setattr("falsework.robots.cells.cell_file.load_cell", lambda _: cell)
    command = ["robots", "export", str(tmp_path / "plan.json"), "--cell", "here", "--format", "csv", "--out"]
    assert main([*command, str(tmp_path / "bare")]) == 2
    assert "structure" in capsys.readouterr().err
    again = load_structure(tmp_path / "boxes")
    moved = replace(pressed, plan=replace(pressed.plan, identity=again.identity, part_names=tuple(again.names)))
    save_robot_plan(moved, tmp_path / "plan.json")
    assert main([*command, str(tmp_path / "out"), "--structure", str(tmp_path / "boxes")]) == 0, capsys.readouterr().err
    assert (tmp_path / "out" / "presses.csv").is_file()
