"""Joints, fasteners and bricks in verdicts, plans and their checks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]

BRACKET = (((0, 0, 0), (1, 1, 3)), ((1, 0, 2), (2, 1, 3)))
"""A post, and a cube that juts out from its side."""
WEIGHT = 2400 * 9.81
GLUE = {"tension": 1.5 * WEIGHT, "cohesion": 20 * WEIGHT}


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_glue_holds_a_bracket(falsework: Run, write_structure: Any, tmp_path: Path, criterion: str) -> None:
    write_structure(tmp_path / "dry", BRACKET)
    write_structure(tmp_path / "glued", BRACKET, joints=[GLUE])
    assert falsework("stability", tmp_path / "dry", "--criterion", criterion).code == 1
    glued = falsework("stability", tmp_path / "glued", "--criterion", criterion)
    assert glued.code == 0, glued.error
    plan = tmp_path / "plan.json"
    made = falsework("plan", tmp_path / "glued", "--robots", 1, "--criterion", criterion, "--out", plan)
    assert made.code == 0, made.error
    assert falsework("check", plan, "--criterion", criterion).code == 0
    write_structure(tmp_path / "glued", BRACKET, joints=[GLUE | {"tension": 1.6 * WEIGHT}])
    other = falsework("check", plan, "--criterion", criterion)
    assert other.code == 2
    assert other.error.count("\n") == 1


def test_screws_hold_a_bracket(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    screws = [{"parts": [0, 1], "at": [1, 0.5, z], "tension": 3 * WEIGHT, "shear": 3 * WEIGHT} for z in (2.2, 2.8)]
    folder = write_structure(tmp_path / "screwed", BRACKET, fasteners=screws)
    held = falsework("stability", folder)
    assert held.code == 0, held.error
    refused = falsework("stability", write_structure(tmp_path / "bad", BRACKET, fasteners=[{"parts": [0, 1]}]))
    assert refused.code == 2
    assert "fasteners[0].at is missing" in refused.error


@pytest.mark.parametrize(
    ("described", "words"),
    [
        ({"joints": [{"cohesion": -5}]}, "joints[0].cohesion is -5; give a number >= 0"),
        ({"joints": {"tension": 1}}, "joints is"),
        ({"joints": [{"between": ["stone", "glass"], "tension": 1}], "materials": "stone"}, "of material 'glass'"),
        ({"joints": [{"tension": 1, "parts": [0, 7]}]}, "a joint is of part 7, which does not exist"),
        ({"materials": 3}, "materials is 3; give a text or a list"),
    ],
)
def test_wrong_joints(falsework: Run, write_structure: Any, tmp_path: Path, described: Any, words: str) -> None:
    refused = falsework("stability", write_structure(tmp_path / "wrong", BRACKET, **described))
    assert refused.code == 2
    assert words in refused.error
    assert refused.error.count("\n") == 1


def test_joints_that_set_need_steps(falsework: Run, write_structure: Any, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "setting", BRACKET, joints=[GLUE | {"sets": [[0, 0], [9, 1]]}])
    refused = falsework("stability", folder, "--criterion", "equilibrium")
    assert refused.code == 2
    assert "joints that set need the criterion contact; equilibrium has no steps" in refused.error
    assert falsework("stability", folder).code == 0
    # Nothing else is there to do while a robot holds the cube, so the glue has set by a ninth when it lets go.
    assert falsework("plan", folder, "--robots", 1, "--out", tmp_path / "plan.json").code == 1
    fallen = json.loads((tmp_path / "plan.json").read_text())
    assert fallen["replay"]["stands"] is False
    last = {key: fallen["steps"][-1][key] for key in ("verdict", "proof", "residual")}
    assert last == {"verdict": "undecided", "proof": "none", "residual": None}
    checked = falsework("check", tmp_path / "plan.json")
    assert checked.code == 1
    assert "does not come to rest" in checked.error
    claimed = json.dumps(fallen | {"replay": fallen["replay"] | {"stands": True, "falls_at": None}})
    (tmp_path / "plan.json").write_text(claimed)
    assert "every state must be stable by history" in falsework("check", tmp_path / "plan.json").error


def test_bricks_from_text_to_plan(falsework: Run, tmp_path: Path) -> None:
    table = tmp_path / "table.txt"
    table.write_text("2x2 (0,0,0)\n2x2 (6,0,0)\n4x2 (0,0,1)\n4x2 (4,0,1)\n4x2 (2,0,2)\n")
    plan = tmp_path / "plan.json"
    made = falsework("plan", table, "--robots", 2, "--out", plan)
    assert made.code == 0, made.error
    checked = falsework("check", plan, "--replay")
    assert checked.code == 0, checked.error
    assert json.loads(plan.read_text())["structure"]["source"]["path"].endswith("table.txt")
    looked = falsework("doctor", table)
    assert looked.code == 0, looked.error
    refused = falsework("stability", table, "--friction", 0.5)
    assert refused.code == 2
    assert "have their own friction; leave it out" in refused.error
