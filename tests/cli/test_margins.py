"""`falsework margins` on structures whose margins are known, and what it refuses."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework import StabilityOracle

Run = Callable[..., Any]


def test_margins_of_a_stack(falsework: Run, stack: Path) -> None:
    """Two boxes 2 m and 1 m long on a third: pushed at the top the upper one slides at mu times its weight."""
    done = falsework("margins", stack, "--json", "--friction", "0.4")
    assert done.code == 0, done.error
    (record,) = done.answer["states"]
    assert set(record) >= {"friction", "tilt_deg", "load_factor", "horizontal_g", "push_n", "push_part", "held"}
    assert record["friction"] == 0.0
    assert record["tilt_deg"] == pytest.approx(math.degrees(math.atan(0.4)), rel=0.01)
    assert record["horizontal_g"] == pytest.approx(0.4, rel=0.01)
    assert record["push_n"] == pytest.approx(0.4 * 9.81 * 2400, rel=0.01)
    assert record["push_part"] == 2
    assert record["load_factor"] is None
    assert record["held"] == []
    assert record["proven"] is True
    text = falsework("margins", stack, "--friction", "0.4").out
    assert re.search(r"tilt +21\.8 deg", text)
    assert re.search(r"push +9\.\d+ kN on 2\b", text)


def test_margins_of_a_plan_name_the_weakest_step(falsework: Run, stack: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    assert falsework("plan", stack, "--robots", 1, "--out", plan).code == 0
    done = falsework("margins", plan, "--json", "--bears", "100N,1Nm")
    assert done.code == 1
    states = done.answer["states"]
    assert done.answer["outcome"] == "overloaded"
    assert len(states) == 5
    assert [record["overloaded"] for record in states].count([]) < 5
    weakest = {entry["margin"]: entry for entry in done.answer["weakest"]}
    assert weakest["push_n"]["value"] == min(record["push_n"] for record in states if record["push_n"] is not None)
    assert falsework("margins", plan, "--bears", "1000kN,1000kNm").code == 0


def test_margins_of_a_plan_are_those_of_what_is_built(falsework: Run, tmp_path: Path) -> None:
    """Plan, check and margins agree on what stands, and on what robots bear; only what was built is said to be."""
    plan = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=7", "--out", plan).code == 0
    built = falsework("margins", plan, "--json")
    assert built.code == 0
    states = built.answer["states"]
    assert all(record["stands"] for record in states)
    borne = max(load["force_n"] for record in states for load in record["held"])
    assert borne == pytest.approx(falsework("check", plan, "--json").answer["largest_force_n"], rel=1e-3)
    words = "measured as built"
    text = falsework("margins", plan).out
    assert words in text
    assert text.count("*") == len(built.answer["weakest"]) + 1  # all are shown, and the line that says what a mark is
    for option in (("--out", tmp_path / "more.json"), ("--states", "complete"), ("--criterion", "equilibrium")):
        assert words not in falsework("margins", plan, *option).out


def test_numbers_are_steps_of_a_plan(falsework: Run, tmp_path: Path) -> None:
    """Not parts: the state after a step is measured as built, as it is with all of the others."""
    plan = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=5", "--out", plan).code == 0
    every = falsework("margins", plan, "--json").answer["states"]
    for text, steps in (("3", [3]), ("6,2-3", [6, 2, 3])):
        done = falsework("margins", plan, "--states", text, "--json")
        assert done.answer["states"] == [every[step] for step in steps]
        judged = falsework("stability", plan, "--states", text, "--json").answer["states"]
        assert [record["state"] for record in judged] == steps
    wrong = falsework("margins", plan, "--states", "77")
    assert wrong.code == 2
    assert "--states 77: step '77' does not exist" in wrong.error


def test_options_of_the_plan_are_named(falsework: Run, stack: Path, tmp_path: Path) -> None:
    """They are those of the structure only if the plan says so, and margins hang on them."""
    plan = tmp_path / "plan.json"
    assert falsework("plan", stack, "--robots", 1, "--friction", 0.9, "--out", plan).code == 0
    said = "falsework: warning: the plan sets options of its structure itself: --friction 0.9\n"
    assert falsework("margins", plan).error == said
    assert falsework("margins", plan, "--friction", 0.9).error == ""


def test_a_structure_that_falls_has_no_margins(falsework: Run, tmp_path: Path, write_structure: Any) -> None:
    leaning = write_structure(tmp_path / "leaning", [((0, 0, 0), (1, 1, 1)), ((0.8, 0, 1), (3, 1, 2))])
    done = falsework("margins", leaning, "--json")
    assert done.code == 1
    assert done.answer["states"][0]["stands"] is False
    assert done.answer["states"][0]["tilt_deg"] == 0.0


def test_a_deadline_ends_the_search(falsework: Run) -> None:
    done = falsework("margins", "vault", "--json", "--deadline", "0.001")
    assert done.code == 0
    (record,) = done.answer["states"]
    assert set(record["unfinished"]) == {"friction", "tilt", "horizontal", "load_factor", "push"}
    assert record["friction"] == 0.55
    assert record["tilt_deg"] == 0.0
    assert record["proven"] is False
    assert "push cut short by the deadline" in falsework("margins", "vault", "--deadline", "0.001").out


def test_placement_errors_cost_some_draws(falsework: Run, tmp_path: Path, write_structure: Any) -> None:
    """A block whose middle is 50 mm inside an edge: within 10 mm all draws stand, within 200 mm many do not."""
    edge = write_structure(tmp_path / "edge", [((0, 0, 0), (1, 1, 1)), ((0.45, 0, 1), (1.45, 1, 2))])
    done = falsework("margins", edge, "--json", "--placement", "10mm,200mm", "--draws", "30")
    near, far = (entry["share"] for entry in done.answer["states"][0]["placement"])
    assert near == 1.0
    assert far < 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--bears", "100N"), "give a force and a moment"),
        (("--bears", "100mm,8Nm"), "has the unit mm; give 2N"),
        (("--bears", "100,8Nm"), "has no unit; give 2N"),
        (("--placement", "1deg"), "has the unit deg; give 2mm"),
        (("--placement", "-1mm"), "not above zero"),
        (("--placement", ""), "'' is no length"),
        (("--states", ""), "an item is empty"),
        (("--draws", "-1"), "--draws and --seed are of placement errors; give --placement too"),
        (("--placement", "1mm", "--draws", "0"), "the number of draws is 0; give at least 1"),
        (("--settlement", "--criterion", "equilibrium"), "equilibrium has no displacements"),
        (("--deadline", "0"), "a deadline of 0 s leaves no time"),
    ],
)
def test_wrong_options(falsework: Run, stack: Path, options: tuple[str, ...], words: str) -> None:
    refused = falsework("margins", stack, *options)
    assert refused.code == 2
    assert words in refused.error
    assert refused.error.count("\n") == 1


def test_margins_are_written_into_a_plan(falsework: Run, stack: Path, tmp_path: Path) -> None:
    """A plan without demands gets the margins of its states; the sheet shows them, and check verifies them."""
    plan, other = tmp_path / "plan.json", tmp_path / "kept" / "measured.json"
    other.parent.mkdir()
    assert falsework("plan", stack, "--robots", 1, "--out", plan).code == 0
    assert "margins" not in json.loads(plan.read_text())
    done = falsework("margins", plan, "--out", other)
    assert done.code == 0, done.error
    assert "heaviest hold" in done.out.splitlines()[0]
    data = json.loads(other.read_text())
    assert set(data["margins"]["measured"]) == {"friction", "tilt", "horizontal", "push"}
    assert data["margins"]["demands"] == {}
    checked = falsework("check", other)
    assert checked.code == 0, checked.error
    assert "recorded margins of friction, tilt, horizontal, push" in checked.out
    sheet = tmp_path / "site.csv"
    assert falsework("export", other, "--out", sheet).code == 0
    assert "(weakest)" in sheet.read_text(encoding="utf-8-sig")
    data["margins"]["measured"]["tilt"][-1] = 1.0
    other.write_text(json.dumps(data))
    assert falsework("check", other).code == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--deadline", "1"), "leave out --states and --deadline"),
        (("--criterion", "equilibrium"), "the plan is for the criterion contact"),
    ],
)
def test_margins_that_do_not_belong_into_a_plan(
    falsework: Run, stack: Path, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    plan = tmp_path / "plan.json"
    assert falsework("plan", stack, "--robots", 1, "--out", plan).code == 0
    refused = falsework("margins", plan, "--out", plan, *options)
    assert refused.code == 2
    assert words in refused.error
    assert falsework("margins", stack, "--out", plan).code == 2


def test_an_interruption_prints_the_states_so_far(
    falsework: Run, stack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, measured = tmp_path / "plan.json", tmp_path / "measured.json"
    assert falsework("plan", stack, "--robots", 1, "--out", plan).code == 0
    own, asked = StabilityOracle.margins, []

    def margins(oracle: StabilityOracle, *arguments: Any, **options: Any) -> Any:
        asked.append(1)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return own(oracle, *arguments, **options)

    monkeypatch.setattr(StabilityOracle, "margins", margins)
    done = falsework("margins", plan, "--out", measured, "--json", "--placement", "1mm")
    assert done.code == 130
    assert [record["state"] for record in done.answer["states"]] == [0, 1]
    assert "interrupted after 2 of 5 states" in done.error
    assert not measured.exists()
