"""Programs for robot controllers, ABB RAPID and URScript, that keep the order of a robot plan across robots.

Controllers share the counts of `commands_of` by their own means: RAPID by group signals, URScript by the Modbus
registers of each controller.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.robots.plans.commands import COUNT_FROM, Begin, Grip, Pressing, PublishCount, Wait, commands_of
from falsework.robots.plans.presses import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import nodes_of
from falsework.stability.holds import HoldMode

Array = NDArray[np.float64]

MOST_COUNT = 65535
"""Largest 16-bit count."""
REGISTER = 128
"""First general-purpose Modbus register of a UR controller."""
_UR_LIMITS = (0.005, 0.005, 0.01, 0.05, 0.05, 0.05)
"""Largest deviation across a press, m and rad, and largest speed along it, m/s, in force mode."""


def rapid_modules(plan: RobotPlan, presses: Sequence[TimedPress] = ()) -> Iterator[tuple[str, str]]:
    """Yield file names and RAPID modules, one for each arm.

    Knots become joint targets in degrees for `MoveAbsJ` with the durations of the plan. An arm sets the
    group output `go_NAME_count`, and reads those of others as `gi_NAME_count`. An arm that presses moves its set point
    by force and moment over its stiffness, on a slow line from where it holds the part, and stays there.

    Raises:
        InputError: an arm with another number of joints than 6 or 7, or too many motions for 16 bits.
    """
    names = _names(plan, presses)
    for robot, name in enumerate(names):
        record = plan.robots[robot]
        if len(record.joint_names) not in (6, 7):
            raise InputError(f"RAPID supports robots of 6 or 7 joints; {record.name} has {len(record.joint_names)}")
        about = f"{_ascii(plan.plan.name)}: {plan.direction.value} with {_ascii(record.model)}, {len(plan)} steps"
        targets: list[str] = []
        offset = np.zeros(6)  # of what the arm has pressed since it last moved
        body: list[str] = []
        run = [f"    MoveAbsJ {_jointtarget(plan.keyframes[0].configurations[robot])}, v200, fine, {name}_tool;"]
        others = [other for other in names if other != name]
        if others:
            run += [f"    SetGO go_{name}_count, 1;"]
            run += [f"    WaitUntil GInput(gi_{other}_count)=1 OR GInput(gi_{other}_count)=2;" for other in others]
            run += [f"    SetGO go_{name}_count, 2;"]
            run += [f"    WaitUntil GInput(gi_{other}_count)<>1;" for other in others]
            run += [f"    SetGO go_{name}_count, {COUNT_FROM};"]
        for command in commands_of(plan, robot, presses):
            if isinstance(command, Begin):
                if body:
                    body.append("  ENDPROC")
                body += [f"  PROC {name}_step{command.step + 1}()", f"    ! {_ascii(plan.does(command.step))}"]
                run.append(f"    {name}_step{command.step + 1};")
            elif isinstance(command, Wait):
                body.append(f"    WaitUntil GInput(gi_{names[command.robot]}_count)>={command.count};")
            elif isinstance(command, PublishCount):
                body.append(f"    SetGO go_{name}_count, {command.count};")
            elif isinstance(command, Grip):
                body.append(f"    {name}_gripper {'TRUE' if command.close else 'FALSE'};")
            elif isinstance(command, Pressing):
                body.append(f"    ! {_press_in_words(plan, command)}")
                if command.begins:
                    offset = offset + command.press.offset
                    target = f"{name}_p{len(targets) + 1}"
                    held = plan.keyframes[command.press.step].configurations[robot]
                    targets.append(f"  CONST jointtarget {target} := {_jointtarget(held)};")
                    place = f"RelTool(CalcRobT({target}, {name}_tool), {_shift(offset)})"
                    body += [f"    MoveL {place}, v5, fine, {name}_tool;", "    WaitTime\\InPos, 0.5;"]
            else:
                offset = np.zeros(6)
                last = len(command.times) - 1
                for knot in range(1, last + 1):
                    target = f"{name}_j{len(targets) + 1}"
                    targets.append(f"  CONST jointtarget {target} := {_jointtarget(command.positions[knot])};")
                    seconds = max(command.times[knot] - command.times[knot - 1], 0.001)
                    zone = "fine" if knot == last else "z0"
                    body.append(f"    MoveAbsJ {target}, v1000\\T:={seconds:.3f}, {zone}, {name}_tool;")
        yield (
            f"{name}.mod",
            "\n".join(
                [
                    f"MODULE {name}",
                    f"  ! {about}",
                    f"  PERS tooldata {name}_tool := {_tooldata(record.tool)};",
                    *targets,
                    f"  PROC {name}_gripper(bool closed)",
                    "    IF closed THEN",
                    f"      SetDO do_{name}_grip, 1;",
                    "    ELSE",
                    f"      SetDO do_{name}_grip, 0;",
                    "    ENDIF",
                    "    WaitTime\\InPos, 0.5;",
                    "  ENDPROC",
                    *body,
                    *(["  ENDPROC"] if body else []),
                    f"  PROC {name}_run()",
                    *run,
                    "  ENDPROC",
                    "ENDMODULE",
                    "",
                ]
            ),
        )


def ur_scripts(plan: RobotPlan, rate: float, presses: Sequence[TimedPress] = ()) -> Iterator[tuple[str, str]]:
    """Yield file names and URScript programs, one for each arm.

    Motions are positions at a fixed rate for `servoj`, with a `movej` to the last of each. An arm writes its count to
    register 128 of its controller; others read it there over Modbus TCP, at the address in the first lines. An arm that
    presses controls the force along its direction, from what the sensor measures before on, and keeps its position
    across it; moments are not commanded.

    Args:
        plan: the robot plan.
        rate: positions per second.
        presses: of the plan.

    Raises:
        InputError: an arm with another number of joints than 6, or too many motions for 16 bits.
    """
    names = _names(plan, presses)
    for robot, name in enumerate(names):
        record = plan.robots[robot]
        if len(record.joint_names) != 6:
            raise InputError(f"URScript supports robots of 6 joints; {record.name} has {len(record.joint_names)}")
        others = [other for other in names if other != name]
        lines = [
            f"def {name}():",
            f"  # {_ascii(plan.plan.name)}: {plan.direction.value} with {_ascii(record.model)}, {len(plan)} steps",
        ]
        for other in others:
            lines += [
                f'  modbus_add_signal("{other}.local", 255, {REGISTER}, 2, "{other}_count", False)',
                f'  modbus_set_signal_update_frequency("{other}_count", 50)',
                f"  def {other}_count():",
                f'    return modbus_get_signal_status("{other}_count", False)',
                "  end",
            ]
        lines += [
            "  def gripper(closed):",
            "    set_standard_digital_out(0, closed)",
            "    sleep(0.5)",
            "  end",
            f"  set_tcp({_ur_pose(record.tool)})",
            f"  movej({_ur_joints(plan.keyframes[0].configurations[robot])}, a=0.5, v=0.5)",
        ]
        if others:
            lines.append(f"  write_port_register({REGISTER}, 1)")
            lines += [line for other in others for line in _until(f"{other}_count() == 1 or {other}_count() == 2")]
            lines.append(f"  write_port_register({REGISTER}, 2)")
            lines += [line for other in others for line in _until(f"{other}_count() != 1")]
            lines.append(f"  write_port_register({REGISTER}, {COUNT_FROM})")
        for command in commands_of(plan, robot, presses):
            if isinstance(command, Begin):
                lines.append(f"  # step {command.step + 1}: {_ascii(plan.does(command.step))}")
            elif isinstance(command, Wait):
                lines += _until(f"{names[command.robot]}_count() >= {command.count}")
            elif isinstance(command, PublishCount):
                lines.append(f"  write_port_register({REGISTER}, {command.count})")
            elif isinstance(command, Grip):
                lines.append(f"  gripper({'True' if command.close else 'False'})")
            elif isinstance(command, Pressing):
                lines.append(f"  # {_press_in_words(plan, command)}")
                lines += _ur_press(command.press) if command.begins else ["  end_force_mode()"]
            else:
                count = max(int(np.ceil(command.seconds * rate)), 1)
                step = command.seconds / count
                for values in command.sample(np.linspace(step, command.seconds, count)):
                    lines.append(f"  servoj({_ur_joints(values)}, t={step:.6f}, lookahead_time=0.1, gain=300)")
                lines.append("  stopj(10)")
                lines.append(f"  movej({_ur_joints(command.positions[-1])}, a=0.5, v=0.5)")
        yield f"{name}.script", "\n".join([*lines, "end", ""])


def _press_in_words(plan: RobotPlan, command: Pressing) -> str:
    press, part = command.press, _ascii(plan.plan.part_names[command.press.part])
    if not command.begins:
        return f"stay where the press of {part} has ended"
    force = ", ".join(f"{value:.1f}" for value in press.wrench[:3])
    along = " along it" if press.mode is HoldMode.HYBRID else ""
    return f"press {part} with {press.force:.1f} N, ({force}) N in the cell, at {press.stiffness:.4g} N/m{along}"


def _shift(offset: Array) -> str:
    """Return a displacement along and about the axes of a tool, m and rad, as arguments of `RelTool`."""
    turn = "".join(f"\\R{axis}:={value:.5f}" for axis, value in zip("xyz", np.degrees(offset[3:]), strict=True))
    return ", ".join(f"{1000 * value:.4f}" for value in offset[:3]) + turn


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
    return _distinct([_identifier(robot.name) for robot in plan.robots])


def _jointtarget(values: Array) -> str:
    degrees = np.degrees(values)
    robax = ",".join(f"{value:.5f}" for value in degrees[:6])
    seventh = f"{degrees[6]:.5f}" if len(degrees) > 6 else "9E9"
    return f"[[{robax}],[{seventh},9E9,9E9,9E9,9E9,9E9]]"


def _tooldata(tool: Array) -> str:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(tool[:3, :3]).as_quat()
    turn = ",".join(f"{value:.7f}" for value in (w, x, y, z))
    place = ",".join(f"{1000 * value:.3f}" for value in tool[:3, 3])
    return f"[TRUE,[[{place}],[{turn}]],[1,[0,0,50],[1,0,0,0],0,0,0]]"


def _ur_joints(values: Array) -> str:
    return "[" + ", ".join(f"{value:.6f}" for value in values) + "]"


def _ur_pose(pose: Array) -> str:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return "p[" + ", ".join(f"{value:.6f}" for value in (*pose[:3, 3], *turn)) + "]"


def _identifier(text: str) -> str:
    """Return a name for both languages: letters, digits and underscores, a letter first, short enough for suffixes."""
    made = re.sub(r"\W", "_", text, flags=re.ASCII)
    return (made if made[:1].isalpha() else f"r{made}")[:16]


def _distinct(names: list[str]) -> list[str]:
    """Return distinct names: RAPID names are case-insensitive."""
    found: list[str] = []
    for name in names:
        chosen, number = name, 2
        while chosen.lower() in (entry.lower() for entry in found):
            chosen, number = f"{name[:13]}_{number}", number + 1
        found.append(chosen)
    return found


def _ascii(text: str) -> str:
    return re.sub(r"[^ -~]", "?", text)
