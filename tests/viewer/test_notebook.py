"""Notebooks: what objects show there, executed by a kernel."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import falsework as fw
from falsework.errors import InputError
from falsework.utils.display import notebook
from falsework.viewer.notebook import html_of
from falsework.viewer.pictures.picture import Picture

pytest.importorskip("PIL", reason="pictures need Pillow; pip install 'falsework[picture]'")

CELLS = (
    "import falsework as fw\narch = fw.load_structure('arch:blocks=3')\narch",
    "found = fw.find_plans(arch)\nfound",
    "found.plans[0]",
    "fw.StabilityOracle(arch).verdicts(found.plans[0].states, require_certificate=True)",
    "fw.picture(arch, width=100)",
    "page = fw.view(found.plans[0], arch, port=0)\npage",
    "page.save('plan.html')\npage.close()",
)


def shown(cell: Any, kind: str) -> str:
    """What a cell shows of one kind, all outputs together."""
    return "".join(output["data"].get(kind, "") for output in cell.outputs if "data" in output)


@pytest.mark.slow
def test_a_notebook_shows_pictures_tables_pages_and_progress(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    nbformat = pytest.importorskip("nbformat", reason="needs nbclient; pip install --group test")
    client = pytest.importorskip("nbclient", reason="needs nbclient; pip install --group test")
    pytest.importorskip("ipykernel", reason="needs ipykernel; pip install --group test")
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in CELLS])
    client.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    structure, found, plan, verdicts, picture, page, _ = book.cells
    for cell in (structure, plan, verdicts):
        assert "<table" in shown(cell, "text/html")
        assert 'src="data:image/png;base64,' in shown(cell, "text/html")
    searched = shown(found, "text/html")
    assert "<progress" in searched
    assert "verdicts" in searched
    assert "voussoir-0" in searched
    assert "voussoir-0" in shown(plan, "text/html")
    assert "stable" in shown(verdicts, "text/html")
    assert shown(picture, "image/png").startswith("iVBOR")
    assert "<iframe srcdoc=" in shown(page, "text/html")
    assert re.search(r"http://localhost:\d+", shown(page, "text/html"))
    assert not any(output["output_type"] == "stream" for cell in book.cells for output in cell.outputs)
    assert "(viser)" not in re.sub(r"\x1b\[\d*m", "", "".join(shown(cell, "text/plain") for cell in book.cells))
    assert "Websocket" not in shown(page, "text/plain")
    assert "__VISER_EMBED_DATA__" in (tmp_path / "plan.html").read_text(encoding="utf-8")


def test_a_plan_without_its_structure_shows_its_steps(arch: Any) -> None:
    _, plan = arch
    text = html_of(replace(plan, name="mine", source=None)) or ""
    assert "no picture: " in text
    assert "<img" not in text
    assert plan.part_names[2] in text


def test_names_do_not_become_markup(arch: Any) -> None:
    assembly, _ = arch
    text = html_of(replace(assembly, name="<script>")) or ""
    assert "<script>" not in text
    assert "&lt;script&gt;" in text


def test_what_is_no_object_of_ours_shows_nothing() -> None:
    assert html_of(3) is None
    assert notebook.notebook_progress("searching") is None  # no notebook here


@pytest.fixture
def cell_lines(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a cell of a notebook would show."""
    lines: list[str] = []

    def progress(title: str) -> Callable[[float, str], None]:
        return lambda share, words: lines.append(f"{title} {share:.2f} {words}")

    for module in ("falsework.utils.display.notebook", "falsework.learn.training.train"):
        monkeypatch.setattr(f"{module}.notebook_progress", progress)
    return lines


def test_searches_for_the_fewest_robots_show_their_progress(cell_lines: list[str]) -> None:
    fw.min_robots("arch:blocks=3")
    assert cell_lines
    assert all(line.startswith("searching ") and "verdicts" in line for line in cell_lines)


def test_a_callback_of_the_caller_is_left_alone(cell_lines: list[str]) -> None:
    seen: list[object] = []
    fw.find_plans("arch:blocks=3", progress=seen.append)
    assert seen
    assert cell_lines == []


def test_training_shows_its_progress(cell_lines: list[str]) -> None:
    pytest.importorskip("torch", reason="training needs torch; pip install 'falsework[learn]'")
    from falsework.learn import PolicySettings, TrainSettings

    small = TrainSettings(steps=4, block=2, widths=(4,), policy=PolicySettings("resmlp", channels=8, layers=1))
    fw.train("arch:blocks=3", small, folder=None, device="cpu")
    assert cell_lines
    assert all(line.startswith("training ") for line in cell_lines)


def test_a_robot_plan_shows_its_chart(robot_plan: Any) -> None:
    text = html_of(robot_plan) or ""
    assert "data:image/svg+xml;base64," in text
    assert "no picture: " in text  # its cell has no file
    assert f"{robot_plan.makespan:.1f} s" in text


def test_a_picture_is_an_object_and_a_file(arch: Any, tmp_path: Path) -> None:
    assembly, _ = arch
    drawn = fw.picture(assembly, width=100)
    assert isinstance(drawn, Picture)
    drawn.save(tmp_path / "arch.png")
    assert (tmp_path / "arch.png").read_bytes() == drawn.content
    assert fw.picture(assembly, tmp_path / "same.png", width=100).content == (tmp_path / "same.png").read_bytes()
    lines = fw.picture(assembly, tmp_path / "arch.svg")
    assert lines._repr_mimebundle_()["image/svg+xml"].startswith("<svg")
    with pytest.raises(InputError, match=r"\.png"):
        drawn.save(tmp_path / "arch.svg")
