"""Diagnosis: every fault is found, part by part, and what is proposed makes the structure load."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from falsework.assembly import diagnose, load_structure
from falsework.assembly.model import ContactWarning
from falsework.cli.main import main
from falsework.errors import InputError

BOX = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
BOX += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]


def write_box(folder: Path, name: str, low: tuple[float, ...], high: tuple[float, ...], faces: int = 12) -> None:
    """Write a box as OBJ, without some of its triangles if asked for."""
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    points = np.where(corners, high, low)
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in BOX[:faces]]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")


@pytest.fixture
def column(tmp_path: Path) -> Path:
    """Three cubes of a metre on each other."""
    folder = tmp_path / "column"
    folder.mkdir()
    for level in range(3):
        write_box(folder, f"{level}", (0, 0, level), (1, 1, level + 1))
    (folder / "assembly.json").write_text('{"boundary": [0]}')
    return folder


def add(folder: Path, line: dict) -> None:
    described = json.loads((folder / "assembly.json").read_text())
    (folder / "assembly.json").write_text(json.dumps({**described, **line}))


def test_a_sound_structure(column: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = diagnose(column)
    assert found.loads
    assert not found.doubtful
    assert not found.additions
    assert (found.contacts, len(found.parts)) == (2, 3)
    assert found.parts[1].volume == pytest.approx(1.0)
    assert [report.boundary for report in found.parts] == [True, False, False]
    assert main(["doctor", str(column)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "it loads"


def test_all_faults_at_once(column: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_box(column, "3", (3, 0, 0), (4, 1, 1), faces=7)
    write_box(column, "4", (0, 0, 2), (1, 1, 3))
    write_box(column, "5", (0, 0, 3), (0.05, 0.05, 3.05))
    write_box(column, "6", (7, 0, 0), (8, 1, 1))
    assert main(["doctor", str(column), "--json", "--picture", str(tmp_path / "column.png")]) == 1
    record = json.loads(capsys.readouterr().out)
    doubts = {report["name"]: " ".join(report["doubts"]) for report in record["parts"]}
    assert "is not closed" in doubts["3"]
    assert "is a duplicate of part 2" in doubts["4"]
    assert "passes through part 2" in doubts["4"]
    assert "is tiny" in doubts["5"]
    assert "touches no other part; part" in doubts["6"]
    assert not doubts["0"]
    assert not doubts["1"]
    assert not record["loads"]
    assert not record["loads_with_it"]
    assert record["parts"][3]["volume"] is None
    assert (tmp_path / "column.png").stat().st_size > 1000


def test_mended_parts_are_named(column: Path) -> None:
    write_box(column, "2", (0, 0, 2), (1, 1, 3), faces=10)  # the last side is missing
    found = diagnose(column)
    assert found.loads
    assert found.parts[2].mended == "closed flat holes"
    assert not found.parts[1].mended


def test_what_is_divided_between_two_parts_is_no_fault(column: Path) -> None:
    write_box(column, "2", (0, 0, 1.996), (1, 1, 3))
    assert diagnose(column).loads
    with pytest.warns(ContactWarning, match="overlap up to 4 mm"):
        assert load_structure(column).part_count == 3


def test_depth_of_every_overlap_and_not_of_joints(column: Path) -> None:
    """Overlaps that a joint divides are no fault; those of another size are, with their depth."""
    write_box(column, "2", (0, 0, 1.9), (1, 1, 3))
    write_box(column, "3", (0.2, 0.2, 2.5), (0.8, 0.8, 3.5))
    found = diagnose(column)
    assert not found.loads
    assert [len(report.doubts) for report in found.parts] == [0, 0, 1, 1]
    (doubt,) = found.parts[2].doubts
    assert re.fullmatch(r"passes through part 3 by 4[89]\d mm", doubt)
    assert not found.additions


def test_lengths_that_are_given_may_be_the_fault(column: Path) -> None:
    write_box(column, "2", (0, 0, 1.996), (1, 1, 3))
    add(column, {"contact": {"gap": 0.001, "overlap": 0.001}})
    found = diagnose(column)
    assert not found.loads
    assert found.parts[2].doubts == ("passes through part 1 by 4 mm",)
    assert any("it loads without the lengths gap and overlap" in remark for remark in found.remarks)


def test_a_support_that_is_a_surface_is_mended(column: Path) -> None:
    (column / "0.obj").write_text("v -1 -1 1\nv 2 -1 1\nv 2 2 1\nv -1 2 1\nf 1 2 3 4\n")
    found = diagnose(column)
    assert found.loads
    assert found.parts[0].mended == "given a thickness"
    assert not found.doubtful


def test_boundary_and_unit_are_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for level in range(3):
        write_box(tmp_path, f"{level}", (0, 0, 300 * level), (300, 300, 300 * level + 300))
    found = diagnose(tmp_path)
    assert found.unit == "mm"
    assert found.additions == {"unit": "mm", "boundary": [0]}
    assert found.cured
    assert main(["doctor", str(tmp_path)]) == 1
    last = capsys.readouterr().out.splitlines()[-2:]
    assert last == ['add to assembly.json: "unit": "mm", "boundary": [0]', "with that it loads"]
    assert diagnose(tmp_path, "mm").additions == {"boundary": [0]}


def test_files_that_cannot_be_read_are_parts_in_doubt(column: Path) -> None:
    (column / "1.obj").write_text("v 0 0 zero\n")
    found = diagnose(column)
    assert found.parts[1].doubts
    assert "touches no other part" in found.parts[2].doubts[0]


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no"):
        diagnose(tmp_path / "nothing")
    assert "no mesh" in diagnose(tmp_path).error
    (tmp_path / "damaged.json").write_text('{"dtype": "compas.datastructures/Mesh", "data": {}}')
    assert "cannot be read as COMPAS data" in diagnose(tmp_path / "damaged.json").error


def test_the_verdict_is_that_of_loading(public_structure_path: Callable[[str], Path]) -> None:
    path = public_structure_path("topolite-chips-256")
    found = diagnose(path)
    if found.loads:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load_structure(path)
    else:
        with pytest.raises(InputError, match=re.escape(found.error)):
            load_structure(path)
        assert found.doubtful
    assert len(found.parts) == 256
