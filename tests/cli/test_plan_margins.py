"""`falsework plan --margin` and `--maximise-margin`, and their checks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]
Planned = Callable[..., bytes]
_DEMANDED = "--margin", "friction=1.2,push=50N"


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
    ("structure", "search"),
    [
        ((), ("--allow-regrasp", *_DEMANDED)),
        ((), ("--allow-regrasp", "--maximise-margin", "friction")),
        (("--ground",), ("--allow-regrasp", "--props", 3, "--robots", 1, *_DEMANDED)),
        ((), ("--robots", "auto", *_DEMANDED)),
    ],
)
def test_margins_of_plans_that_other_searches_find(
    falsework: Run, tmp_path: Path, structure: tuple[Any, ...], search: tuple[Any, ...]
) -> None:
    plan = tmp_path / "plan.json"
    done = falsework("plan", "arch:blocks=5", *structure, *search, "--out", plan)
    assert done.code == 0, done.error
    weakest = [value for value in json.loads(plan.read_text())["margins"]["measured"]["friction"] if value is not None]
    assert 0 < max(weakest) <= 0.55 / 1.2
    checked = falsework("check", plan, *structure)
    assert checked.code == 0, checked.error


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        ("friction", 0.05, "recorded friction of 0.05"),
        ("tilt", 0.6, "recorded tilt of 34.4 deg"),
        ("tilt", None, "recorded tilt without bound"),
        ("push", 1e4, "recorded push of 10 kN"),
    ],
)
def test_an_overstated_margin_is_found(
    falsework: Run, planned_once: Planned, tmp_path: Path, kind: str, value: float | None, words: str
) -> None:
    plan = tmp_path / "plan.json"
    data = json.loads(planned_once("arch:blocks=5", "--margin", "friction=1.1,tilt=1deg,push=5N"))
    data["margins"]["measured"][kind][-1] = value
    plan.write_text(json.dumps(data))
    checked = falsework("check", plan)
    assert checked.code == 1
    assert words in checked.error


def test_the_weakest_step_is_as_strong_as_the_bound_lets_it(falsework: Run, tmp_path: Path) -> None:
    """The complete arch needs more friction than any other state of the best plan, so no plan is better."""
    plan = tmp_path / "plan.json"
    done = falsework("plan", "arch:blocks=7", "--out", plan, "--maximise-margin", "friction", "--json")
    assert done.code == 0, done.error
    margins = done.answer["plans"][0]["margins"]
    assert margins["maximised"] == "friction"
    weakest = max(value for value in margins["measured"]["friction"] if value is not None)
    assert weakest >= 0.99 * margins["bound"]
    assert falsework("check", plan).code == 0


def test_margins_that_no_state_can_have(falsework: Run, tmp_path: Path) -> None:
    """The report says which state limits, and by how much."""
    done = falsework("plan", "arch:blocks=7", "--out", tmp_path / "plan.json", "--margin", "tilt=40deg", "--json")
    assert done.code == 1
    assert "the complete structure does not keep tilt=40deg" in done.error
    assert "tilt=40deg is demanded" in done.error
    lacks = done.answer["shortfall"]["tilt"]
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
        (("--margin", "push"), "'push' is no margin with its quantity; give friction=..."),
        (("--margin", "wind=3N"), "there is no margin 'wind'; give friction=..."),
        (("--margin", "tilt=1deg,tilt=2deg"), "given twice"),
        (("--margin", "tilt=89deg"), "too steep"),
        (("--margin", "placement=0.4m"), "demand a smaller error"),
        (("--maximise-margin", "friction", "--alternatives", "2"), "--maximise-margin takes no --alternatives yet"),
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
        ({"demands": {"wind": 1.0}}, "margins.demands.wind is not known"),
        ({"measured": {"friction": [0.1]}}, "margins.measured.friction has 1 numbers; the plan has 7 states"),
        ({"measured": {"wind": []}}, "margins.measured.wind is not known"),
        ({"maximised": "wind"}, "margins.maximised"),
        ({"bound": -1}, "margins.bound"),
        ({"more": 1}, "margins.more is not known"),
    ],
)
def test_damaged_margins_in_a_plan(
    falsework: Run, planned_once: Planned, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    plan = tmp_path / "plan.json"
    data = json.loads(planned_once("arch:blocks=3", "--margin", "friction=1.05"))
    data["margins"] |= change
    plan.write_text(json.dumps(data))
    refused = falsework("check", plan)
    assert refused.code == 2
    assert words in refused.error


def test_a_step_in_between_that_limits(falsework: Run, tmp_path: Path) -> None:
    """Both ends bear the push, so the report names the step where the search ended, and how much its states bear.

    A block that slides under the push is no proof that no plan exists.
    """
    done = falsework("plan", "arch:blocks=7", "--out", tmp_path / "plan.json", "--margin", "push=640N", "--json")
    assert done.code == 1
    assert "no plan was found in which every state keeps push=640N; " in done.error
    assert "the search came back to step" in done.error
    assert " slides" not in done.error  # the states there stand, but do not bear the push
    lacks = done.answer["shortfall"]["push"]
    assert 0 < lacks["best"] < lacks["demanded"] == 640


def test_loads_that_no_state_can_bear(falsework: Run, tmp_path: Path) -> None:
    done = falsework("plan", "arch:blocks=7", "--out", tmp_path / "plan.json", "--margin", "load=100kN", "--json")
    assert done.code == 1
    assert "the complete structure does not keep load=100000N on part" in done.error
    best = done.answer["shortfall"]["load"]["best"]
    assert 0 < best < 1e5
    for share, code in ((0.9, 0), (2.0, 1)):
        options = ("--margin", f"load={share * best:.6g}N")
        assert falsework("plan", "arch:blocks=7", "--out", tmp_path / "plan.json", *options).code == code


def test_the_friction_of_joints_counts(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    """Where every joint has a friction of its own, a factor of safety divides those."""
    stairs = (((0, 0, 0), (1, 1, 1)), ((0.2, 0, 1), (1.2, 1, 2)))
    folder = write_structure(tmp_path / "stairs", stairs, joints=[{"friction": 0.3}], earthquake=0.2)
    plan = ("plan", folder, "--out", tmp_path / "plan.json", "--margin")
    assert falsework(*plan, "friction=1.4").code == 0
    refused = falsework(*plan, "friction=1.6")
    assert refused.code == 1
    assert "does not keep friction=1.6" in refused.error


def test_a_bound_that_the_plan_passes_is_found(falsework: Run, tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=5", "--out", plan, "--maximise-margin", "friction").code == 0
    data = json.loads(plan.read_text())
    data["margins"]["bound"] *= 1.5
    plan.write_text(json.dumps(data))
    checked = falsework("check", plan)
    assert checked.code == 1
    assert "which the plan says no plan has" in checked.error
