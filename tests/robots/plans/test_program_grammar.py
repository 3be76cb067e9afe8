"""The grammar of exported programs, and names that are words of their languages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from falsework import Assembly
from falsework.errors import InputError
from falsework.robots import Cell, RobotPlan, export_plan
from falsework.robots.exports.controller import program_names
from tests.robots.plans.program_grammar import Rapid, UrScript


def renamed(plan: RobotPlan, cell: Cell, *names: str) -> tuple[RobotPlan, Cell]:
    """The plan and the cell with other names of the arms."""
    from falsework.robots.model.cell import cell_identity
    from falsework.robots.plans.robot_plan import records_of

    robots = (replace(robot, name=name) for robot, name in zip(cell.robots, names, strict=True))
    cell = replace(cell, robots=tuple(robots))
    return replace(plan, robots=records_of(cell), cell_identity=cell_identity(cell)), cell


@pytest.mark.parametrize("assembles", [False, True])
@pytest.mark.parametrize(
    "names", [("left", "right"), ("test", "TO"), ("end", "movej"), ("user", "3 arms, of which this is the first")]
)
def test_programs_follow_the_grammar_whatever_the_arms_are_called(
    robot_plan: RobotPlan, column: Assembly, cell: Cell, tmp_path: Path, assembles: bool, names: tuple[str, str]
) -> None:
    """Every name is declared, no name is a word of the language, and arguments have the types of the instructions."""
    plan, given = renamed(robot_plan.reverse() if assembles else robot_plan, cell, *names)
    moves = [sum(robot == k for _, robot, _ in plan.moves()) for k in range(2)]
    for k, path in enumerate(export_plan(plan, tmp_path / "rapid", "rapid", cell=given, structure=column)):
        module = Rapid(path.read_text())
        assert {"MoveAbsJ", "SetDO", "GripLoad"} <= module.called
        assert path.read_text().count(", fine,") == moves[k] + 1
    for path in export_plan(plan, tmp_path / "ur", "urscript", cell=given, structure=column, force=True):
        assert UrScript(path.read_text()).own


@pytest.mark.parametrize("rate", [7.0, 50.0, 333.0, 500.0])
def test_positions_come_in_whole_cycles_of_the_controller(
    robot_plan: RobotPlan, cell: Cell, tmp_path: Path, rate: float
) -> None:
    """At about the wanted rate; a motion takes no less than in the plan, and no more than one position longer."""
    paths = export_plan(robot_plan, tmp_path, "urscript", rate=rate, cell=cell, force=True)
    for robot, path in enumerate(paths):
        text = path.read_text()
        UrScript(text)
        mine = [trajectory for _, which, trajectory in robot_plan.moves() if which == robot]
        parts = text.split("  stopj(10)")[:-1]
        for trajectory, part in zip(mine, parts, strict=True):
            pauses = [float(line.split("t=")[1].split(",")[0]) for line in part.splitlines() if "servoj" in line]
            assert len(set(pauses)) == 1
            assert pauses[0] == pytest.approx(1 / rate, abs=0.001)
            assert trajectory.seconds - 1e-9 <= sum(pauses) < trajectory.seconds + pauses[0] + 1e-9


def test_a_rate_above_that_of_the_controller(robot_plan: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="UR controllers take 500 positions per second at most; give a rate up to"):
        export_plan(robot_plan, tmp_path, "urscript", rate=501, cell=cell, force=True)
    assert not list(tmp_path.glob("*.script"))


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ("MODULE left_arm", "MODULE TEST"),
        ("MODULE left_arm", "MODULE 1_arm"),
        ("ENDMODULE", ""),
        ("fine, left_tool;", "fine left_tool;"),
        ("fine, left_tool;", "fine, right_tool;"),
        (", v1000\\T:=", ", v1000\\V:="),
        (", z0,", ", z7,"),
        ("WaitTime\\InPos, ", "WaitTime\\InPos "),
        ("IF closed THEN", "IF closed"),
        ("  ENDPROC", ""),
        ("=1 OR ", "=>1 OR "),
        ("],[9E9,", "],[9E9,9E9,"),
    ],
)
def test_the_grammar_of_rapid_refuses(robot_plan: RobotPlan, cell: Cell, tmp_path: Path, good: str, bad: str) -> None:
    """What the controller would refuse; the check of programs is one that can fail."""
    plan, given = renamed(robot_plan, cell, "left", "right")
    text = export_plan(plan, tmp_path, "rapid", cell=given)[0].read_text()
    Rapid(text)
    assert good in text
    with pytest.raises((AssertionError, KeyError, ValueError)):
        Rapid(text.replace(good, bad))


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ("def left_arm():", "def end():"),
        ("def left_arm():", "def movej():"),
        ("  sync()\n  end", "  sync()"),
        (", lookahead_time=0.1", ", lookahead=0.1"),
        (", t=0.020", ", t=0.0195"),
        ("stopj(10)", "stopj()"),
        ("movej([", "movej([0, "),
        ("a=0.5, v=0.5", "a=5e-1, v=0.5"),
        ("gripper(True)", "gripper(true)"),
        ("while not (", "while not "),
    ],
)
def test_the_grammar_of_urscript_refuses(
    robot_plan: RobotPlan, cell: Cell, tmp_path: Path, good: str, bad: str
) -> None:
    plan, given = renamed(robot_plan, cell, "left", "right")
    text = export_plan(plan, tmp_path, "urscript", cell=given, force=True)[0].read_text()
    UrScript(text)
    assert good in text
    with pytest.raises(AssertionError):
        UrScript(text.replace(good, bad))


def test_names_stay_distinct(robot_plan: RobotPlan, cell: Cell) -> None:
    """Also where they differ in case only, or in characters that programs do not have."""
    for names in (("Left", "left"), ("a b", "a-b"), ("an arm with a long name 1", "an arm with a long name 2")):
        found = program_names(renamed(robot_plan, cell, *names)[0])
        assert len({name.lower() for name in found}) == 2
        assert max(map(len, found)) <= 16
