"""Settling of parts into their clearance by the command line: reported, recorded in plans, offered where it helps."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]

LOOSE = (((0, 0, 0), (1, 1, 1)), ((0, 0, 1.01), (1, 1, 2)), ((0, 0, 2.02), (1, 1, 3)))
"""A stack with gaps of 10 mm."""
BESIDE = (((0, 0, 0), (1, 1, 1)), ((1, 0, 0.51), (2, 1, 1.5)), ((1, 0, 0), (2, 1, 0.5)))
"""A box against the side of another, 10 mm above its seat."""


def test_the_motion_is_in_the_answer(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "loose", LOOSE)
    without = falsework("stability", folder)
    assert without.code == 2
    assert "let parts settle (--settle 11)" in without.error
    done = falsework("stability", folder, "--settle", 50, "--json")
    assert done.code == 0, done.error
    settled = done.answer["settlement"]
    assert settled["bound_m"] == 0.05
    moved = {entry["part"]: entry["translation_m"][2] for entry in settled["parts"]}
    assert moved == pytest.approx({1: -0.01, 2: -0.03}, abs=2e-4)
    assert all(entry["stopped"] for entry in settled["parts"])
    assert "2 parts settled into the clearance, within 50 mm; 2 moved farthest, by 30 mm" in done.error


def test_a_plan_records_it_and_its_check_settles_again(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    folder, plan = write_structure(tmp_path / "loose", LOOSE), tmp_path / "plan.json"
    made = falsework("plan", folder, "--robots", 1, "--settle", 50, "--out", plan, "--json")
    assert made.code == 0, made.error
    assert len(made.answer["settlement"]["parts"]) == 2
    assert json.loads(plan.read_text())["structure"]["source"]["settle"] == 0.05
    # Like any option that a plan sets itself.
    check = falsework("check", plan)
    assert check.code == 3
    assert "--settle 50" in check.out + check.error
    assert falsework("check", plan, "--settle", 50).code == 0


def test_the_description_of_a_structure_may_ask_for_it(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "loose", LOOSE, settle=0.05)
    assert falsework("stability", folder).code == 0
    assert falsework("doctor", folder).code == 0


def test_an_unstable_complete_structure_with_clearance_hears_of_it(
    falsework: Run, write_structure: Any, tmp_path: Path
) -> None:
    folder = write_structure(tmp_path / "beside", BESIDE, boundary=[0, 2])
    verdict = falsework("stability", folder)
    assert verdict.code == 1
    assert "parts 1 and 2 face each other 10 mm apart" in verdict.error
    plan = falsework("plan", folder, "--out", tmp_path / "plan.json", "--json")
    assert plan.code == 1
    assert "--settle 20" in plan.answer["reason"]


@pytest.mark.parametrize(
    ("length", "words"),
    [
        ("-0.5", "parts cannot settle by -0.5 mm; give a length above zero"),
        ("700", "part 1 is only 990 mm wide; give the clearance of the fits, at most half of that"),
        ("nan", "give a length above zero"),
    ],
)
def test_wrong_lengths(falsework: Run, write_structure: Any, tmp_path: Path, length: str, words: str) -> None:
    done = falsework("stability", write_structure(tmp_path / "loose", LOOSE), "--settle", length)
    assert done.code == 2
    assert words in done.error
    assert done.error.count("\n") == 1


def test_built_in_structures_have_no_clearance(falsework: Run) -> None:
    done = falsework("stability", "arch", "--settle", 1)
    assert done.code == 2
    assert "arch is a built-in structure and has parts without clearance; leave out settle" in done.error
