"""Programs for robot controllers, ABB RAPID and URScript, that keep the order of a robot plan across robots.

Controllers share the counts of `commands_of` by their own means: RAPID by group signals, URScript by the Modbus
registers of each controller. Loads of tools and signals of grippers are those of the cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.robots.exports.commands import (
    COUNT_FROM,
    AtOnce,
    Begin,
    Command,
    Grip,
    Pressing,
    PublishCount,
    Wait,
    commands_of,
)
from falsework.robots.exports.controller import (
    REGISTER,
    address_of,
    ascii_text,
    controller_settings,
    grip_signal,
    program_axes,
    program_names,
    rapid_task,
)
from falsework.robots.exports.payloads import PartLoads, ToolLoad, in_tool, rapid_load, together, tool_load, ur_payload
from falsework.robots.model.cell import Cell, CellRobot
from falsework.robots.model.shapes import Array, wxyz_of
from falsework.robots.plans.robot_forces import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import nodes_of
from falsework.robots.plans.trajectory import Trajectory
from falsework.stability.holds import HoldMode
from falsework.utils.quantity import format_number, format_quantity

MOST_COUNT = 65535
"""Largest 16-bit count."""
UR_CYCLE = 0.002
"""Time between two commands that a UR controller carries out, seconds."""
_UR_LIMITS = (0.005, 0.005, 0.01, 0.05, 0.05, 0.05)
"""Largest deviation across a press, m and rad, and largest speed along it, m/s, in force mode."""


def rapid_modules(
    plan: RobotPlan, cell: Cell, presses: Sequence[TimedPress] = (), loads: PartLoads | None = None
) -> Iterator[tuple[str, str]]:
    """Yield file names and RAPID modules, one for each arm, with the loads of carried parts if given.

    Knots become joint targets for `MoveAbsJ`, in degrees and mm, with the durations of the plan. An arm sets the
    group output `go_NAME_count`, and reads those of others as `gi_NAME_count`. An arm that presses moves its set point
    by force and moment over its stiffness, on a slow line from where it holds the part, and stays there. Arms that move
    at the same instant are those of one MultiMove controller, which keeps them in step from knot to knot.
    """
    names = _names(plan, presses)
    for robot, name in enumerate(names):
        record, signals = plan.robots[robot], cell.robots[robot].signals
        output, closed = grip_signal(cell.robots[robot], name, "rapid"), int(signals.closed)
        axes = program_axes(cell.robots[robot], "rapid")
        slides = cell.robots[robot].model.prismatic[axes]
        targets: list[str] = []
        carried, number, meeting, step, order = "", 0, "", 0, 0
        offset = np.zeros(6)  # of what the arm has pressed since it last moved
        body: list[str] = []
        begin = _jointtarget(plan.keyframes[0].configurations[robot][axes], slides)
        run = [f"    MoveAbsJ {begin}, v200, fine, {name}_tool;"]
        others = [other for other in names if other != name]
        if others:
            run += [f"    SetGO go_{name}_count, 1;"]
            run += [f"    WaitUntil GInput(gi_{other}_count)=1 OR GInput(gi_{other}_count)=2;" for other in others]
            run += [f"    SetGO go_{name}_count, 2;"]
            run += [f"    WaitUntil GInput(gi_{other}_count)<>1;" for other in others]
            run += [f"    SetGO go_{name}_count, {COUNT_FROM};"]
        for command, load in _with_loads(plan, robot, presses, loads):
            if isinstance(command, Begin):
                step, order = command.step + 1, 0
                body += ["  ENDPROC"] * bool(body)
                body += [f"  PROC {name}_step{command.step + 1}()", f"    ! {ascii_text(plan.does(command.step))}"]
                run.append(f"    {name}_step{command.step + 1};")
            elif isinstance(command, Wait):
                body.append(f"    WaitUntil GInput(gi_{names[command.robot]}_count)>={command.count};")
            elif isinstance(command, PublishCount):
                body.append(f"    SetGO go_{name}_count, {command.count};")
            elif isinstance(command, Grip):
                body.append(f"    {name}_gripper {'TRUE' if command.close else 'FALSE'};")
                if carried and not command.close:
                    body.append("    GripLoad load0;")
                    carried = ""
            elif isinstance(command, Pressing):
                body.append(f"    ! {_describe_press(plan, command)}")
                if command.begins:
                    offset = offset + command.press.offset
                    target = f"{name}_p{len(targets) + 1}"
                    held = plan.keyframes[command.press.step].configurations[robot]
                    targets.append(f"  CONST jointtarget {target} := {_jointtarget(held[axes], slides)};")
                    place = f"RelTool(CalcRobT({target}, {name}_tool), {_shift(offset)})"
                    body += [f"    MoveL {place}, v5, fine, {name}_tool;", "    WaitTime\\InPos, 0.5;"]
            elif isinstance(command, AtOnce):
                order += 1
                meeting, tasks = f"sync{step}_{order}", ",".join(f'["{rapid_task(k)}"]' for k in sorted(command.robots))
                targets.append(f"  PERS tasks {meeting}_tasks{{{len(command.robots)}}} := [{tasks}];")
                targets += [f"  VAR syncident {meeting}_{end};" for end in ("on", "off")]
            elif isinstance(command, Trajectory):
                offset = np.zeros(6)
                now = "" if load is None else rapid_load(in_tool(load, record.tool))
                if now != carried:
                    number += bool(now)
                    if now:
                        targets.append(f"  PERS loaddata {name}_load{number} := {now};")
                    body.append(f"    GripLoad {f'{name}_load{number}' if now else 'load0'};")
                    carried = now
                last = len(command.times) - 1
                body += [f"    SyncMoveOn {meeting}_on, {meeting}_tasks;"] * bool(meeting)
                for knot in range(1, last + 1):
                    target = f"{name}_j{len(targets) + 1}"
                    values = _jointtarget(command.positions[knot][axes], slides)
                    targets.append(f"  CONST jointtarget {target} := {values};")
                    seconds = max(command.times[knot] - command.times[knot - 1], 0.001)
                    zone = "fine" if knot == last else "z0"
                    same = f"\\ID:={knot}" if meeting else ""
                    body.append(f"    MoveAbsJ {target}{same}, v1000\\T:={seconds:.3f}, {zone}, {name}_tool;")
                body += [f"    SyncMoveOff {meeting}_off;"] * bool(meeting)
                meeting = ""
        lines = [
            f"MODULE {name}_arm",  # a name alone could be a word of the language, or a module of the controller
            *(f"  ! {line}" for line in (_about(plan, robot), *controller_settings(plan, cell, robot, "rapid"))),
            f"  PERS tooldata {name}_tool := {_tooldata(record.tool, cell.robots[robot])};",
            *targets,
            f"  PROC {name}_gripper(bool closed)",
            "    IF closed THEN",
            f"      SetDO {output}, {closed};",
            "    ELSE",
            f"      SetDO {output}, {1 - closed};",
            "    ENDIF",
            f"    WaitTime\\InPos, {signals.seconds:g};",
            "  ENDPROC",
            *body,
            *["  ENDPROC"] * bool(body),
            f"  PROC {name}_run()",
            *run,
            "  ENDPROC",
            "ENDMODULE",
        ]
        yield f"{name}.mod", "\n".join(lines) + "\n"


def ur_scripts(
    plan: RobotPlan, cell: Cell, rate: float, presses: Sequence[TimedPress] = (), loads: PartLoads | None = None
) -> Iterator[tuple[str, str]]:
    """Yield file names and URScript programs, one for each arm, as `rapid_modules`.

    Motions are positions at a fixed rate for `servoj`, in whole cycles of the controller, with a `movej` to the last of
    each. An arm writes its count to register 128 of its controller; others read it there over Modbus TCP, at the
    address in the first lines. An arm that presses controls the force along its direction, from what the sensor
    measures before on, and keeps its position across it; moments are not commanded.
    """
    if rate * UR_CYCLE > 1:
        raise InputError(f"UR controllers take {1 / UR_CYCLE:g} positions per second at most; give a rate up to that")
    pause = UR_CYCLE * max(round(1 / (rate * UR_CYCLE)), 1)
    names = _names(plan, presses)
    for robot, name in enumerate(names):
        record, signals = plan.robots[robot], cell.robots[robot].signals
        kind, number = grip_signal(cell.robots[robot], name, "urscript").split()
        program_axes(cell.robots[robot], "urscript")
        others = [other for other in names if other != name]
        tool = tool_load(cell.robots[robot].gripper)
        own_load = carried = ur_payload(tool)
        about = (_about(plan, robot), *controller_settings(plan, cell, robot, "urscript"))
        lines = [f"def {name}_arm():", *(f"  # {line}" for line in about)]
        addresses = {names[k]: address_of(entry, names[k]) for k, entry in enumerate(cell.robots)}
        for other in others:
            lines += [
                f'  modbus_add_signal("{addresses[other]}", 255, {REGISTER}, 2, "{other}_count", False)',
                f'  modbus_set_signal_update_frequency("{other}_count", 50)',
                f"  def {other}_count():",
                f'    return modbus_get_signal_status("{other}_count", False)',
                "  end",
            ]
        lines += [
            "  def gripper(closed):",
            f"    set_{kind}_digital_out({number}, {'closed' if signals.closed else 'not closed'})",
            f"    sleep({signals.seconds:g})",
            "  end",
            f"  set_tcp({_ur_pose(record.tool)})",
            f"  {own_load}",
            f"  movej({_ur_joints(plan.keyframes[0].configurations[robot])}, a=0.5, v=0.5)",
        ]
        if others:
            lines.append(f"  write_port_register({REGISTER}, 1)")
            lines += [line for other in others for line in _until(f"{other}_count() == 1 or {other}_count() == 2")]
            lines.append(f"  write_port_register({REGISTER}, 2)")
            lines += [line for other in others for line in _until(f"{other}_count() != 1")]
            lines.append(f"  write_port_register({REGISTER}, {COUNT_FROM})")
        for command, load in _with_loads(plan, robot, presses, loads):
            if isinstance(command, Begin):
                lines.append(f"  # step {command.step + 1}: {ascii_text(plan.does(command.step))}")
            elif isinstance(command, Wait):
                lines += _until(f"{names[command.robot]}_count() >= {command.count}")
            elif isinstance(command, PublishCount):
                lines.append(f"  write_port_register({REGISTER}, {command.count})")
            elif isinstance(command, Grip):
                lines.append(f"  gripper({'True' if command.close else 'False'})")
                if carried != own_load and not command.close:
                    lines.append(f"  {own_load}")
                    carried = own_load
            elif isinstance(command, Pressing):
                lines.append(f"  # {_describe_press(plan, command)}")
                lines += _ur_press(command.press) if command.begins else ["  end_force_mode()"]
            elif isinstance(command, Trajectory):
                now = own_load if load is None else ur_payload(together(tool, load))
                if now != carried:
                    lines.append(f"  {now}")
                    carried = now
                count = max(int(np.ceil(command.seconds / pause)), 1)
                for values in command.sample(np.linspace(pause, count * pause, count)):
                    lines.append(f"  servoj({_ur_joints(values)}, t={pause:.3f}, lookahead_time=0.1, gain=300)")
                lines.append("  stopj(10)")
                lines.append(f"  movej({_ur_joints(command.positions[-1])}, a=0.5, v=0.5)")
        yield f"{name}.script", "\n".join([*lines, "end", ""])


def _about(plan: RobotPlan, robot: int) -> str:
    model = ascii_text(plan.robots[robot].model)
    return f"{ascii_text(plan.plan.name)}: {plan.direction.value} with {model}, {len(plan)} steps"


def _with_loads(
    plan: RobotPlan, robot: int, presses: Sequence[TimedPress], loads: PartLoads | None
) -> Iterator[tuple[Command, ToolLoad | None]]:
    """Yield the commands of an arm, each motion with the load of the part that it carries."""
    motion = step = 0
    for command in commands_of(plan, robot, presses):
        if isinstance(command, Begin):
            motion, step = 0, command.step
        load = None
        if isinstance(command, Trajectory):
            load, motion = (loads or {}).get((step, robot, motion)), motion + 1
        yield command, load


def _describe_press(plan: RobotPlan, command: Pressing) -> str:
    press, part = command.press, ascii_text(plan.plan.part_names[command.press.part])
    if not command.begins:
        return f"stay where the press of {part} has ended"
    force = ", ".join(format_number(round(value, 9), 4) for value in press.wrench[:3])
    along = " along it" if press.mode is HoldMode.HYBRID else ""
    return (
        f"press {part} with {format_number(press.force, 4)} N, ({force}) N in the cell, at "
        f"{format_quantity(press.stiffness, 'stiffness')}{along}"
    )


def _shift(offset: Array) -> str:
    """Return a displacement along and about the axes of a tool, m and rad, as arguments of `RelTool`."""
    turn = "".join(f"\\R{axis}:={value:.5f}" for axis, value in zip("xyz", np.degrees(offset[3:]), strict=True))
    return ", ".join(f"{1000 * value:.6f}" for value in offset[:3]) + turn


def _ur_press(press: TimedPress) -> list[str]:
    """Return commands that control the force along z of a frame at the tool, whose z is the direction of the press."""
    from scipy.spatial.transform import Rotation

    frame = np.eye(4)
    if press.force > 0:
        way = press.wrench_in(press.tool)[:3] / press.force
        frame[:3, :3] = Rotation.align_vectors(way[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    limits = ", ".join(f"{value:g}" for value in _UR_LIMITS)
    return [
        "  zero_ftsensor()",
        f"  force_mode(pose_trans(get_target_tcp_pose(), {_ur_pose(frame)}), [0, 0, 1, 0, 0, 0], "
        f"[0, 0, {press.force:.3f}, 0, 0, 0], 2, [{limits}])",
        "  sleep(0.5)",
    ]


def _until(condition: str) -> list[str]:
    return [f"  while not ({condition}):", "    sync()", "  end"]


def _names(plan: RobotPlan, presses: Sequence[TimedPress]) -> list[str]:
    if COUNT_FROM + len(nodes_of(plan)[0]) + 2 * len(presses) > MOST_COUNT:
        raise InputError(f"the plan has more motions than a 16-bit count holds, {MOST_COUNT}; split it")
    return program_names(plan)


def _jointtarget(values: Array, slides: NDArray[np.bool_]) -> str:
    """Return a joint target of six axes, and perhaps an external one: degrees, mm of those that slide."""
    shown = [f"{value:.5f}" for value in np.where(slides, 1000 * values, np.degrees(values))]
    external = shown[6] if len(shown) > 6 else "9E9"
    return f"[[{','.join(shown[:6])}],[{external},9E9,9E9,9E9,9E9,9E9]]"


def _tooldata(tool: Array, robot: CellRobot) -> str:
    turn = ",".join(f"{value:.7f}" for value in wxyz_of(tool[:3, :3]))
    place = ",".join(f"{1000 * value:.3f}" for value in tool[:3, 3])
    return f"[TRUE,[[{place}],[{turn}]],{rapid_load(tool_load(robot.gripper))}]"


def _ur_joints(values: Array) -> str:
    return "[" + ", ".join(f"{value:.6f}" for value in values) + "]"


def _ur_pose(pose: Array) -> str:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return "p[" + ", ".join(f"{value:.6f}" for value in (*pose[:3, 3], *turn)) + "]"
