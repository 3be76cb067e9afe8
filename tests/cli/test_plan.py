"""`falsework plan`, `check` and `graph`, from one end to the other."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from falsework import load_structure
from falsework.search import BeamSearch
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan
from falsework.search.problem.state_graph import load_state_graph
from falsework.stability.judges import discrete_elements

Run = Callable[..., Any]
Write = Callable[..., Path]


def test_plan_and_check(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    planned = falsework("plan", "arch:blocks=7", "--robots", 2, "--out", out, "--json")
    assert planned.code == 0, planned.error
    assert planned.error == ""
    (record,) = planned.answer["plans"]
    assert planned.answer["files"] == [record["file"]] == [str(out)]
    assert record["steps"] == 14  # each block is held and removed once
    plan = load_plan(out)
    assert validate_plan(plan, load_structure("arch:blocks=7")).good
    checked = falsework("check", out, "--json")
    assert checked.code == 0, checked.error
    assert (checked.answer["ok"], checked.answer["outcome"]) == (True, "verified")
    assert checked.answer["checked"] == checked.answer["states"] == 15
    people = falsework("check", out, "--steps")
    assert people.code == 0
    lines = people.out.splitlines()
    assert len(lines) == 14 + 4
    assert "all 15 states are stable" in lines[14]
    assert lines[15].startswith("checked: arch:blocks=7, digest ")
    assert lines[15].endswith(
        "9 parts, 2 boundary (abutment-7, abutment-8); 14 steps with 2 robots, from empty to complete"
    )
    assert lines[16].startswith("robots bear at most ")
    assert lines[17] == "not verified: its replay"


def test_one_robot_is_not_plural(falsework: Run, tmp_path: Path) -> None:
    people = falsework("plan", "stack:blocks=2", "--robots", "1", "--out", tmp_path / "plan.json")
    assert "steps with 1 robot, every state proven stable as built (criterion contact" in people.out


def test_the_replay_is_printed_step_by_step(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    planned = falsework("plan", "arch:blocks=7", "--out", out, "--json")
    (record,) = planned.answer["plans"]
    assert record["criterion"] == "contact"
    assert record["replay"]["stands"] is True
    assert 0 < record["replay"]["moved_mm"] < 1
    people = falsework("check", out, "--replay")
    assert people.code == 0, people.error
    lines = people.out.splitlines()
    assert len(lines) == 3 + 15 + 1
    assert all("stands" in line for line in lines[3:18])
    answer = falsework("check", out, "--replay", "--json").answer
    assert answer["claim"]["criterion"] == "contact"
    assert [entry["replay"] for entry in answer["steps"]] == ["stands"] * 15
    assert answer["replay"] == "stands"
    assert len(answer["variations"]) == 4


def test_a_plan_in_equilibrium_is_not_one_that_stands(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=7", "--criterion", "equilibrium", "--out", out).code == 0
    assert falsework("check", out, "--criterion", "equilibrium").code == 0
    refused_claim = falsework("check", out)
    assert refused_claim.code == 1
    assert "claims equilibrium only" in refused_claim.error
    refused(falsework("check", out, "--criterion", "equilibrium", "--replay"), "--replay")


def test_a_robust_plan_stands_under_varied_settings(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a deadline too; where there is none, the plan that stands under the default settings alone is shown."""
    from falsework.stability.contact.varied_replay import AllVariations

    out, robust = tmp_path / "plan.json", ("plan", "arch:blocks=5", "--robust", "--out", tmp_path / "plan.json")
    assert "friction / 1.1, and under each small change of settings" in falsework(*robust, "--deadline", "60").out
    refused(falsework(*robust, "--criterion", "equilibrium"), "--robust")
    out.unlink()
    monkeypatch.setattr(AllVariations, "falls_at", lambda self, states, presses: 3)
    result = falsework(*robust, "--reserve", 1, "--width", 1, "--search-from", "beginning")
    assert result.code == 1
    assert "was not shown to stand under each small change of settings" in result.error
    assert out.is_file()


def test_a_plan_that_discrete_elements_build(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    planned = falsework("plan", "arch:blocks=5", "--judge", "--out", out)
    assert planned.code == 0, planned.error
    assert "discrete elements build the plan too\n" in planned.out
    judgement = json.loads(out.read_text())["replay"]["judgement"]
    assert judgement == {"built": 11, "of": 11}
    assert "not verified: its replay, its build by discrete elements" in falsework("check", out).out
    checked = falsework("check", out, "--judge", "--json")
    assert checked.code == 0, checked.error
    assert checked.answer["unverified"] == ["its replay"]
    assert judgement.items() <= checked.answer["judgement"].items()


@pytest.mark.parametrize("options", [(), ("--allow-regrasp",), ("--robots", "auto"), ("--maximise-margin", "push")])
def test_a_plan_that_discrete_elements_do_not_build(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[Any, ...]
) -> None:
    """The plan that they build farthest is written, with exit code 1, and a check that asks them refuses it."""
    out = tmp_path / "plan.json"
    soft = partial(discrete_elements.DiscreteElementSettings, stiffness=1e-5)  # parts sink by more than they may
    monkeypatch.setattr(discrete_elements, "Build", partial(discrete_elements.Build, settings=soft()))
    limit = "--deadline", 20
    planned = falsework("plan", "arch:blocks=3", "--judge", *limit, *options, "--out", out, "--json")
    assert planned.code == 1
    assert "no plan was found that discrete elements build; in this one " in planned.error
    replay = load_plan(out).replay
    assert replay is not None
    assert replay.judgement is not None
    judgement = replay.judgement.to_dict()
    assert judgement["falls_at"] == judgement["built"] < judgement["of"]
    checked = falsework("check", out, "--judge")
    assert checked.code == 1
    assert "falls when discrete elements build the plan, after step " in checked.error


@pytest.mark.parametrize(
    "options",
    [
        ("--alternatives", 2),
        ("--allow-regrasp",),
        ("--ground", "--allow-regrasp", "--props", 3, "--robots", 1),
        ("--parts-at-once", 2),
        ("--margin", "friction=1.2"),
        ("--maximise-margin", "push"),
        ("--robots", "auto"),
    ],
)
def test_discrete_elements_build_every_plan_that_is_delivered(
    falsework: Run, tmp_path: Path, options: tuple[Any, ...]
) -> None:
    planned = falsework("plan", "arch:blocks=5", "--judge", *options, "--out", tmp_path / "plan.json", "--json")
    assert planned.code == 0, planned.error
    plans = [load_plan(path) for path in sorted(tmp_path.glob("plan*.json"))]
    assert len(plans) == (2 if "--alternatives" in options else 1)
    for plan in plans:
        assert plan.replay is not None
        assert plan.replay.judgement is not None
        assert plan.replay.judgement.built == plan.replay.judgement.of == len(plan.states)


def test_the_judge_builds_as_the_criterion_contact_does(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    refused = falsework("plan", "arch:blocks=5", "--judge", "--criterion", "equilibrium", "--out", out)
    assert refused.code == 2
    assert "--judge" in refused.error


@pytest.mark.parametrize(
    ("key", "value", "hint"),
    [("tolerance", 1e6, "tolerance"), ("gravity", 1e-6, "gravity"), ("force_bound", 1e9, "force")],
)
def test_a_plan_does_not_choose_what_stable_means(
    falsework: Run, tmp_path: Path, key: str, value: float, hint: str
) -> None:
    """The keystone last, by one robot, with a file that asks for less: refused, and bad if the claim is corrected."""
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=7", "--out", out).code == 0
    content = json.loads(out.read_text())
    parts = [step["part"] for step in content["steps"] if step["do"] == "insert"]
    middle = (min(parts) + max(parts)) / 2
    parts = sorted(parts, key=lambda part: -abs(part - middle))
    steps = [{**content["steps"][0], "do": word, "part": part} for part in parts for word in ("insert", "release")]
    forged = content | {"steps": steps, "stability": content["stability"] | {key: value}}
    out.write_text(json.dumps(forged))
    finished = falsework("check", out)
    assert finished.code == 1
    assert hint in finished.error
    out.write_text(json.dumps(content | {"steps": steps}))
    corrected = falsework("check", out)
    assert corrected.code == 1
    assert "the structure is unstable" in corrected.error


@pytest.mark.parametrize(("option", "name"), [("--begin", "start"), ("--end", "target")])
@pytest.mark.parametrize("command", ["plan", "graph"])
def test_ends_are_called_in_the_order_of_assembly(
    falsework: Run, tmp_path: Path, command: str, option: str, name: str
) -> None:
    out = tmp_path / ("graph.npz" if command == "graph" else "plan.json")
    finished = falsework(command, "arch:blocks=3", option, "voussoir-1", "--out", out)
    assert finished.code == 1
    assert f"no plan exists: the {name} state is unstable; voussoir-1 falls" in finished.error


def test_a_step_has_one_number_and_a_robot_in_every_output(falsework: Run, tmp_path: Path) -> None:
    """Of lists in both orders, the replay, margins and the sheet."""
    out = tmp_path / "plan.json"
    planned = falsework("plan", "arch:blocks=5", "--out", out)
    assert planned.code == 0
    plan = load_plan(out)
    lines = [plan.line(number) for number in range(11)]
    assert lines[1].split()[:2] == ["1", "insert"]
    assert all(line.endswith(("(R1)", "(R2)")) for line in lines[1:])
    assert f"first steps: {', '.join(map(str, plan[:8]))} and 2 more steps" in planned.out
    checked = falsework("check", out, "--steps", "--replay")
    assert [line.partition(";")[0] for line in checked.out.splitlines()[:10]] == lines[1:]
    assert [line.partition(":")[0] for line in checked.out.splitlines() if ": stands" in line] == lines
    apart = falsework("check", out, "--steps", "--order", "disassembly").out.splitlines()[:10]
    apart = [line.partition(";")[0] for line in apart]
    words = {"insert": "remove", "release": "hold"}
    assert apart == [
        line.replace(step.action, words[step.action]) for line, step in zip(lines[:0:-1], plan[::-1], strict=True)
    ]
    margins = falsework("margins", out, "--steps").out.splitlines()[1:12]
    assert {line[: line.find("  ")].replace("*", "") for line in margins} == {
        line.strip().replace("  ", " ") for line in lines
    }
    assert falsework("export", out, "--out", tmp_path / "sheet.csv").code == 0
    table = list(csv.DictReader((tmp_path / "sheet.csv").open(encoding="utf-8-sig")))
    assert [(int(row["step"]), row["name"], int(row["support"])) for row in table] == [
        (step.number, step.name, (step.robot or 0) + 1) for step in plan
    ]


def test_an_arch_needs_two_robots(falsework: Run, tmp_path: Path) -> None:
    """One robot cannot take the first block out of an arch: what is left falls, whichever block it is."""
    finished = falsework("plan", "arch:blocks=5", "--robots", 1, "--out", tmp_path / "plan.json")
    assert finished.code == 1
    assert finished.error.count("\n") == 1
    assert "no plan exists" in finished.error  # proven, not merely not found
    assert " of 10; there" in finished.error  # how far it came
    assert "voussoir-" in finished.error
    assert list(tmp_path.iterdir()) == []
    machine = falsework("plan", "arch:blocks=5", "--robots", 1, "--out", tmp_path / "plan.json", "--json")
    record = machine.answer
    assert record["files"] == []
    assert record["outcome"] == "impossible"
    assert record["moving"]


def test_not_found_is_told_from_proven(falsework: Run, tmp_path: Path) -> None:
    """A beam of one state begins with some block in the air, which no second block reaches."""
    out = tmp_path / "graph.npz"
    finished = falsework("graph", "arch:blocks=9", "--width", 1, "--out", out)
    assert finished.code == 1
    assert finished.error.count("\n") == 1
    assert "no plan was found" in finished.error
    assert "a wider one may find a plan" in finished.error
    assert falsework("graph", "arch:blocks=9", "--width", 64, "--out", out).code == 0


def test_between_two_states(falsework: Run, tmp_path: Path) -> None:
    """Between walls of which more or less of the top course is gone; the files hold the states in between only."""
    out, wall = tmp_path / "plan.json", load_structure("wall:bricks=3,courses=3")
    top = [int(part) for part in wall.mass.center[:, 2].argsort()[::-1] if not wall.boundary[part]][:3]
    end = "".join("2" if wall.boundary[part] else "0" if part == top[0] else "1" for part in range(wall.part_count))
    begin = "".join("2" if wall.boundary[part] else "0" if part in top else "1" for part in range(wall.part_count))
    spec = "wall:bricks=3,courses=3"
    assert falsework("plan", spec, "--end", end, "--begin", begin, "--out", out).code == 0
    plan = load_plan(out)
    assert "".join(map(str, plan.states[0])) == begin
    assert "".join(map(str, plan.states[-1])) == end
    assert falsework("check", out).code == 0


def test_fixed_parts_are_not_touched(falsework: Run, stack: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", stack, "--fixed", 1, "--out", out).code == 0
    plan = load_plan(out)
    assert 1 not in plan.actions % 3
    assert plan.states[0].tolist() == [2, 1, 0]


def test_missing_parts_come_last(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    boxes = [((0, 0, 0), (9, 1, 1)), *(((2 * k, 0, 1), (2 * k + 1, 1, 2)) for k in range(4))]
    folder, out = write_structure(tmp_path / "row", boxes), tmp_path / "plan.json"
    finished = falsework("plan", folder, "--missing", "2,3", "--out", out, "--json")
    assert finished.code == 0
    needs = {need["part"]: need["after_parts"] for need in finished.answer["plans"][0]["needs"]}
    # Nothing stands on anything here, so both can wait for all the others.
    assert sorted(needs.values()) == [2, 3]
    assert (
        "is needed at step 5, after 2 other parts are placed"
        in falsework("plan", folder, "--missing", "2,3", "--out", out).out
    )


def test_clear_ways_out(falsework: Run, tmp_path: Path) -> None:
    """Out of interlocking pieces a straight way must be open for each that leaves."""
    out = tmp_path / "plan.json"
    assert falsework("plan", "bottle", "--removable-only-if-clear", "--out", out).code == 0
    plan, bottle = load_plan(out), load_structure("bottle")
    parts = len(plan.boundary)
    for state, action in zip(plan.states[:-1], plan.actions, strict=True):
        if action >= parts:
            assert bottle.clearance.can_leave(state[None])[0, action - parts]
    assert falsework("check", out).code == 0


def test_a_structure_that_locks_itself(falsework: Run, tmp_path: Path) -> None:
    """Both commands say that no plan exists where parts need a way out; the graph keeps what can be reached."""
    out = tmp_path / "out.npz"
    for command, more in (("plan", ()), ("graph", ("--search-from", "end"))):
        done = falsework(command, "shelf:shelves=0", "--removable-only-if-clear", *more, "--out", out)
        assert done.code == 1
        assert "no plan exists" in done.error
    graph = load_state_graph(out)
    assert graph.removable_only_if_clear
    assert graph.reachable.all()
    assert not graph.solvable.any()
    assert falsework("plan", "shelf:shelves=0", "--out", out).code == 0


def test_a_structure_that_locks_itself_opens_with_two_parts_at_once(falsework: Run, tmp_path: Path) -> None:
    """Plan and check name the step, and the sheet all of its parts."""
    out = tmp_path / "plan.json"
    done = falsework("plan", "shelf:shelves=0", "--criterion", "equilibrium", "--out", out, "--parts-at-once", 2)
    assert done.code == 0, done.error
    (step,) = [step for step in load_plan(out) if len(step.parts) > 1]
    assert f"step {step.number} inserts 2 parts at once: {step}" in done.out
    checked = falsework("check", out, "--criterion", "equilibrium")
    assert checked.code == 0
    assert "with 2 robots, up to 2 parts in one step, from empty to complete" in checked.out
    table = tmp_path / "sheet.csv"
    assert falsework("export", out, "--out", table).code == 0
    assert f"{step.number},place,{'; '.join(map(str, step.parts))}," in table.read_text()


def test_the_answer_names_steps_of_several_parts(falsework: Run, tmp_path: Path) -> None:
    """They are in an answer only where there are some."""
    words = "--parts-at-once", 2, "--criterion", "equilibrium", "--out", tmp_path / "plan.json", "--json"
    (locked,) = falsework("plan", "shelf:shelves=0", *words).answer["plans"]
    (step,) = [step for step in load_plan(locked["file"]) if len(step.parts) > 1]
    assert locked["together"] == [{"step": step.number, "parts": list(step.parts), "held": 1}]
    (free,) = falsework("plan", "arch:blocks=3", *words).answer["plans"]
    assert "together" not in free


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--parts-at-once", 0), "0 is not a number of parts of arch:blocks=3 that can move at once"),
        (("--parts-at-once", 4), "4 is not a number of parts of arch:blocks=3 that can move at once; give 1 (one at a"),
    ],
)
def test_parts_at_once_that_cannot_be_had(falsework: Run, tmp_path: Path, options: tuple, message: str) -> None:
    done = falsework("plan", "arch:blocks=3", *options, "--out", tmp_path / "plan.json")
    assert done.code == 2
    assert message in done.error


def test_alternatives_differ(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    finished = falsework("plan", "arch:blocks=7", "--alternatives", 3, "--out", out, "--json")
    assert finished.code == 0, finished.error
    plans = finished.answer["plans"]
    assert [Path(record["file"]).name for record in plans] == ["plan.json", "plan-2.json", "plan-3.json"]
    distances = [record["distances"] for record in plans]
    assert all(distances[i][i] == 0 for i in range(3))
    assert min(distances[i][j] for i in range(3) for j in range(i)) > 0
    sequences = set()
    for record in plans:
        assert falsework("check", record["file"]).code == 0
        sequences.add(load_plan(record["file"]).actions.tobytes())
    assert len(sequences) == 3


def test_round_cone_is_checked_as_such(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=5", "--cone", "quadratic", "--out", out).code == 0
    assert load_plan(out).claim.cone == "quadratic"
    assert falsework("check", out).code == 0


def test_proofs_can_be_written(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=5", "--proofs", "--out", out).code == 0
    assert validate_plan(load_plan(out), load_structure("arch:blocks=5")).good


def test_graph(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "graph.npz"
    finished = falsework("graph", "arch:blocks=5", "--width", 16, "--robots", 2, "--out", out, "--json")
    assert finished.code == 0, finished.error
    graph = load_state_graph(out)
    assert finished.answer["states"] == len(graph)
    assert finished.answer["actions"] == len(graph.source)
    assert graph.count_routes() >= 1
    assert graph.solvable.all()  # found from the empty structure


def test_graph_of_what_cannot_be_built(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "graph.npz"
    finished = falsework("graph", "arch:blocks=5", "--robots", 1, "--out", out)
    assert finished.code == 1
    assert "no plan exists" in finished.error
    assert len(load_state_graph(out)) > 0  # how far it came is kept


# What the plan is checked against


@pytest.fixture
def plan_of_stack(falsework: Run, stack: Path, tmp_path: Path) -> Path:
    out = tmp_path / "plan.json"
    assert falsework("plan", stack, "--out", out).code == 0
    return out


def refused(finished: Any, *hints: str) -> None:
    assert finished.code == 2, finished.error
    assert finished.error.count("\n") == 1
    assert finished.out == ""
    for hint in hints:
        assert hint in finished.error, finished.error


def test_a_plan_finds_its_structure_again(falsework: Run, plan_of_stack: Path, tmp_path: Path) -> None:
    assert falsework("check", plan_of_stack).code == 0
    # Both moved together, and seen from another folder: the way from one to the other is what counts.
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.move(tmp_path / "stack", moved / "stack")
    shutil.move(plan_of_stack, moved / "plan.json")
    assert falsework("check", moved / "plan.json").code == 0
    shutil.move(moved / "stack", tmp_path / "renamed")
    refused(falsework("check", moved / "plan.json"), "stack", "--structure")
    assert falsework("check", moved / "plan.json", "--structure", tmp_path / "renamed").code == 0


def test_options_of_the_structure_are_remembered(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    folder, out = write_structure(tmp_path / "loose", boundary=[]), tmp_path / "plan.json"
    options = ("--ground", "--unit", "cm", "--friction", 0.4, "--density", 1800)
    assert falsework("plan", folder, *options, "--out", out).code == 0
    assert falsework("check", out, *options).code == 0
    refused(falsework("check", out, "--structure", folder, "--ground"), "another structure")
    assert falsework("check", out, "--structure", folder, *options).code == 0
    refused(falsework("check", out, "--friction", 0.9), "another structure")


def test_plan_for_another_structure(falsework: Run, plan_of_stack: Path) -> None:
    refused(falsework("check", plan_of_stack, "--structure", "arch:blocks=3"), "parts")


def test_structure_changed_since(falsework: Run, plan_of_stack: Path, stack: Path) -> None:
    (stack / "assembly.json").write_text(json.dumps({"boundary": [0], "friction": 0.3}))
    refused(falsework("check", plan_of_stack), "another structure")


def test_truncated_plan(falsework: Run, plan_of_stack: Path) -> None:
    text = plan_of_stack.read_text()
    plan_of_stack.write_text(text[: len(text) // 2])
    refused(falsework("check", plan_of_stack), "plan.json", "truncated")


def test_plan_of_another_version(falsework: Run, plan_of_stack: Path) -> None:
    plan_of_stack.write_text(plan_of_stack.read_text().replace("falsework.plan/4", "falsework.plan/5"))
    refused(falsework("check", plan_of_stack), "falsework.plan/5")


def test_no_plan_file(falsework: Run, tmp_path: Path) -> None:
    refused(falsework("check", tmp_path / "none.json"), "none.json")


def test_first_bad_step_is_named(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    """The order turned round: the upper block comes before the middle one, and is let go of."""
    folder, out = write_structure(tmp_path / "stack"), tmp_path / "plan.json"
    assert falsework("plan", folder, "--robots", 1, "--out", out).code == 0
    content = json.loads(out.read_text())
    swap = {1: 2, 2: 1}
    for step in content["steps"]:
        step["part"] = swap[step["part"]]
    out.write_text(json.dumps(content))
    finished = falsework("check", out)
    assert finished.code == 1
    assert finished.error.count("\n") == 1
    assert "part 2 falls" in finished.error
    machine = falsework("check", out, "--json")
    assert machine.code == 1
    record = machine.answer
    assert record["outcome"] == "refuted"
    assert record["bad_step"] == 2
    assert record["checked"] == 2


def test_an_interrupted_search_goes_on(falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C leaves no plan behind, but the search, from which the same command gets to the plan."""
    out, steps, step = tmp_path / "plan.json", [0], BeamSearch.step

    def interrupted_step(search: BeamSearch) -> bool:
        steps[0] += 1
        if steps[0] == 9:
            raise KeyboardInterrupt
        return step(search)

    monkeypatch.setattr(BeamSearch, "step", interrupted_step)
    first = falsework("plan", "arch:blocks=9", "--out", out)
    assert first.code == 130
    assert first.error.count("\n") == 1
    assert "--resume" in first.error
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json.search"]
    monkeypatch.undo()
    refused(falsework("plan", "arch:blocks=8", "--out", out, "--resume"), "another structure")
    assert falsework("plan", "arch:blocks=9", "--out", out, "--resume").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json"]
    assert falsework("check", out).code == 0
    resumed = load_plan(out).actions.tolist()
    assert falsework("plan", "arch:blocks=9", "--out", out).code == 0
    assert load_plan(out).actions.tolist() == resumed  # as if nothing had happened


def test_a_real_interrupt_is_one_line(start_command: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    out = str(tmp_path / "plan.json")
    often = "from falsework.cli import output; output.LOG_EVERY = 0.0"  # lines of progress
    running = start_command("plan", "vault:parts=300", "--out", out, "--alternatives", "9", first=often)
    assert running.stderr is not None
    assert "searching" in running.stderr.readline()  # Python itself loses some interrupts while modules are imported
    running.send_signal(signal.SIGINT)
    _, error = running.communicate()
    assert running.returncode in (130, -signal.SIGINT), error
    assert "Traceback" not in error
    assert not (tmp_path / "plan.json").exists()


def test_nothing_to_resume(falsework: Run, tmp_path: Path) -> None:
    refused(falsework("plan", "arch", "--out", tmp_path / "plan.json", "--resume"), "--resume")


@pytest.mark.slow
def test_the_real_vault(falsework: Run, shared_assembly: Callable[[str], Path], tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", shared_assembly("vault-62"), "--robots", 2, "--out", out).code == 0
    assert falsework("check", out).code == 0


def test_a_structure_without_a_free_part_has_no_plan(falsework: Run, tmp_path: Path) -> None:
    done = falsework("plan", "arch:blocks=3", "--boundary", "0-4", "--out", tmp_path / "plan.json")
    assert done.code == 2
    assert "every part of arch:blocks=3 is boundary, so there is nothing to plan; fix fewer parts" in done.error
    assert not (tmp_path / "plan.json").exists()
