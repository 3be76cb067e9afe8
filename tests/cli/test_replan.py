"""`falsework replan`, from one end to the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, load_structure
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.store import save_assembly
from falsework.search.plans.plan_file import load_plan

Run = Callable[..., Any]
ARCH = load_structure("arch:blocks=5")


def digits(state: Any) -> str:
    return "".join(str(int(value)) for value in state)


@pytest.fixture
def old(planned_once: Callable[..., bytes], tmp_path: Path) -> Path:
    out = tmp_path / "old.json"
    out.write_bytes(planned_once("arch:blocks=5"))
    return out


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run as training leaves it, with a policy that was never trained."""
    from dataclasses import asdict

    from falsework.learn import PolicySettings, TrainSettings, make_policy
    from falsework.learn.training.checkpoint import describe_structure, save_run

    settings = TrainSettings(policy=PolicySettings("mlp"))
    metadata = {
        "structure": describe_structure(ARCH, {"built_in": "arch:blocks=5"}),
        "settings": asdict(settings),
        "policy": {},
        "results": {},
        "versions": {},
    }
    save_run(tmp_path / "run", make_policy(ARCH, settings.policy), metadata)
    return tmp_path / "run"


def test_a_run_is_opened_in_python_too(run: Path) -> None:
    import falsework as fw
    from falsework.learn import Policy

    shown = fw.open_file(run)
    assert (shown.kind, shown.assembly.identity) == ("run", ARCH.identity)
    for policy in (shown.policy, fw.load_policy(run), fw.open_file("arch:blocks=5").with_policy(run).policy):
        assert isinstance(policy, Policy)


def test_take_down_what_is_there(falsework: Run, old: Path, tmp_path: Path) -> None:
    state = load_plan(old).states[5]
    out = tmp_path / "new.json"
    finished = falsework("replan", "arch:blocks=5", "--state", digits(state), "--out", out, "--json")
    assert finished.code == 0, finished.error
    record = finished.answer
    assert record["files"] == [str(out)]
    assert record["outcome"] == "found"
    assert record["decided_by"] == "search"
    assert record["direction"] == "disassembly"
    plan = load_plan(out)
    assert len(plan) == record["steps"] == 5
    np.testing.assert_array_equal(plan.states[-1], state)
    assert falsework("check", out).code == 0


def test_build_on_without_a_part(falsework: Run, old: Path, tmp_path: Path) -> None:
    """From a state on the way up, with a part late: assembly, and what changes against the old plan."""
    plan = load_plan(old)
    state, late = plan.states[2], int(plan.inserted_parts[1])
    out = tmp_path / "new.json"
    words = ("replan", "arch:blocks=5", "--state", digits(state), "--missing", late, "--compare", old, "--out", out)
    finished = falsework(*words)
    assert finished.code == 0, finished.error
    assert "steps of assembly with 2 robots" in finished.out
    assert "from here on: " in finished.out
    assert f"{ARCH.names[late]} is needed at step " in finished.out
    assert f"compared with {old}" in finished.out
    new = load_plan(out)
    np.testing.assert_array_equal(new.states[0], state)
    assert new.inserted_parts[0] != late
    assert falsework("check", out).code == 0
    record = falsework(*words, "--json").answer
    assert record["difference"]["begins_on_the_way"] is True
    assert record["needs"][0]["part"] == late


def test_with_a_run(falsework: Run, run: Path, tmp_path: Path) -> None:
    """The policy of a run is asked, whatever it is worth; the plan finds its structure again."""
    out = tmp_path / "new.json"
    finished = falsework("replan", run, "--confidences", "--alternatives", 2, "--out", out, "--json")
    assert finished.code == 0, finished.error
    record = finished.answer
    assert len(record["files"]) == 2
    assert len(record["confidences"]) == record["steps"] + 1
    assert sum(record["confidences"][-1].values()) == pytest.approx(1, abs=1e-4)
    assert falsework("check", out).code == 0
    assert falsework("check", out.with_stem("new-2")).code == 0


def test_no_plan(falsework: Run, tmp_path: Path) -> None:
    finished = falsework("replan", "arch:blocks=5", "--robots", 1, "--out", tmp_path / "plan.json")
    assert finished.code == 1
    assert "no plan exists" in finished.error
    assert finished.error.count("\n") == 1
    assert not (tmp_path / "plan.json").exists()


def test_unstable_state(falsework: Run, tmp_path: Path) -> None:
    words = ("replan", "arch:blocks=5", "--state", "0111122", "--out", tmp_path / "plan.json")
    finished = falsework(*words)
    assert finished.code == 1
    assert "the state is not stable; voussoir-" in finished.error
    record = falsework(*words, "--json").answer
    assert record["files"] == []
    assert record["outcome"] == "impossible"
    assert record["moving"]


def test_deadline_that_is_too_short(falsework: Run, tmp_path: Path) -> None:
    finished = falsework("replan", "vault", "--deadline", 0.001, "--out", tmp_path / "plan.json")
    assert finished.code == 1
    assert "no plan was found: the deadline passed" in finished.error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--state", "21"), "a state of 2 values does not fit 7 parts"),
        (("--state", "nonsense"), "is neither a part nor a file"),
        (("--state", "1111022", "--target", "0111122"), "the target is not reachable"),
        (("--state", "2200022", "--robots", 1), "2 parts held"),
        (("--state", "1121122", "--target", "0020022", "--robots", 1), "no action is legal in this state"),
        (("--missing", "nobody"), "is not a part"),
        (("--missing", "2", "--order", "assembly"), "said to be missing, yet the state has it"),
        (("--deadline", -1), "leaves no time"),
        (("--alternatives", 0), "ask for at least 1"),
        (("--confidences",), "needs a policy"),
        (("--compare", "absent.json"), "absent.json"),
        (("--out", "no-such-folder/plan.json"), "there is no folder"),
    ],
)
def test_wrong_input(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[Any, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    finished = falsework("replan", "arch:blocks=5", *words)
    assert finished.code == 2
    assert message in finished.error
    assert finished.error.count("\n") == 1


def test_compare_with_another_structure(falsework: Run, old: Path) -> None:
    finished = falsework("replan", "arch:blocks=7", "--compare", old)
    assert finished.code == 2
    assert "plan for another structure" in finished.error


def test_run_of_another_structure(falsework: Run, run: Path) -> None:
    """The structure behind a run has changed since it was trained."""
    content = json.loads((run / "run.json").read_text())
    content["structure"]["source"] = {"built_in": "arch:blocks=7"}
    (run / "run.json").write_text(json.dumps(content))
    finished = falsework("replan", run)
    assert finished.code == 2
    assert "trained for another structure" in finished.error
    assert finished.error.count("\n") == 1


def test_run_and_options_of_structures(falsework: Run, run: Path) -> None:
    finished = falsework("replan", run, "--friction", 0.3)
    assert finished.code == 2
    assert "leave the option out" in finished.error


def test_a_state_that_slides_is_no_beginning_under_contact(falsework: Run, tmp_path: Path) -> None:
    """A cube between two walls, with nothing below it: equilibrium has a plan, contact says what moves."""
    made = gather(
        [
            box("cube", (0, 0, 0), (1, 1, 1)),
            box("left", (-1, 0, -1), (0, 1, 2), fixed=True),
            box("right", (1, 0, -1), (2, 1, 2), fixed=True),
        ]
    )
    save_assembly(Assembly.from_meshes(made.meshes, boundary=made.boundary), tmp_path / "clamp")
    out = tmp_path / "new.json"
    refused = falsework("replan", tmp_path / "clamp", "--out", out, "--json")
    assert refused.code == 1
    record = refused.answer
    assert record["criterion"] == "contact"
    assert [(motion["part"], motion["words"]) for motion in record["moving"]] == [(0, "falls")]
    assert not out.exists()
    found = falsework("replan", tmp_path / "clamp", "--out", out, "--json", "--criterion", "equilibrium")
    assert found.code == 0, found.error
    assert found.answer["criterion"] == "equilibrium"
    assert load_plan(out).claim.criterion == "equilibrium"


def test_go_on_from_a_step_of_the_plan(falsework: Run, old: Path, tmp_path: Path) -> None:
    """Stone 17 is late, and we are at step 31: names, numbers that stay, and what changes, in one command."""
    plan, out = load_plan(old), tmp_path / "new.json"
    late = next(step for step in plan if step.action == "insert" and step.number > 5)
    done = falsework("replan", old, "--step", 4, "--missing", late.name, "--out", out, "--json")
    assert done.code == 0, done.error
    new, answer = load_plan(out), done.answer
    assert (answer["built"], answer["steps"], answer["files"]) == (4, len(new) - 4, [str(out)])
    assert [str(step) for step in new.steps[:4]] == [str(step) for step in plan.steps[:4]]
    assert [step.number for step in new] == list(range(1, len(new) + 1))
    assert len(answer["actions"]) == len(new) - 4
    need = answer["needs"][0]
    assert need["part"] == late.part
    assert new.steps[need["after_steps"]].name == late.name
    assert falsework("check", out, "--replay").code == 0
    people = falsework("replan", old, "--step", 4, "--missing", late.name, "--out", out).out
    assert "from step 5 on: " in people
    assert f"{late.name} is needed at step {need['after_steps'] + 1}, after " in people
    assert f"compared with {old}: " in people
    assert "changes of settings were not tried; falsework check --replay does" in people
    assert answer["varied"] is False


def test_criterion_robots_and_reserve_are_those_of_the_plan(falsework: Run, tmp_path: Path) -> None:
    first, out = tmp_path / "first.json", tmp_path / "new.json"
    options = ("--robots", 3, "--reserve", 1.2, "--hold-force", 90000)
    assert falsework("plan", "arch:blocks=5", *options, "--out", first).code == 0
    assert falsework("replan", first, "--step", 2, "--out", out).code == 0
    plan = load_plan(out)
    assert (plan.robots, plan.claim.reserve, plan.claim.holds.force) == (3, 1.2, 90000)
    assert falsework("replan", first, "--step", 2, "--reserve", 1, "--criterion", "equilibrium", "--out", out).code == 0
    assert load_plan(out).claim.criterion == "equilibrium"


@pytest.mark.parametrize(
    ("structure", "options"),
    [
        ("arch:blocks=7", ("--allow-regrasp",)),
        ("arch:blocks=5", ("--criterion", "equilibrium")),
        ("stack:blocks=4", ("--removable-only-if-clear",)),
    ],
)
def test_plans_of_all_kinds_go_on(structure: str, options: tuple[str, ...], falsework: Run, tmp_path: Path) -> None:
    first, out = tmp_path / "first.json", tmp_path / "new.json"
    assert falsework("plan", structure, *options, "--out", first).code == 0
    old = load_plan(first)
    for step in (1, len(old) // 2, len(old) - 1):
        done = falsework("replan", first, "--step", step, "--out", out)
        assert done.code == 0, done.error
        new = load_plan(out)
        assert new.removable_only_if_clear == old.removable_only_if_clear
        assert new.claim.criterion == old.claim.criterion
        np.testing.assert_array_equal(new.states[: step + 1], old.states[: step + 1])
        checked = falsework("check", out, *(options if "--criterion" in options else ()))
        assert checked.code == 0, checked.error


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--margin", "tilt=1deg"), "the margins that the old plan keeps (tilt=1deg) are not asked of this one"),
        (("--judge",), "discrete elements build the old plan, but were not asked about this one"),
    ],
    ids=lambda entry: entry[0] if isinstance(entry, tuple) else "",
)
def test_what_is_not_asked_again_is_said(options: tuple[str, ...], words: str, falsework: Run, tmp_path: Path) -> None:
    first, new = tmp_path / "first.json", tmp_path / "new.json"
    assert falsework("plan", "arch:blocks=5", *options, "--out", first).code == 0
    assert words in falsework("replan", first, "--step", 2, "--out", new).error
    assert words not in falsework("replan", new, "--step", 3, "--out", tmp_path / "other.json").error


def test_ways_are_those_of_the_plan_also_from_a_state_of_its_own(falsework: Run, tmp_path: Path) -> None:
    """The shelf has parts that leave together only."""
    first, new = tmp_path / "first.json", tmp_path / "new.json"
    assert falsework("plan", "shelf:shelves=0", "--parts-at-once", 2, "--out", first).code == 0
    done = falsework("replan", first, "--state", "complete", "--out", new)
    assert done.code == 0, done.error
    plan = load_plan(new)
    assert plan.removable_only_if_clear
    assert plan.parts_at_once == 2


def test_a_robot_that_has_failed(falsework: Run, tmp_path: Path) -> None:
    """The rest is built by those that are left; the whole has the steps of all."""
    first, out = tmp_path / "first.json", tmp_path / "new.json"
    assert falsework("plan", "stack:blocks=4", "--robots", 2, "--out", first).code == 0
    done = falsework("replan", first, "--step", 2, "--robots", 1, "--out", out)
    assert done.code == 0, done.error
    assert "with 2 robots, 1 from step 3 on, every state" in done.out
    plan = load_plan(out)
    assert ((plan.states[2:] == 2) & ~plan.boundary).sum(axis=1).max() == 1
    assert falsework("check", out).code == 0


@pytest.mark.parametrize("step", [0, 3, -1])
def test_every_step_can_be_the_last(step: int, falsework: Run, old: Path, tmp_path: Path) -> None:
    plan, out = load_plan(old), tmp_path / "new.json"
    step = len(plan) if step < 0 else step
    assert falsework("replan", old, "--step", step, "--out", out).code == 0
    np.testing.assert_array_equal(load_plan(out).states[: step + 1], plan.states[: step + 1])
    assert falsework("check", out).code == 0


def test_a_structure_is_taken_apart_from_a_step(falsework: Run, old: Path, tmp_path: Path) -> None:
    """Then nothing is built any more: the plan leads from the empty structure to the state, and is undone."""
    plan, out = load_plan(old), tmp_path / "down.json"
    done = falsework("replan", old, "--step", 4, "--order", "disassembly", "--out", out, "--json")
    assert (done.code, done.answer["built"]) == (0, 0)
    np.testing.assert_array_equal(load_plan(out).states[-1], plan.states[4])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("PLAN", "--step", 99), "step 99 does not exist; the plan has the steps 1 to 10, and 0 is the start"),
        (("PLAN", "--step", -1), "step -1 does not exist"),
        (("PLAN",), "has 10 steps; name the last one that is done by --step, 0 for none"),
        (("PLAN", "--step", 2, "--state", "empty"), "a plan with its step says what the state is"),
        (("PLAN", "--step", 4, "--missing", "FIRST"), "yet step 1 has placed it; name parts that are not placed yet"),
        (("PLAN", "--step", 4, "--missing", "stone17"), "'stone17' is not a part"),
        (("PLAN", "--step", 4, "--structure", "arch:blocks=7"), "the plan is for arch:blocks=5 with 7 parts"),
        (("PLAN", "--step", 4, "--structure", "OTHER"), "the plan is for another structure"),
        (
            ("arch:blocks=5", "--step", 4),
            "--step 4 is of a plan, which arch:blocks=5 is not; give the plan, or --state",
        ),
        (("absent.json", "--step", 4), "there is no plan file absent.json"),
        (("arch:blocks=5", "--state", "PLAN:99"), "step '99' does not exist; the plan has the steps 1 to 10"),
        (("arch:blocks=7", "--state", "PLAN:4"), "the plan is for arch:blocks=5 with 7 parts"),
    ],
)
def test_a_wrong_step_plan_or_part_gets_one_line(
    options: tuple[Any, ...], message: str, falsework: Run, old: Path, tmp_path: Path
) -> None:
    first = load_plan(old).steps[0].name
    other = tmp_path / "other"
    save_assembly(load_structure("arch:blocks=5", friction=0.9), other)
    words = [
        str(word).replace("PLAN", str(old)).replace("FIRST", first).replace("OTHER", str(other)) for word in options
    ]
    out = tmp_path / "new.json"
    refused = falsework("replan", *words, "--out", out)
    assert refused.code == 2
    assert message in refused.error, refused.error
    assert refused.error.count("\n") == 1
    assert not out.exists()


def test_a_prop_and_a_hold_on_site(falsework: Run, tmp_path: Path) -> None:
    """The new plan has them as its next steps, and the next one goes on from it."""
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    assert falsework("plan", "arch:blocks=7", "--ground", "--out", old).code == 0
    plan = load_plan(old)
    step = next(k for k in range(len(plan)) if (plan.states[k] == 2).sum() == plan.boundary.sum() + 2)
    part = plan.part_names[int(np.flatnonzero((plan.states[step] == 2) & ~plan.boundary)[0])]
    said = falsework("replan", old, "--step", step, "--prop", part, "--out", new)
    assert said.code == 0
    assert f"then insert prop-{part} instead of" in said.out
    assert f"the first {step} steps stay as they were" in said.out
    assert load_plan(new)[step].words == f"insert prop-{part}"
    assert falsework("check", new, "--accept-overrides").code == 0
    again = falsework("replan", new, "--step", step + 1, "--out", tmp_path / "again.json")
    assert again.code == 0
    for options, words in (
        (("--step", step, "--prop", part, "--missing", part), "plans with props take no missing parts"),
        (("--step", 0, "--hold", part), f"part {part} is not placed yet"),
        (("--state", "complete", "--release", part), "give the plan and --step"),
    ):
        wrong = falsework("replan", old, *options, "--out", tmp_path / "wrong.json")
        assert wrong.code == 2
        assert words in wrong.error
