"""Pages in one file: what they hold, how large they are, and who may run what in them."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import falsework as fw
from falsework import Direction
from falsework.assembly import HELD, INSTALLED, complete_state, empty_state
from falsework.cli.main import main
from falsework.errors import InputError
from falsework.search.plans.steps import holders
from falsework.viewer import Timeline
from falsework.viewer.page.recording import FRAMES, record
from falsework.viewer.page.scene import EDGES_UP_TO
from falsework.viewer.page.viewer_state import ViewerState

pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")

import zstandard  # which viser needs


def test_a_page_in_a_file_lists_the_steps_and_allows_its_own_scripts_alone(arch: Any) -> None:
    assembly, plan = arch
    page = record(ViewerState(Timeline.from_plan(plan, assembly), plan=plan))
    for step in plan:
        assert f">{step.words}</td>" in page
    policy = page.index('http-equiv="Content-Security-Policy"')
    assert policy < page.index("<script")
    assert re.search(r"script-src 'wasm-unsafe-eval' ('sha256-[^']+' ?){3};", page[policy : policy + 1000])
    assert "href=" not in page[page.index("<body") :]  # no server answers its links
    assert len(page) < 2e6


def test_the_order_of_a_page_in_a_file_is_that_of_assembly(arch: Any) -> None:
    assembly, plan = arch
    model = ViewerState(Timeline.from_plan(plan, assembly, Direction.DISASSEMBLY), plan=plan)
    model.go_to(3)
    page = record(model)
    words = [step.words for step in plan]
    places = [page.index(f">{word}</td>") for word in words]
    assert places == sorted(places)
    assert (model.position, model.direction) == (3, Direction.DISASSEMBLY)  # the viewer stays where it is


def test_robot_plans_are_recorded_with_their_arms(arch: Any, scheduled: Any, cell: Any) -> None:
    from falsework.viewer.viewable import viewable_of

    page = record(viewable_of(scheduled, arch[0], cell=cell))
    assert "arm 0" in page
    assert "held by arm 1" in page


@pytest.mark.parametrize("slower", [1.0, 1.001])
def test_a_recording_goes_on_to_the_end_of_the_motions(slower: float, arch: Any, scheduled: Any, cell: Any) -> None:
    """Also where that is between two pictures."""
    from falsework.viewer.viewable import viewable_of

    steps = tuple(
        replace(step, trajectories=tuple(replace(one, times=slower * one.times) for one in step.trajectories))
        for step in scheduled.steps
    )
    plan = replace(scheduled, steps=steps, schedule=None)
    page = record(viewable_of(plan, arch[0], cell=cell))
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    data = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=int.from_bytes(data[:8], "little"))
    content = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    last = content["durationSeconds"] - 1.0  # a second with the last state
    assert plan.makespan <= last < plan.makespan + 1 / FRAMES


def test_names_do_not_become_markup(arch: Any) -> None:
    assembly, _ = arch
    hostile = replace(assembly, name="</title><script>alert(1)</script>")
    page = record(ViewerState(Timeline.from_state(hostile, complete_state(hostile.boundary))))
    assert "alert(1)</script>" not in page


def test_the_command_and_the_function_write_it(arch: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assembly, plan = arch
    fw.save(plan, tmp_path / "plan.json")
    out = tmp_path / "plan.html"
    assert main(["export", str(tmp_path / "plan.json"), "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert answer["steps"] == len(plan)
    assert "__VISER_EMBED_DATA__" in out.read_text(encoding="utf-8")
    fw.export(assembly, tmp_path / "arch.html")
    assert "__VISER_EMBED_DATA__" in (tmp_path / "arch.html").read_text(encoding="utf-8")
    assert main(["export", "arch:blocks=3", "--out", str(tmp_path / "a.html"), "--step-seconds", "2"]) == 2
    assert "leave it out" in capsys.readouterr().err


def test_four_hundred_parts_are_a_small_file() -> None:
    wall = fw.load_structure("wall:bricks=20,courses=19")
    states = [empty_state(wall.boundary)]
    actions = []
    for part in np.flatnonzero(~wall.boundary)[np.argsort(wall.mass.center[~wall.boundary, 2], kind="stable")]:
        for action, value in ((part + wall.part_count, HELD), (part, INSTALLED)):  # as a plan looks, proven or not
            states.append(states[-1].copy())
            states[-1][part] = value
            actions.append(int(action))
    rows = np.array(states)
    who = holders(rows, wall.immovable)
    page = record(ViewerState(Timeline(wall, rows, np.array(actions), who, Direction.ASSEMBLY, 1)))
    assert 380 < len(wall.names) <= EDGES_UP_TO
    assert len(page) < 2e6


def test_another_ending_is_refused(arch: Any, tmp_path: Path) -> None:
    assembly, plan = arch
    page = fw.view(plan, assembly, port=0, browser=False, wait=False)
    try:
        page.save(tmp_path / "plan.html")
        with pytest.raises(InputError, match=r"written as \.html"):
            page.save(tmp_path / "plan.pdf")
    finally:
        page.close()
    assert (tmp_path / "plan.html").stat().st_size < 2e6
    assert not (tmp_path / "plan.pdf").exists()
