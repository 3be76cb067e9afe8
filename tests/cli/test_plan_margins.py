"""`falsework plan --margin` and `--maximise`, and their checks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]


def test_a_plan_keeps_its_margins_and_check_verifies_them(falsework: Run, tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    done = falsework("plan", "arch:blocks=7", "--out", plan, "--margin", "friction=1.25,tilt=1deg,push=5N")
    assert done.code == 0, done.error
    assert "every state keeps friction=1.25, tilt=1deg, push=5N" in done.out
    written = json.loads(plan.read_text())["margins"]
    assert written["demands"] == {"friction": 1.25, "tilt": pytest.approx(math.radians(1)), "push": 5.0}
    assert max(value for value in written["measured"]["friction"] if value is not None) <= 0.55 / 1.25
    assert min(value for value in written["measured"]["tilt"] if value is not None) >= math.radians(1)
    assert min(value for value in written["measured"]["push"] if value is not None) >= 5.0
    checked = falsework("check", plan)
    assert checked.code == 0, checked.error
    assert "every state keeps friction=1.25, tilt=1deg, push=5N" in checked.out
    more = falsework("check", plan, "--margin", "tilt=30deg")
    assert more.code == 1
    assert "does not keep tilt=30deg" in more.error


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        ("friction", 0.05, "recorded friction of 0.05"),
        ("tilt", 0.6, "recorded tilt of 34.4 deg"),
        ("tilt", None, "recorded tilt without bound"),
        ("push", 1e4, "recorded push of 1e+04 N"),
    ],
)
def test_an_overstated_margin_is_found(
    falsework: Run, tmp_path: Path, kind: str, value: float | None, words: str
) -> None:
    plan = tmp_path / "plan.json"
    demands = "friction=1.1,tilt=1deg,push=5N"
    assert falsework("plan", "arch:blocks=5", "--out", plan, "--margin", demands).code == 0
    data = json.loads(plan.read_text())
    data["margins"]["measured"][kind][0] = value
    plan.write_text(json.dumps(data))
    checked = falsework("check", plan)
    assert checked.code == 1
    assert words in checked.error


def test_the_weakest_step_is_as_strong_as_the_bound_lets_it(falsework: Run, tmp_path: Path) -> None:
    """The complete arch needs more friction than any other state of the best plan, so no plan is better."""
    plan = tmp_path / "plan.json"
    done = falsework("plan", "arch:blocks=7", "--out", plan, "--maximise", "friction", "--json")
    assert done.code == 0, done.error
    margins = done.records[0]["margins"]
    assert margins["maximised"] == "friction"
    weakest = max(value for value in margins["measured"]["friction"] if value is not None)
    assert weakest >= 0.99 * margins["bound"]
    assert falsework("check", plan).code == 0


def test_margins_that_no_state_can_have(falsework: Run, tmp_path: Path) -> None:
    """The report says which state limits, and by how much."""
    done = falsework("plan", "arch:blocks=7", "--out", tmp_path / "plan.json", "--margin", "tilt=40deg", "--json")
    assert done.code == 1
    assert "the start state does not keep tilt=40deg" in done.error
    assert "tilt=40deg is demanded" in done.error
    lacks = done.records[0]["shortfall"]["tilt"]
    assert 0 < lacks["best"] < lacks["demanded"] == pytest.approx(math.radians(40))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--margin", "tilt=2mm"), "has the unit mm; give 2deg or 2rad"),
        (("--margin", "tilt=2"), "has no unit"),
        (("--margin", "friction=1.25N"), "has the unit N"),
        (("--margin", "friction=0.8"), "a factor of safety is at least 1"),
        (("--margin", "push=20kg"), "has the unit kg"),
        (("--margin", "push=-20N"), "not above zero"),
        (("--margin", "push"), "give friction=..."),
        (("--margin", "wind=3N"), "give friction=..."),
        (("--margin", "tilt=1deg,tilt=2deg"), "given twice"),
        (("--margin", "tilt=89deg"), "too steep"),
        (("--margin", "placement=0.4m"), "demand a smaller error"),
        (("--maximise", "friction", "--alternatives", "2"), "leave out --alternatives"),
    ],
)
def test_wrong_margins(falsework: Run, stack: Path, tmp_path: Path, options: tuple[str, ...], words: str) -> None:
    refused = falsework("plan", stack, "--out", tmp_path / "plan.json", *options)
    assert refused.code == 2, refused.error
    assert words in refused.error
    assert refused.error.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"demands": {"tilt": "2deg"}}, "margins.demands.tilt"),
        ({"demands": {"wind": 1.0}}, "margins.demands must be an object"),
        ({"measured": {"friction": [0.1]}}, "one a state"),
        ({"measured": {"wind": []}}, "margins.measured must be an object"),
        ({"maximised": "wind"}, "margins.maximised"),
        ({"bound": -1}, "margins.bound"),
        ({"more": 1}, "margins must be an object"),
    ],
)
def test_damaged_margins_in_a_plan(falsework: Run, tmp_path: Path, change: dict[str, Any], words: str) -> None:
    plan = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=3", "--out", plan, "--margin", "friction=1.05").code == 0
    data = json.loads(plan.read_text())
    data["margins"] |= change
    plan.write_text(json.dumps(data))
    refused = falsework("check", plan)
    assert refused.code == 2
    assert words in refused.error
