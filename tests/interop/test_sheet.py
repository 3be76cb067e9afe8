"""The sheet for the site: a crew that follows it builds the plan, and nothing on it is out of reach of the printer."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Plan, Task, find_plans, load_structure, make_task
from falsework import sheet as make_sheet
from falsework.assembly.joints import Joints
from falsework.assembly.loads import Loads
from falsework.cli.main import main
from falsework.errors import PlanError
from falsework.interop.instruction_table import COLUMNS, describe_motion, instructions_csv


def table(plan: Plan, assembly: Assembly) -> list[dict[str, str]]:
    """The lines of the table."""
    return list(csv.DictReader(io.StringIO(instructions_csv(make_sheet(assembly, plan)))))


def test_who_follows_the_table_goes_through_the_states_of_the_plan(arch: Assembly, plan: Plan) -> None:
    lines = table(plan, arch)
    assert list(lines[0]) == list(COLUMNS)
    states = plan.states
    state, holding = states[0].copy(), {}
    for number, line in enumerate(lines, 1):
        assert int(line["step"]) == number
        part, support = int(line["part"]), int(line["support"])
        if line["do"] == "place":
            assert state[part] == 0
            assert support not in holding, "the support has its hands full"
            state[part], holding[support] = 2, part
            way = np.array([float(line[f"way_{axis}"]) for axis in "xyz"])
            direction = arch.clearance.exit_direction(states[number], part)
            assert direction is not None
            assert np.allclose(way, -direction, atol=1e-3)
        else:
            assert holding.pop(support) == part
            state[part] = 1
        assert np.array_equal(state, states[number])
        held = [f"{arch.names[part]} (support {support})" for support, part in sorted(holding.items())]
        assert line["hold"] == "; ".join(held)
        assert int(line["placed"]) == ((state > 0) & ~arch.boundary).sum()
        assert float(line["mass_kg"]) == pytest.approx(arch.mass.mass[part], rel=1e-5)
    assert not holding


def test_a_plan_that_starts_and_ends_half_way(arch: Assembly) -> None:
    start = np.array([1, 1, 2, 0, 2, 1, 1, 2, 2])
    task = Task.from_rules(arch.boundary, 3, start=[1, 1, 1, 1, 1, 1, 1, 2, 2], target=start, identity=arch.identity)
    found = find_plans(arch, task).plans[0]
    sheet = make_sheet(arch, found)
    assert sheet.start == (0, 1, 2, 4, 5, 6)
    assert [part for part, _ in sheet.holding(0)] == [2, 4]
    assert sheet.steps[0].place
    assert sheet.steps[0].parts == (3,)


def test_a_press_is_said_where_the_other_part_is_released(
    arch: Assembly, plan: Plan, press_once: Callable[..., tuple[Plan, int, int]]
) -> None:
    pressed, step, part = press_once(plan, (885.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    lines = table(pressed, arch)
    (said,) = [line for line in lines if line["press"]]
    assert (int(said["step"]), said["do"]) == (step, "release")
    support = said["hold"].partition("(")[2].rstrip(")")
    assert said["press"] == f"{arch.names[part]} with 885 N from -x by {support}"


def test_missing_parts_are_marked(arch: Assembly) -> None:
    task = Task.from_rules(arch.boundary, 2, missing=[3], identity=arch.identity)
    lines = table(find_plans(arch, task).plans[0], arch)
    assert [line["part"] for line in lines if line["needed"] == "yes"] == ["3"]


def test_names_do_not_become_formulas() -> None:
    from falsework.geometry import TriangleMesh

    arch = load_structure("arch:blocks=3")
    names = ('=HYPERLINK("http://x")', "+1", "@a", "-b", "c,d")
    meshes = [
        TriangleMesh.from_arrays(name, mesh.vertices, mesh.faces) for name, mesh in zip(names, arch.meshes, strict=True)
    ]
    named = Assembly.from_meshes(meshes, boundary=arch.boundary)
    lines = table(find_plans(named).plans[0], named)
    assert {line["name"] for line in lines} == {'\'=HYPERLINK("http://x")', "'+1", "'@a"}


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ((0, 0, -1), "from above"),
        ((0, 0, 1), "from below"),
        ((-1, 0, 0), "from +x"),
        ((0.7, 0, -0.7), "from -x and above"),
        ((-0.6, 0.6, -0.5), "from +x and -y and above"),
    ],
)
def test_ways_in_words(way: Any, words: str) -> None:
    assert describe_motion(np.array(way, dtype=float)) == words


def test_a_plan_for_another_structure(plan: Plan) -> None:
    with pytest.raises(PlanError, match="the structure that it was made for: arch:blocks=7"):
        make_sheet(load_structure("arch:blocks=5"), plan)


@pytest.fixture(scope="module")
def pdf(arch: Assembly, plan: Plan) -> bytes:
    """The sheet of the arch."""
    pytest.importorskip("reportlab", reason="needs reportlab; pip install 'falsework[sheet]'")
    from falsework.interop.instruction_pdf import instructions_pdf

    return instructions_pdf(make_sheet(arch, plan))


def test_the_pdf_has_all_pages_and_pictures(pdf: bytes, arch: Assembly, plan: Plan) -> None:
    """A cover with one picture, three views, and six rows on a page; a part that is released at once takes one row."""
    assert pdf.startswith(b"%PDF-")
    from falsework.interop.instruction_pdf import table_rows

    rows = table_rows(make_sheet(arch, plan))
    assert [step.number for row in rows for step in row] == list(range(1, 15))
    merged = [row for row in rows if len(row) == 2]
    assert merged
    assert all(row[0].parts == row[1].parts and row[0].place and not row[1].place for row in merged)
    assert len(re.findall(rb"/Type /Page\b", pdf)) == 2 + -(-len(rows) // 6)
    pictures = re.findall(rb"/Subtype /Image", pdf)
    assert len(pictures) == len(re.findall(rb"/DCTDecode", pdf)) == 4 + len(rows)


def text_of(pdf: bytes) -> str:
    """All words on the pages of a PDF."""
    pdfium = pytest.importorskip("pypdfium2", reason="needs pypdfium2, of the group test")
    document = pdfium.PdfDocument(pdf)
    about = document.get_metadata_dict()
    assert (about["Subject"], about["Author"]) == ("assembly instructions", "")
    words = "\n".join(page.get_textpage().get_text_bounded() for page in document).replace("\u00a0", " ")
    document.close()
    return words


def test_the_pdf_says_what_the_table_does(pdf: bytes, arch: Assembly, plan: Plan) -> None:
    words = text_of(pdf)
    found = re.findall(r"\b(PLACE|RELEASE)\b", words)
    assert [word.lower() for word in found] == [line["do"] for line in table(plan, arch)]
    for name, fixed in zip(arch.names, arch.boundary, strict=True):
        assert (name in words) == (not fixed)
    assert f"structure {arch.identity[:12]}" in words


def test_the_stock_list_has_mass_place_and_step_of_every_part(pdf: bytes, arch: Assembly, plan: Plan) -> None:
    stock = text_of(pdf).partition("Stock list")[2]
    for step in make_sheet(arch, plan).steps:
        if step.place:
            (part,) = step.parts
            x, y, z = arch.mass.center[part].round(3) + 0.0
            row = [arch.names[part], f"{arch.mass.mass[part]:.4g}", f"{x:.3f}, {y:.3f}, {z:.3f}", step.number]
            assert re.search(r"\s+".join(re.escape(str(entry)) for entry in row), stock), row


def test_the_setting_out_has_the_dimensions_of_fixed_parts_and_of_the_whole(pdf: bytes, arch: Assembly) -> None:
    words = text_of(pdf)
    assert "Setting out" in words
    boxes = np.array([mesh.bounds for mesh in arch.meshes])
    whole = np.ptp([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)], axis=0)
    fixed = boxes[arch.boundary]
    for length in (*whole, *fixed[:, :, 0].ravel(), *np.diff(np.unique(np.round(fixed[:, :, 0], 4)))):
        assert f"{round(1000 * length, 1):,.1f}".removesuffix(".0") in words, length


@pytest.mark.parametrize(
    ("points", "scale"), [(2834.7, 1.0), (2834.0, 2.0), (1400.0, 2.5), (57.0, 50.0), (56.0, 100.0), (30_000.0, 0.1)]
)
def test_drawings_have_usual_scales(points: float, scale: float) -> None:
    """The largest at which a metre takes at most so many points, 1/72 inch each."""
    from falsework.interop.setting_out import usual_scale

    assert usual_scale(points) == pytest.approx(scale)


def test_nothing_in_the_pdf_is_cut_short(tmp_path: Path) -> None:
    """Long names and margins, and masses of tons, are written in full."""
    pytest.importorskip("reportlab", reason="needs reportlab; pip install 'falsework[sheet]'")
    from falsework.interop.instruction_pdf import instructions_pdf

    arch = load_structure("arch:blocks=5")
    names = tuple(f"voussoir of the eastern transept, course {part}" for part in range(arch.part_count))
    long = Assembly.from_meshes(
        [replace(mesh, name=name) for mesh, name in zip(arch.meshes, names, strict=True)],
        boundary=arch.boundary,
        friction=arch.friction,
        density=60_000.0,
    )
    plan = find_plans(long, make_task(long)).plans[0]
    sheet = make_sheet(long, plan)
    said = "friction 0.364, tilt 2.48 deg, push 3.66 kN on the crown, load factor 12.3 of the weakest part, and more"
    sheet = replace(sheet, steps=tuple(replace(step, margins=said) for step in sheet.steps))
    words = " ".join(text_of(instructions_pdf(sheet)).split())
    assert "…" not in words
    assert said in words
    assert "e+" not in words
    for part in np.flatnonzero(~long.boundary):
        assert names[part] in words
        assert f"{long.mass.mass[part]:,.0f} kg" in words


def test_pictures_show_what_stands(arch: Assembly, plan: Plan) -> None:
    """With every part placed, more of the picture is covered; a held part has the colour of its support."""
    from falsework.interop.instruction_pdf import CAMERA
    from falsework.viewer.appearance import appearance_at
    from falsework.viewer.palette import robot_color, unit_rgb
    from falsework.viewer.pictures.contact_sheet import draw

    sheet = make_sheet(arch, plan)
    covered = []
    for step in sheet.steps:
        image = draw(arch, appearance_at(sheet.timeline, step.number, travelling=False), replace(CAMERA, samples=1))
        covered.append(int((image.max(axis=2) - image.min(axis=2) > 0.05).sum()))
        if step.place:
            red, green, blue = unit_rgb(robot_color(step.supports[0]))
            hue = np.array([red, green, blue]) / np.linalg.norm([red, green, blue])
            tint = image / np.maximum(np.linalg.norm(image, axis=2, keepdims=True), 1e-9)
            assert (np.abs(tint - hue).max(axis=2) < 0.06).sum() > 20
    places = [count for count, step in zip(covered, sheet.steps, strict=True) if step.place]
    assert places == sorted(places)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*words: str | Path) -> int:
        return main([str(word) for word in words])

    plan = tmp_path / "plan.json"
    assert run("plan", "arch:blocks=3", "--out", plan) == 0
    assert run("export", plan, "--out", tmp_path / "site.csv") == 0
    text = (tmp_path / "site.csv").read_bytes()
    assert text.startswith(b"\xef\xbb\xbfstep,")
    capsys.readouterr()
    for out, hint in (
        ("site.doc", "no export format ends in .doc; write .json, .csv, .glb, .gltf, .html, .pdf, .usd, .usda"),
        ("no/site.csv", "no folder"),
    ):
        assert run("export", plan, "--out", tmp_path / out) == 2
        assert hint in capsys.readouterr().err
    assert run("export", plan, "--out", tmp_path / "site.pdf", "--elevation", "90") == 2
    assert "elevation" in capsys.readouterr().err
    assert run("export", plan, "--out", tmp_path / "site.csv", "--azimuth", "30") == 2
    assert "--azimuth is no option of csv" in capsys.readouterr().err
    assert run("export", plan, "--out", tmp_path / "site.pdf", "--step-seconds", "1") == 2
    assert "--step-seconds is no option of pdf" in capsys.readouterr().err
    assert run("export", "arch:blocks=3", "--out", tmp_path / "site.pdf") == 2
    assert "pdf cannot show a structure; give a plan" in capsys.readouterr().err
    assert run("export", "arch:blocks=3", "--structure", "arch", "--out", tmp_path / "arch.glb") == 2
    assert "which arch:blocks=3 is not" in capsys.readouterr().err
    assert not (tmp_path / "site.pdf").exists()


def test_without_reportlab_the_extra_is_named(arch: Assembly, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    from falsework.errors import DependencyError
    from falsework.interop import instruction_pdf

    monkeypatch.setattr(instruction_pdf, "find_spec", lambda name: None)
    with pytest.raises(DependencyError, match=r"falsework\[sheet\].*\.csv"):
        instruction_pdf.instructions_pdf(make_sheet(arch, plan))


def test_joints_and_loads_on_which_the_proofs_rest_are_said(arch: Assembly) -> None:
    """A joint is made in the step that places the second of its parts; one of friction alone is none to be made."""
    entries = [{"friction": 0.9, "parts": [0, 1]}, {"tension": 1e4, "cohesion": 1e4, "parts": [2, 3]}]
    joints = Joints.from_entries(entries, None, arch.names, arch.contacts)
    loads = Loads.from_entries([{"part": 3, "force": [0, 0, -700]}], [0.01], arch.names, arch.mass.center)
    glued = arch.replace(joints=joints, loads=loads)
    plan = find_plans(glued, robots=3).unwrap()
    lines = table(plan, glued)
    placed = {int(line["part"]): line["join"] for line in lines if line["do"] == "place"}
    first, second = (part for part in placed if part in (2, 3))
    assert placed == dict.fromkeys(placed, "") | {second: f"voussoir-{second} with voussoir-{first}"}
    assert not any(line["join"] for line in lines if line["do"] == "release")
    pytest.importorskip("reportlab", reason="needs reportlab; pip install 'falsework[sheet]'")
    from falsework.interop.instruction_pdf import instructions_pdf

    words = " ".join(text_of(instructions_pdf(make_sheet(glued, plan))).split())
    assert words.count(f"JOIN voussoir-{second} with voussoir-{first}") == 1
    assert f"friction of at least {arch.friction:g} (0.9 in joints that have their own)" in words
    assert "the proofs hold with them only" in words
    assert "loads beside the weight: 700 N on voussoir-3, an acceleration of (0.01, 0, 0) g on all parts." in words
