"""`falsework plan` with `--allow-regrasp` and `--props`, and the commands that take such plans."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from falsework.search.plans.plan_file import load_plan

Run = Callable[..., Any]


def test_props_and_what_shows_them(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    options = ("--ground", "--robots", "1", "--props", "3", "--end", "complete", "--out", out)
    finished = falsework("plan", "arch:blocks=7", *options)
    assert finished.code == 0, finished.error
    plan = load_plan(out)
    assert plan.prop_limit == 3
    for prop in plan.props:  # where they stand
        assert f"a prop under {plan.part_names[prop.part]}: from the floor at {prop.floor:.3f} to" in finished.out
    told = falsework("plan", "arch:blocks=7", *options, "--json").answer["plans"][0]["props"]
    assert told == json.loads(msgspec.json.encode(plan.props))
    checked = falsework("check", out, "--ground", "--replay", "--json")
    assert checked.code == 0, checked.error
    assert checked.answer["ok"]
    assert falsework("export", out, "--out", tmp_path / "plan.glb").code == 0
    sheet = falsework("export", out, "--out", tmp_path / "plan.csv")
    assert sheet.code == 2
    assert sheet.error.count("\n") == 1
    elsewhere = falsework("check", out, "--structure", "arch:blocks=7")
    assert elsewhere.code == 2
    assert "has no floor under it" in elsewhere.error


def test_support(falsework: Run, tmp_path: Path) -> None:
    finished = falsework(
        "plan", "arch:blocks=7", "--robots", "auto", "--allow-regrasp", "--json", "--out", tmp_path / "fewest.json"
    )
    assert finished.code == 0, finished.error
    assert (finished.answer["fewest"]["robots"], finished.answer["fewest"]["proven"]) == (2, True)
    refused = falsework("plan", "arch:blocks=7", "--allow-regrasp", "--robots", "1", "--out", tmp_path / "plan.json")
    assert refused.code == 1
    assert refused.error.startswith("falsework: no plan exists")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--props", "-1"), "--props -1 is not a number of props"),
        (("--props", "1"), "no part has a place for a prop"),
        (("--allow-regrasp", "--missing", "2"), "--allow-regrasp takes no --missing yet"),
        (("--allow-regrasp", "--alternatives", "2"), "--allow-regrasp takes no --alternatives yet"),
        (("--allow-regrasp", "--resume"), "--allow-regrasp takes no --resume yet"),
    ],
)
def test_bad_input(falsework: Run, options: tuple[str, ...], message: str, tmp_path: Path) -> None:
    finished = falsework("plan", "vault", *options, "--out", tmp_path / "plan.json")
    assert finished.code == 2
    assert finished.error.count("\n") == 1
    assert message in finished.error
