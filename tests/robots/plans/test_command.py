"""`falsework robots`: from the command line to files and back, and rejected input."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import load_cell, load_structure, plan_robots
from falsework.assembly import HELD
from falsework.assembly.groups import join_parts
from falsework.cli.main import main
from falsework.cli.robot_reports import schedule_text
from falsework.robots import cells, interruption
from falsework.robots.plans.robot_plan import acts
from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan
from falsework.robots.plans.timeline import event_times, schedule_of
from falsework.search.plans.steps import NO_ROBOT
from falsework.utils.quantity import format_quantity
from falsework.viewer.viewable import viewable_of
from tests.robots.cells.cell_texts import REACHING as CELL

STACK = "stack:blocks=2,length=0.3,height=0.15,depth=0.3"


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> Callable[..., tuple[int, dict[str, Any], str]]:
    def call(*arguments: object) -> tuple[int, dict[str, Any], str]:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return int(code), read_answer(captured.out) if "--json" in arguments else {}, captured.err

    return call


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


def test_plan_check_export(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "plans" / "robot_plan.json"
    out.parent.mkdir()
    code, answer, error = run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--json")
    assert code == 0, error
    assert answer["outcome"] == "found"
    assert answer["steps"] == 4
    plan = load_robot_plan(out)
    assert plan.cell_source == "../cell.toml"
    assert plan.plan.source == {"built_in": STACK}
    code, answer, error = run("robots", "check", out, "--json")
    assert code == 0, error
    assert answer["outcome"] in ("verified", "conditional")
    assert answer["stable"]
    assert answer["problems"] == []
    assert answer["links"] == {"arm": "convex pieces"}
    assert answer["checked"]["structure_identity"] == plan.plan.identity
    assert answer["checked"]["cell_identity"] == plan.cell_identity
    assert answer["checked"]["robots"] == ["arm"]
    assert [answer["checked"][key] for key in ("steps", "start", "end")] == [4, "002", "112"]
    assert answer["checked"]["not_at_home"] == ["arm"]
    stiff, replayed = answer["unverified"]
    assert stiff == "that robots hold parts rigidly, in units of the structure"
    assert replayed == "that a replay of the plan succeeds"
    code, answer, error = run("robots", "check", out, "--json", "--motions-only")
    assert code == 0
    assert len(answer["unverified"]) == 3
    assert "the stability of the states" in answer["unverified"][0]
    for form, name in (("ros2-json", "plan.json"), ("csv", "plan.csv"), ("rapid", "arm.mod")):
        folder = tmp_path / form
        code, _, error = run("robots", "export", out, "--format", form, "--out", folder)
        assert code == 0, error
        assert (folder / name).is_file()
        assert "exists" not in error
        code, _, error = run("robots", "export", out, "--format", form, "--out", folder)
        words = (
            f"{folder} exists with files: those of the same names are replaced, the others stay; --out names another"
        )
        assert words in error


@pytest.mark.parametrize("command", [("check",), ("export", "--format", "rapid", "--out", "programs")])
def test_a_plan_for_other_robots_is_refused(
    run: Callable, cell_file: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """By the check and before a program is written."""
    out = tmp_path / "robot_plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--criterion", "equilibrium")[0] == 0
    data = json.loads(out.read_text())
    data["cell"]["robots"][0]["joints"].reverse()
    out.write_text(json.dumps(data))
    given = [tmp_path / word if word == "programs" else word for word in command[1:]]
    code, _, error = run("robots", command[0], out, *given)
    assert code == 2
    assert "as the joint names of robot 0" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "programs").exists()


@pytest.mark.parametrize("factor", [1e6, 1e-9])
def test_small_files_do_not_take_much_memory(run: Callable, cell_file: Path, tmp_path: Path, factor: float) -> None:
    """A motion of days, or of joints that turn a million times, is refused before it is sampled."""
    out = tmp_path / "robot_plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--criterion", "equilibrium")[0] == 0
    data = json.loads(out.read_text())
    for trajectory in data["steps"][0]["trajectories"]:
        trajectory["times"] = [moment * factor for moment in trajectory["times"]]
        trajectory["velocities"] = [[value / factor for value in row] for row in trajectory["velocities"]]
    if factor < 1:
        data["steps"][0]["trajectories"][0]["positions"][3][0] = 1e7
    out.write_text(json.dumps(data))
    tracemalloc.start()
    try:
        code, answer, error = run("robots", "check", out, "--json", "--motions-only")
        assert code == 1
        assert answer["samples"] == 0
        assert "a motion takes" in error if factor > 1 else "is outside its limits" in error
        code, _, error = run("robots", "export", out, "--format", "csv", "--out", tmp_path / "tables")
        assert code == 2
        assert "cannot be exported" in error
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_a_bag_says_what_it_lacks(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="bags need mcap; pip install 'falsework[schedule]'")
    out = tmp_path / "plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--criterion", "equilibrium")[0] == 0
    export = ("robots", "export", out, "--format", "mcap", "--out", tmp_path / "bag")
    code, _, error = run(*export)
    assert (code, error) == (0, "")
    full = (tmp_path / "bag" / "plan.mcap").stat().st_size
    cell_file.rename(tmp_path / "moved.toml")
    code, _, error = run(*export)
    assert (code, error.count("\n")) == (2, 1)  # nothing is written for robots that nobody knows
    code, _, error = run(*export, "--cell", tmp_path / "moved.toml")
    assert (code, error.count("\n")) == (0, 1)
    assert "bag exists with files" in error
    assert (tmp_path / "bag" / "plan.mcap").stat().st_size == full
    data = json.loads(out.read_text())
    data["plan"]["structure"]["source"] = {"path": "gone"}
    (tmp_path / "bare.json").write_text(json.dumps(data))
    bare = ("robots", "export", tmp_path / "bare.json", "--cell", tmp_path / "moved.toml", *export[3:])
    code, _, error = run(*bare)
    assert code == 0, error
    assert "falsework: the bag has no shapes of parts: " in error
    assert (tmp_path / "bag" / "plan.mcap").stat().st_size < full
    code, _, error = run(*export, "--cell", tmp_path / "moved.toml", "--structure", "stack:blocks=3")
    assert code == 2
    assert error.count("\n") == 1


def test_arms_may_hold_again(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "robot_plan.json"
    arguments = ("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--allow-regrasp", "--json")
    code, answer, error = run(*arguments)
    assert code == 0, error
    assert answer["releases"] == 0  # not needed here
    assert answer["steps"] == 4
    code, _, error = run(*arguments, "--missing", "1")
    assert code == 2
    assert error.strip() == ("falsework: plans with repeated holds take no missing parts; leave out one of the two")


def test_a_bad_plan_is_exit_code_one(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "robot_plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out)[0] == 0
    data = json.loads(out.read_text())
    for trajectory in data["steps"][0]["trajectories"]:
        trajectory["times"] = [moment / 3 for moment in trajectory["times"]]
        trajectory["velocities"] = [[3 * value for value in row] for row in trajectory["velocities"]]
    out.write_text(json.dumps(data))
    code, answer, error = run("robots", "check", out, "--json", "--motions-only")
    assert code == 1
    assert answer["outcome"] == "refuted"
    assert "the acceleration of joint_" in error


def test_the_criterion_of_states_is_that_of_the_caller(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """As `falsework check` has it: a plan that claims less is refused, with the option that accepts it."""
    out = tmp_path / "robot_plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--criterion", "equilibrium")[0] == 0
    code, answer, error = run("robots", "check", out, "--json")
    assert (code, answer["stable"]) == (1, False)
    assert "the plan claims equilibrium only; plan again, or check it with --criterion equilibrium" in error
    code, answer, _ = run("robots", "check", out, "--json", "--criterion", "equilibrium")
    assert (code, answer["stable"], answer["claim"]["criterion"]) == (0, True, "equilibrium")
    data = json.loads(out.read_text())
    data["plan"]["stability"]["gravity"] = 1.62
    out.write_text(json.dumps(data))
    code, _, error = run("robots", "check", out, "--criterion", "equilibrium")
    assert (code, "the plan is for a gravity of 1.62 m/s2; 9.81 is asked" in error) == (1, True)
    assert run("robots", "check", out, "--criterion", "equilibrium", "--gravity", 1.62)[0] == 0
    code, _, error = run("robots", "check", out, "--motions-only", "--gravity", 1.62)
    assert (code, "--motions-only checks no states" in error) == (2, True)
    code, _, error = run("robots", "check", out, "--gravity", "nan")
    assert (code, "gravity" in error) == (2, True)


def test_joined_parts_have_to_stand_loose(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """Blocks that only touch are one part for the arm; it carries the lower one by the upper one."""
    structure, out = load_structure(STACK), tmp_path / "robot_plan.json"
    groups = [[structure.names[1], structure.names[0]]]
    found = plan_robots(join_parts(structure, groups), load_cell(cell_file)).value
    assert found is not None
    plan = replace(found.plan, source={"built_in": STACK, "groups": groups})
    save_robot_plan(replace(found, plan=plan), out)
    code, answer, error = run("robots", "check", out, "--cell", cell_file, "--json")
    assert (code, answer["stable"], answer["problems"]) == (1, False, [])
    assert "do not leave together" in error


@pytest.mark.parametrize("entry", ["positions", "velocities"])
def test_numbers_that_overflow_are_reported(run: Callable, cell_file: Path, tmp_path: Path, entry: str) -> None:
    out = tmp_path / "robot_plan.json"
    assert run("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--sequential")[0] == 0
    data = json.loads(out.read_text())
    data["steps"][0]["trajectories"][0][entry][1] = [1e308] * 6
    out.write_text(json.dumps(data))
    code, answer, error = run("robots", "check", out, "--json", "--motions-only")
    assert code == 1
    assert answer["outcome"] == "refuted"
    assert answer["acceleration_share"] is None
    assert "unexpected" not in error


def test_options_of_the_structure_count_only_with_the_callers_word(
    run: Callable, cell_file: Path, tmp_path: Path
) -> None:
    """As in `falsework check`: a robot plan must not say how rough, loaded or supported its structure is."""
    out = tmp_path / "robot_plan.json"
    options = ("--density", 200, "--friction", 0.9, "--load", "block-1=0,0,5")
    assert run("robots", "plan", STACK, *options, "--cell", cell_file, "--out", out)[0] == 0
    code, answer, error = run("robots", "check", out, "--json")
    assert code == 3
    assert answer["outcome"] in ("verified", "conditional")
    loads = [{"part": "block-1", "force": [0.0, 0.0, 5.0]}]
    assert answer["overrides"] == {"density": 200.0, "friction": 0.9, "loads": loads}
    shown = "--density 200.0 --friction 0.9 --load block-1=0.0,0.0,5.0"
    assert f"good only with options of the structure that the plan sets itself: {shown}; give them too" in error
    for more in (options, ("--accept-overrides",)):
        assert run("robots", "check", out, "--motions-only", *more)[0] == 0


def test_no_plan_says_why(run: Callable, tmp_path: Path) -> None:
    far = tmp_path / "far.toml"
    far.write_text(CELL.replace("-1.15", "-4.0"))
    code, answer, error = run("robots", "plan", STACK, "--cell", far, "--out", tmp_path / "plan.json", "--json")
    assert code == 1
    assert answer["outcome"] == "not_found"
    assert answer["failure"]["unreachable"] == [0, 1]
    assert error.startswith(
        "falsework: no robot plan was found; the search reached step 0 of 4; no robot can hold block-0"
    )


def test_wrong_input_is_one_line(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    cases = (
        (("plan", STACK, "--cell", tmp_path / "none.toml"), "none.toml"),
        (("plan", STACK, "--cell", cell_file, "--deadline", "0"), "leaves no time"),
        (("plan", STACK, "--cell", cell_file, "--out", tmp_path / "no" / "plan.json"), "make it first"),
        (("check", tmp_path / "none.json"), "there is no robot plan file"),
        (("export", tmp_path / "none.json", "--out", tmp_path / "x"), "there is no robot plan file"),
    )
    for arguments, message in cases:
        code, _, error = run("robots", *arguments)
        assert code == 2
        assert message in error
        assert error.count("\n") == 1


def test_motions_at_the_same_time(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    second = CELL[CELL.index("[[robots]]") :].replace('"arm"', '"other"')
    second = second.replace("[-1.15, 0.0, 0.0], yaw = 0.0", "[1.15, 0.0, 0.0], yaw = 180.0")
    cell_file.write_text(CELL + second)
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--criterion", "equilibrium")
    code, answer, _ = run(*wanted, "--out", tmp_path / "plan.json", "--json")
    assert code == 0
    times = answer
    assert 0 < times["lower_bound_s"] <= times["makespan_s"] <= times["sequential_s"] + 1e-3
    assert times["gap"] == pytest.approx(1 - times["lower_bound_s"] / times["makespan_s"], abs=1e-3)
    assert {entry["robot"] for entry in times["arms"]} == {"arm", "other"}
    assert load_robot_plan(tmp_path / "plan.json").makespan == pytest.approx(times["makespan_s"], abs=1e-3)
    check = ("robots", "check", tmp_path / "plan.json", "--motions-only")
    code, answer, _ = run(*check, "--delays", "20", "--max-delay", "0.5", "--json")
    assert code == 0
    assert answer["delays"]["overlaps"] > 0
    runs = answer["delayed_runs"]
    assert runs["runs"] == 20
    assert runs["out_of_order"] == runs["outside"] == 0
    assert times["makespan_s"] < runs["makespan_s"]["least"] <= runs["makespan_s"]["most"] < 1.5 * times["makespan_s"]
    for given, message in (
        (("--delays", "0"), "cannot simulate 0 runs"),
        (("--delays", "-5"), "cannot simulate -5 runs"),
        (("--delays", "nan"), "--delays is 'nan'; give a whole number"),
        (("--delays", "5", "--max-delay", "nan"), "delays of up to nan"),
        (("--delays", "5", "--max-delay=-0.1"), "delays of up to -0.1"),
        (("--max-delay", "0.5"), "give their number too"),
    ):
        code, _, error = run(*check, *given)
        assert code == 2
        assert message in error
        assert error.count("\n") == 1
    code, answer, _ = run(*wanted, "--out", tmp_path / "one.json", "--sequential", "--json")
    assert code == 0
    assert answer["makespan_s"] == answer["sequential_s"]
    assert answer["lower_bound_s"] is answer["gap"] is None
    assert sum(entry["moves"] for entry in answer["arms"]) == pytest.approx(1.0, abs=1e-3)  # one at a time
    code, _, error = run("robots", "check", tmp_path / "one.json", "--delays", "5")
    assert code == 2
    assert error == "falsework: the robot plan has no schedule to simulate; plan again, or schedule it\n"


def test_arms_that_can_never_pass_each_other_move_one_by_one(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """Two arms side by side, so near that neither can move to the stack while the other one does."""
    pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")
    first = CELL.replace("[-1.15, 0.0, 0.0]", "[-1.15, -0.3, 0.0]")
    second = CELL[CELL.index("[[robots]]") :].replace('"arm"', '"other"').replace("[-1.15, 0.0", "[-1.15, 0.3")
    cell_file.write_text(first + second)
    out = tmp_path / "plan.json"
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--criterion", "equilibrium", "--out", out)
    code, answer, error = run(*wanted, "--json")
    assert code == 0, error
    times = answer
    assert times["makespan_s"] == pytest.approx(times["sequential_s"], abs=0.05)
    assert times["lower_bound_s"] == pytest.approx(times["makespan_s"], abs=1e-3)
    plan = load_robot_plan(out)
    assert schedule_text(plan).startswith("no two motions can take place at the same time: the plan stays sequential")
    assert run("robots", "check", out, "--motions-only", "--delays", "20")[0] == 0


def test_go_on_from_where_the_arms_are(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--criterion", "equilibrium", "--json")
    assert run(*wanted, "--out", tmp_path / "all.json", "--order", "disassembly")[0] == 0
    plan = load_robot_plan(tmp_path / "all.json")
    (row,) = [k for k, frame in enumerate(plan.keyframes) if frame.held[0] is not None][:1]
    (tmp_path / "now.json").write_text(json.dumps({"arm": plan.keyframes[row].configurations[0].tolist()}))
    midway = (
        "--order",
        "disassembly",
        "--state",
        "".join(map(str, plan.states[row])),
        "--joints",
        tmp_path / "now.json",
    )
    held = f"arm={plan.keyframes[row].held[0]}"
    code, _, _ = run(*wanted, "--out", tmp_path / "rest.json", *midway, "--holding", held)
    assert code == 0
    rest = load_robot_plan(tmp_path / "rest.json")
    assert len(rest) == len(plan) - row
    assert rest.keyframes[0].held == plan.keyframes[row].held


def test_go_on_building(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """From where a plan was interrupted: while the arm holds a part in place, and while it carries the next one."""
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--criterion", "equilibrium", "--json")
    assert run(*wanted, "--out", tmp_path / "all.json")[0] == 0
    plan = load_robot_plan(tmp_path / "all.json")
    row = next(k for k, frame in enumerate(plan.keyframes[1:-1], 1) if frame.held[0] is not None)
    step = next(k for k in range(row, len(plan)) if plan.actions[k] >= len(plan.plan.boundary))
    loaded = plan.steps[step].trajectories[0]
    for k, values, part, grips in (
        (row, plan.keyframes[row].configurations[0], plan.keyframes[row].held[0], ()),
        (step, loaded.positions[-1], loaded.part, ("--grips", tmp_path / "all.json")),
    ):
        (tmp_path / "now.json").write_text(json.dumps({"arm": values.tolist()}))
        now = ("--state", "".join(map(str, plan.states[k])), "--joints", tmp_path / "now.json")
        rest = ("--holding", f"arm={part}", *grips, "--out", tmp_path / "rest.json")
        assert run(*wanted, *now, *rest)[0] == 0
        made = load_robot_plan(tmp_path / "rest.json")
        assert len(made) == len(plan) - k
        assert made.states[0].tolist() == plan.states[k].tolist()
        assert made.states[-1].tolist() == plan.states[-1].tolist()
        np.testing.assert_allclose(made.keyframes[0].configurations[0], values)
        assert run("robots", "check", tmp_path / "rest.json", "--motions-only")[0] == 0


def test_a_start_that_is_not_stable_is_named_with_what_moves(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    given = ("--cell", cell_file, "--state", "012", "--out", tmp_path / "plan.json", "--json")
    code, answer, error = run("robots", "plan", STACK, *given)
    assert code == 1
    assert error.startswith("falsework: no plan exists: the start state is unstable; block-1")
    assert answer["moving"]
    assert answer["outcome"] == "impossible"
    code, _, error = run("robots", "plan", STACK, *given, "--order", "disassembly")
    assert code == 1
    assert error.startswith("falsework: no plan exists: the start state is unstable; block-1")


def test_a_target_that_slides_from_rest_is_built(run: Callable, tmp_path: Path) -> None:
    """With all loads at once the target slides; the same stones stand as arms add the last two."""
    place, out = "position = [-1.2055, -0.0755, 0]", tmp_path / "plan.json"
    cell = (Path(cells.__file__).parent / "vault-62-a.toml").read_text()
    assert place in cell
    (tmp_path / "cell.toml").write_text(cell.replace(place, "position = [0, 0, 0]"))
    structure = ("vault:parts=30,span=1,rise=0.25,thickness=0.03,support=0.175", "--friction", 0.45)
    before, after = "0000100011100111111111112222", "0000100011111111111111112222"
    words = ("--state", before, "--target", after, "--reserve", 1, "--sequential", "--out", out)
    code, _, error = run("robots", "plan", *structure, "--cell", tmp_path / "cell.toml", *words)
    assert code == 0, error
    plan = load_robot_plan(out).plan
    assert "".join(map(str, plan.states[-1])) == after
    assert plan.replay is not None
    assert plan.replay.stands
    code, answer, _ = run("stability", *structure, "--states", after, "--json")
    assert code == 1
    assert [state["verdict"] for state in answer["states"]] == ["slides"]


def test_where_nothing_is_left_to_do_there_is_a_plan_without_steps(
    run: Callable, cell_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "plan.json"
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--target", "empty", "--json")
    code, answer, error = run(*wanted)
    assert code == 0, error
    assert answer["outcome"] == "found"
    assert answer["steps"] == 0
    assert answer["makespan_s"] == 0.0
    code, _, error = run("robots", "check", out)
    assert code == 1  # a check that has checked nothing does not say that all is well
    assert "the plan has no steps" in error


@pytest.mark.parametrize("values", [[0, 0, 0, 0, 0, True], [0, 0, 0, 0, 0, "0.1"], {"joint_1": 0}, None])
def test_joint_values_in_a_file_are_numbers(run: Callable, cell_file: Path, tmp_path: Path, values: object) -> None:
    (tmp_path / "now.json").write_text(json.dumps({"arm": values}))
    given = ("--joints", tmp_path / "now.json", "--out", tmp_path / "plan.json")
    code, _, error = run("robots", "plan", STACK, "--cell", cell_file, *given)
    assert code == 2
    assert "give joint values in rad" in error


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--holding", "elbow=0"), "has no robot 'elbow'"),
        (("--holding", "arm"), "names no robot and value"),
        (("--holding", "arm=77"), "no part 77"),
        (("--holding", "arm=0-1"), "a robot holds one part; name one"),
        (("--order", "disassembly", "--holding", "arm=1"), "m away from part block-1, which it should hold"),
        (("--state", "212"), "the robots hold nothing, the start state has part block-0 held"),
        (("--state", "21"), "--state 21: a state of 2 values does not fit 3 parts"),
        (("--state", "002", "--holding", "arm=0"), "carries part block-0, which is not in place"),
        (("--state", "002", "--holding", "arm=0", "--grips", "arm=0,0,0,0,0,0"), "m away from part block-0"),
        (("--state", "002", "--holding", "arm=0", "--grips", "arm=home"), "--grips: arm is 'home'; give joint values"),
        (("--grips", "arm=0,0,0,0,0,0"), "carries no part, so it has no grip"),
        (("--joints", "arm=1,2,x"), "give joint values in rad"),
        (("--joints", "arm=home;arm=0,0,0,0,0,0"), "name each robot once"),
        (("--joints", "arm=9,0,0,0,0,0"), "outside its limits"),
        (("--joints", "arm=0,2.6,0,0,0,0"), "m into each other; move arm away first"),
        (("--joints", "nowhere.json"), "no JSON file"),
    ],
)
def test_starts_that_are_none(
    run: Callable, cell_file: Path, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    code, _, err = run("robots", "plan", STACK, "--cell", cell_file, "--out", tmp_path / "plan.json", *options)
    assert code == 2
    assert message in err
    assert len(err.strip().splitlines()) == 1


def test_a_gripper_that_bears_too_little(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """A plan is made, but planning and the check refuse it; with a stronger gripper both accept it."""
    out = tmp_path / "robot_plan.json"
    plan = ("robots", "plan", STACK, "--cell", cell_file, "--out", out, "--json")
    cell_file.write_text(CELL.replace('kind = "suction"', 'kind = "suction"\nmoment = 0.5'))
    code, answer, error = run(*plan)
    assert code == 1
    assert "takes a moment of" in error
    assert "its gripper bears 0.5 Nm" in error
    assert answer["overloads"]
    code, answer, error = run("robots", "check", out, "--json")
    assert code == 1
    assert answer["outcome"] == "refuted"
    assert "its gripper bears 0.5 Nm" in error
    (borne,) = answer["holds"]
    assert borne["limits"]["moment_nm"] == 0.5 < borne["moment_nm"]
    cell_file.write_text(CELL.replace('kind = "suction"', f'kind = "suction"\nmoment = {1.1 * borne["moment_nm"]}'))
    assert run(*plan)[0] == 0
    code, answer, error = run("robots", "check", out, "--json")
    assert code == 0, error
    assert answer["overloads"] == []


def test_a_gripper_that_bears_less_than_a_part_weighs(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """No plan is searched for: the robot and the part are named, with the weight in the cell."""
    plan = ("robots", "plan", STACK, "--cell", cell_file, "--out", tmp_path / "robot_plan.json")
    weight = 0.5**3 * 200 * 0.3 * 0.3 * 0.15 * 9.81
    for force, expected in ((0.99 * weight, 2), (10 * weight, 0)):
        small = CELL.replace("density = 200", "density = 200\nscale = 0.5\nposition = [-0.3, 0.0, 0.0]")
        cell_file.write_text(small.replace('kind = "suction"', f'kind = "suction"\nforce = {force}'))
        code, _, error = run(*plan)
        assert code == expected, error
        if expected:
            assert f"the gripper of arm bears {force:.4g} N, less than part" in error
            assert f"weighs in one arm, {weight:.4g} N; take a stronger gripper" in error


@pytest.mark.parametrize("limit", ["force = -1.0", 'moment = "2Nm"'])
def test_limits_that_are_none(run: Callable, cell_file: Path, tmp_path: Path, limit: str) -> None:
    cell_file.write_text(CELL.replace('kind = "suction"', f'kind = "suction"\n{limit}'))
    code, _, error = run("robots", "plan", STACK, "--cell", cell_file, "--out", tmp_path / "robot_plan.json")
    assert code == 2
    assert f"grippers.cup.{limit.split()[0]} is" in error


def test_go_on_from_an_interruption(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """Structure, cell, state, arms and what they carry come from the plan, at any time of it."""
    first = tmp_path / "first" / "all.json"
    first.parent.mkdir()
    wanted = ("robots", "plan", STACK, "--cell", cell_file, "--criterion", "equilibrium", "--out", first)
    assert run(*wanted, "--sequential")[0] == 0
    plan, rest = load_robot_plan(first), tmp_path / "rest.json"
    for share in (0.1, 0.45, 0.8):
        now = interruption(plan, share * plan.makespan)
        words = ("robots", "plan", "--from", first, "--at", f"{share * plan.makespan:.3f}s", "--sequential", "--json")
        code, answer, error = run(*words, "--out", rest)
        assert code == 0, error
        made = load_robot_plan(rest)
        assert answer["files"] == [str(rest)]
        assert made.plan.claim.criterion == "equilibrium"
        np.testing.assert_array_equal(made.states[0], now.state)
        np.testing.assert_array_equal(made.states[-1], plan.states[-1])
        np.testing.assert_allclose(made.keyframes[0].configurations[0], now.configurations[0], atol=1e-9)
        assert [str(one) for one in made.plan.steps[: now.done]] == [str(one) for one in plan.plan.steps[: now.done]]
        assert [made.number(step) for step in range(len(made)) if acts(made.steps[step])] == list(
            range(now.done + 1, len(plan.plan) + 1)
        )
        code, _, error = run("robots", "check", rest, "--motions-only")  # finds structure and cell from where it lies
        assert code == 0, error


def test_what_robots_can_do_and_the_reserve_go_on(run: Callable, cell_file: Path, tmp_path: Path) -> None:
    """As in `falsework replan`; options given take their place. The cell makes parts so light that 100 N suffice."""
    small = CELL.replace("density = 200", "density = 200\nscale = 0.5\nposition = [-0.3, 0.0, 0.0]")
    cell_file.write_text(small)
    first, rest = tmp_path / "first.json", tmp_path / "rest.json"
    weak = ("--hold-stiffness", 1e6, "--hold-force", "100N", "--reserve", 1.2)
    assert run("robots", "plan", STACK, "--cell", cell_file, *weak, "--out", first)[0] == 0
    plan = load_robot_plan(first).plan
    begun = ("robots", "plan", "--from", first, "--at", "1s", "--out", rest)
    assert run(*begun)[0] == 0
    claim = load_robot_plan(rest).plan.claim
    assert claim.reserve == plan.claim.reserve == 1.2
    for name in ("stiffness", "force", "moment"):
        assert getattr(claim.holds, name) == pytest.approx(getattr(plan.claim.holds, name))
    assert run(*begun, "--reserve", 1.1)[0] == 0
    assert load_robot_plan(rest).plan.claim.reserve == 1.1


@pytest.mark.parametrize("order", ["assembly", "disassembly"])
def test_steps_count_on_from_those_that_are_done(run: Callable, cell_file: Path, tmp_path: Path, order: str) -> None:
    """Of a plan that goes on, too; each step that is done has its robot, and places in the plan have their times."""
    plan, files = ("robots", "plan"), [tmp_path / f"{name}.json" for name in ("first", "second", "third")]
    assert run(*plan, STACK, "--cell", cell_file, "--order", order, "--sequential", "--out", files[0])[0] == 0
    first = load_robot_plan(files[0])
    for old, new in pairwise(files):
        middle = 0.4 * load_robot_plan(old).makespan
        code, _, error = run(*plan, "--from", old, "--at", f"{middle:.2f}s", "--order", order, "--out", new)
        assert code == 0, error
        made = load_robot_plan(new)
        done = len(made.done_by)
        assert len(made.plan) == len(first.plan)
        steps = [
            [(step.number, step.words) for step in one.plan.in_order(made.direction)[:done]] for one in (made, first)
        ]
        assert steps[0] == steps[1]
        assert made.reverse().reverse().rows.tolist() == made.rows.tolist()
        shown = viewable_of(new)
        assert shown.arms is not None
        assert (shown.timeline.states == made.plan.states).all()
        held = (shown.timeline.states == HELD) & ~made.plan.boundary
        np.testing.assert_array_equal(shown.arms.holders() != NO_ROBOT, held)
        for place in range(len(made.plan) + 1):
            assert len(shown.arms.at(float(place)).poses) == len(shown.arms.links)
        assert run("robots", "check", new)[0] == 0
    assert len(load_robot_plan(files[2]).done_by) >= len(load_robot_plan(files[1]).done_by) > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "name the time of the interruption by --at"),
        (("--at", "7.2"), "--at: '7.2' has no unit; give 2s or 2min"),
        (("--at", "1000s"), "; give an earlier time"),
        (("--at", "2s", "--joints", "arm=home"), "leave out --joints"),
        (("--at", "2s", "--state", "empty", "--holding", "arm=0"), "leave out --state and --holding"),
        (("--at", "0.5s", "--missing", "block-0"), "part block-0 is said to be missing, yet it is in the gripper"),
        (("--at", "2s", "--missing", "0"), "part block-0 is said to be missing, yet it is in place"),
        (("--at", "2s", "--order", "disassembly"), "is a plan of assembly; go on in that order"),
        (("STRUCTURE", "--at", "2s"), "the robot plan is for another"),
        (("NO PLAN", "--at", "2s"), "there is no robot plan file"),
        (("NO FROM", "--at", "2s"), "--at 2s is a time of a robot plan; name that by --from"),
        (("NO FROM",), "missing from falsework robots plan: STRUCTURE, --cell; or go on by --from and --at"),
    ],
)
def test_an_interruption_that_is_none(
    options: tuple[str, ...], message: str, interrupted: Path, run: Callable, tmp_path: Path
) -> None:
    words: list[object] = ["robots", "plan", "--out", tmp_path / "rest.json"]
    words += [] if "NO FROM" in options else ["--from", tmp_path / "no.json" if "NO PLAN" in options else interrupted]
    words += ["stack:blocks=3" if word == "STRUCTURE" else word for word in options if not word.startswith("NO ")]
    code, _, error = run(*words)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "rest.json").exists()


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot plan, with its cell beside it."""
    folder = tmp_path_factory.mktemp("interrupted")
    (folder / "cell.toml").write_text(CELL)
    words = ["robots", "plan", STACK, "--cell", folder / "cell.toml", "--criterion", "equilibrium", "--sequential"]
    assert main([*map(str, words), "--out", str(folder / "plan.json")]) == 0
    return folder / "plan.json"


def test_what_is_said_of_a_plan_that_goes_on_is_that_of_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its steps come after those that are done, with which robots press otherwise than from rest."""
    arch, cell, first, rest = "arch:radius=0.3,blocks=5", *(tmp_path / name for name in ("c.toml", "a.json", "b.json"))
    drawn = ("cell", "new", "left=ur10e,right=ur10e", "--structure", arch, "--density", "100", "--out", str(cell))
    assert main([*drawn]) == 0
    cell.write_text(cell.read_text().replace("# force = 60.0", "force = 14.0"))
    assert main(["robots", "plan", arch, "--density", "100", "--cell", str(cell), "--out", str(first)]) == 0
    plan = load_robot_plan(first)
    (step,) = (k for k in range(len(plan)) if "presses" in plan.does(k))
    before = float(event_times(plan, schedule_of(plan))[step - 1]) - 0.1
    capsys.readouterr()
    assert main(["robots", "plan", "--from", str(first), "--at", f"{before:.2f}s", "--out", str(rest)]) == 0
    force = max(press.force for presses in load_robot_plan(rest).plan.presses for press in presses)
    assert f"with at most {format_quantity(force, 'force')}" in capsys.readouterr().out
