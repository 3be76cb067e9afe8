"""Margins of a plan on the page, the site sheet and in pictures."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import falsework as fw
from falsework import Plan, find_plans
from falsework import sheet as make_sheet
from falsework.errors import InputError
from falsework.interop.instruction_table import instructions_csv
from falsework.search import Demands, PlanMargins
from falsework.viewer.margin_strip import margin_strip, weakness
from falsework.viewer.pictures.contact_sheet import legend_of_shares


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Plan of a small arch, with margins of which the third state's are the weakest."""
    found = find_plans(fw.load_structure("arch:blocks=3"), robots=2).plans[0]
    count = len(found.states)
    friction: list[float | None] = [0.1] * count
    tilt: list[float | None] = [0.2] * count
    friction[2], tilt[2], tilt[-1] = 0.4, 0.05, None
    measured: dict[str, tuple[float | None, ...]] = {"friction": tuple(friction), "tilt": tuple(tilt)}
    return replace(found, margins=PlanMargins(Demands(tilt=0.05), measured))


def test_the_strip_marks_the_weakest_step_and_the_one_that_is_shown(plan: Plan) -> None:
    strip = margin_strip(plan, 1)
    assert strip.count("<title>") == 2 * len(plan.states)
    assert strip.count("<path") == 2
    assert "step 2: friction 0.4 (weakest)" in strip
    assert "step 2: tilt 2.86 deg (weakest)" in strip
    assert f"step {len(plan)}: tilt without bound" in strip


def test_weak_steps_are_darker(plan: Plan) -> None:
    assert plan.margins is not None
    for kind, values in plan.margins.measured.items():
        shares = weakness(kind, values, plan.friction)
        assert np.argmax(shares) == 2
        assert ((shares >= 0) & (shares <= 1)).all()
    fills = re.findall(r'fill="(#\w{6})"><title>', margin_strip(plan, 0))
    assert len(set(fills)) > 1


def test_there_is_no_strip_without_margins(plan: Plan) -> None:
    assert margin_strip(None, 0) == ""
    assert margin_strip(replace(plan, margins=None), 0) == ""


def test_the_site_sheet_says_the_margins_after_each_step(plan: Plan) -> None:
    sheet = instructions_csv(make_sheet(fw.load_structure("arch:blocks=3"), plan))
    rows = list(csv.DictReader(io.StringIO(sheet)))
    assert rows[1]["margins"] == "friction 0.4 (weakest), tilt 2.86 deg (weakest)"
    assert sum("weakest" in row["margins"] for row in rows) == 1


def test_pictures_colour_parts_by_their_limits(plan: Plan, tmp_path: Path) -> None:
    arch = fw.load_structure("arch:blocks=3")
    for name, limits in (("plain", False), ("limits", True)):
        fw.picture(plan, tmp_path / f"{name}.png", arch, step=0, limits=limits, width=200)
    assert (tmp_path / "plain.png").read_bytes() != (tmp_path / "limits.png").read_bytes()
    with pytest.raises(InputError, match="name the state with --step"):
        fw.picture(plan, tmp_path / "sheet.png", arch, limits=True)
    words = [text for _, text in legend_of_shares("the limit")]
    assert words == ["0% of the limit", "25% of the limit", "50% of the limit", "75% of the limit", "100% of the limit"]
