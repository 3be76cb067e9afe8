"""`falsework replan`, from one end to the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework.assembly import Assembly, load_structure
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.store import save_assembly
from falsework.search import load_plan

Run = Callable[..., Any]
ARCH = load_structure("arch:blocks=5")


def digits(state: Any) -> str:
    return "".join(str(int(value)) for value in state)


@pytest.fixture
def old(falsework: Run, tmp_path: Path) -> Path:
    out = tmp_path / "old.json"
    assert falsework("plan", "arch:blocks=5", "--out", out).code == 0
    return out


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run as training leaves it, with a policy that was never trained."""
    from falsework.learn.config.policy import PolicySettings
    from falsework.learn.config.train import TrainSettings, to_dict
    from falsework.learn.networks.factory import make_policy
    from falsework.learn.training.checkpoint import describe_structure, save_run

    settings = TrainSettings(policy=PolicySettings("mlp"))
    metadata = {
        "structure": describe_structure(ARCH, {"built_in": "arch:blocks=5"}),
        "settings": to_dict(settings),
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
    (record,) = finished.records
    assert record["plan"] == str(out)
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
    assert f"{ARCH.names[late]} is needed after" in finished.out
    assert f"compared with {old}" in finished.out
    new = load_plan(out)
    np.testing.assert_array_equal(new.states[0], state)
    assert new.inserted_parts[0] != late
    assert falsework("check", out).code == 0
    (record,) = falsework(*words, "--json").records
    assert record["difference"]["begins_on_the_way"] is True
    assert record["needs"][0]["part"] == late


def test_with_a_run(falsework: Run, run: Path, tmp_path: Path) -> None:
    """The policy of a run is asked, whatever it is worth; the plan finds its structure again."""
    out = tmp_path / "new.json"
    finished = falsework("replan", run, "--confidences", "--alternatives", 2, "--out", out, "--json")
    assert finished.code == 0, finished.error
    (record,) = finished.records
    assert len(record["alternatives"]) == 1
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
    (record,) = falsework(*words, "--json").records
    assert record["plan"] is None
    assert record["outcome"] == "proved_impossible"
    assert record["moving"]


def test_deadline_that_is_too_short(falsework: Run, tmp_path: Path) -> None:
    finished = falsework("replan", "vault", "--deadline", 0.001, "--out", tmp_path / "plan.json")
    assert finished.code == 1
    assert "no plan was found: the deadline passed" in finished.error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--state", "21"), "a state of 2 values does not fit 7 parts"),
        (("--state", "nonsense"), "neither complete, empty"),
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
    (record,) = refused.records
    assert record["criterion"] == "contact"
    assert [(motion["part"], motion["words"]) for motion in record["moving"]] == [(0, "falls")]
    assert not out.exists()
    found = falsework("replan", tmp_path / "clamp", "--out", out, "--json", "--criterion", "equilibrium")
    assert found.code == 0, found.error
    assert found.records[0]["criterion"] == "equilibrium"
    assert load_plan(out).claim.criterion == "equilibrium"
