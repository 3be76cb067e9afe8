"""Files that the page opens: plans and structures; wrong ones are refused in one line, and no other file is read."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import falsework as fw
from falsework.assembly import complete_state
from falsework.errors import FalseworkError
from falsework.search.plans.plan_file import save_plan
from falsework.viewer import Timeline
from falsework.viewer.page.files_tab import LARGEST, opened
from falsework.viewer.page.viewer_state import ViewerState


@pytest.fixture
def model(arch: Any) -> ViewerState:
    assembly, _ = arch
    return ViewerState(Timeline.from_state(assembly, complete_state(assembly.boundary)))


def content_of(plan: Any, folder: Path) -> bytes:
    save_plan(plan, folder / "plan.json")
    return (folder / "plan.json").read_bytes()


def test_a_plan_is_opened_with_the_structure_that_is_shown(arch: Any, model: ViewerState, tmp_path: Path) -> None:
    _, plan = arch
    content = content_of(replace(plan, name="mine", source={"path": "/nowhere/mine"}), tmp_path)
    found = opened("plan.json", content, model)
    assert found.assembly is model.assembly
    assert len(found.timeline) == len(plan)
    assert found.plan is not None


def test_a_plan_of_a_built_in_structure_brings_it(model: ViewerState, tmp_path: Path) -> None:
    other = fw.find_plans("stack:blocks=2").plans[0]
    found = opened(r"C:\plans\plan.json", content_of(other, tmp_path), model)
    assert found.assembly.name == "stack:blocks=2"


def test_a_structure_in_one_file_is_opened(model: ViewerState, tmp_path: Path) -> None:
    fw.export(fw.load_structure("stack:blocks=2"), tmp_path / "stack.glb")
    found = opened("stack.glb", (tmp_path / "stack.glb").read_bytes(), model)
    assert found.assembly.part_count == 3
    assert len(found.timeline) == 0


def test_what_cannot_be_opened_is_said_in_one_line(model: ViewerState, tmp_path: Path) -> None:
    other = fw.find_plans("stack:blocks=2").plans[0]
    path = content_of(replace(other, source={"path": "../../etc/structure"}), tmp_path)
    cases = [
        ("big.glb", b"0" * (LARGEST + 1), "the page opens up to"),
        ("notes.txt", b"", "the page opens plans"),
        ("plan.json", b"{", "plan.json"),
        ("plan.json", path, "plan of another structure, stack:blocks=2; open that structure first"),
        ("assembly.json", json.dumps({"format": "falsework.assembly/1"}).encode(), "names other files"),
        ("stack.glb", b"no mesh", "stack"),
    ]
    for name, content, message in cases:
        with pytest.raises(FalseworkError) as refused:
            opened(name, content, model)
        assert message in str(refused.value)
        assert "\n" not in str(refused.value)


def test_a_robot_plan_needs_its_cell(robot_plan: Any, model: ViewerState, tmp_path: Path) -> None:
    fw.save(robot_plan, tmp_path / "robot.json")
    with pytest.raises(FalseworkError, match="a robot plan; the page opens it where"):
        opened("robot.json", (tmp_path / "robot.json").read_bytes(), model)


def test_a_page_tells_that_its_file_has_changed(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    plan = fw.find_plans("stack:blocks=2").plans[0]
    fw.save(plan, tmp_path / "plan.json")
    page = fw.view(tmp_path / "plan.json", wait=False, browser=False, port=0)
    said: Any = page.site.answer
    try:
        assert said.content == ""
        (tmp_path / "plan.json").write_text("{", encoding="utf-8")
        end = time.monotonic() + 10
        while "plan.json has changed" not in said.content.replace("\\", ""):
            assert time.monotonic() < end, "the change is not told"
            time.sleep(0.05)
        assert len(page.model.timeline) == len(plan)
    finally:
        page.close()
