"""`--load` and `--earthquake`, in verdicts, plans and their checks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]


def test_a_load_and_an_earthquake_make_a_verdict_worse(falsework: Run, stack: Path) -> None:
    assert falsework("stability", stack).code == 0
    assert falsework("stability", stack, "--earthquake", "0.5").code == 0
    assert falsework("stability", stack, "--earthquake", "0,0.6").code == 1
    assert falsework("stability", stack, "--load", "2=0,0,-1000", "--load", "1=0,0,-1000").code == 0
    assert falsework("stability", stack, "--load", "2=0,0,-1e6@1.7,0.5,3").code == 1


def test_a_plan_says_its_loads_and_its_check_finds_them(falsework: Run, stack: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    loads = ("--load", "2=0,0,-1000", "--earthquake", "0.1")
    assert falsework("plan", stack, "--robots", 1, "--out", plan, *loads).code == 0
    source = json.loads(plan.read_text())["structure"]["source"]
    assert source["loads"] == [{"part": "2", "force": [0, 0, -1000]}]
    assert source["earthquake"] == [0.1]
    checked = falsework("check", plan, "--replay", *loads)
    assert checked.code == 0, checked.error
    assert "--load 2=0.0,0.0,-1000.0 --earthquake 0.1" in falsework("check", plan).error
    other = falsework("check", plan, "--earthquake", "0.2")
    assert other.code == 2
    assert "another structure" in other.error or "differ" in other.error


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--load", "9=0,0,-1", "part 9, which does not exist"),
        ("--load", "2=0,0", "--load 2=0,0: give 3 numbers"),
        ("--load", "2=0,0,-1kg", "without units"),
        ("--load", "0,0,-1", "give a part and its force"),
        ("--load", "2=0,0,-1@1,2", "give 3 numbers"),
        ("--earthquake", "0.1g", "without units"),
        ("--earthquake", "nan", "without units"),
        ("--earthquake", "1,2,3", "give 1 or 2 numbers"),
    ],
)
def test_wrong_loads(falsework: Run, stack: Path, option: str, value: str, words: str) -> None:
    refused = falsework("stability", stack, option, value)
    assert refused.code == 2
    assert words in refused.error
    assert refused.error.count("\n") == 1
