"""Diagnosis: every fault is found, part by part, and what is proposed makes the structure load."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from falsework import doctor, load_structure
from falsework.assembly import ContactWarning
from falsework.cli.doctor import stands
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
    found = doctor(column)
    assert found.loads
    assert not found.doubtful
    assert not found.additions
    assert (found.contacts, len(found.parts)) == (2, 3)
    assert found.parts[1].volume == pytest.approx(1.0)
    assert [report.boundary for report in found.parts] == [True, False, False]
    assert main(["doctor", str(column)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "it loads"


def test_faces_that_touch_without_being_parallel(column: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The top of the lowest cube leans by 2 degrees; that of the next one by less than is reported."""
    for level, rise in ((0, 2.0), (1, 0.9)):
        path = column / f"{level}.obj"
        lower = level + 1 - np.tan(np.radians(rise))
        text = path.read_text()
        for y in (0, 1):
            text = text.replace(f"v 1 {y} {level + 1}\n", f"v 1 {y} {lower:.9f}\n")
        path.write_text(text)
    add(column, {"contact": {"gap": 0.05}})
    with warnings.catch_warnings():
        warnings.simplefilter("error", ContactWarning)
        found = doctor(column)
    (finding,) = found.remarks
    assert "of parts 0 and 1 (2 deg): contacts bear what both" in finding
    assert main(["doctor", str(column)]) == 0
    assert finding in capsys.readouterr().out
    with pytest.warns(ContactWarning, match="inclined to each other by 2 deg at least, more than friction of 0.01"):
        load_structure(column, friction=0.01)


def test_equal_findings_share_a_line(column: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of parts that lie apart each finding is its own; open ones are alike."""
    for number in range(3, 11):
        write_box(column, f"{number}", (3, 3 * number, 0), (4, 3 * number + 1, 1), faces=7)
    write_box(column, "11", (9, 0, 0), (10, 1, 1), faces=9)
    assert main(["doctor", str(column)]) == 1
    lines = capsys.readouterr().out.splitlines()
    alike = [line for line in lines if line.startswith("  8 parts (3, 4, 5, 6, 7 and 3 more): is not closed")]
    assert len(alike) == 1
    assert "doubtful: 9 parts" in lines
    assert any(line.startswith("  part 11 ") for line in lines)


def test_all_faults_at_once(column: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_box(column, "3", (3, 0, 0), (4, 1, 1), faces=7)
    write_box(column, "4", (0, 0, 2), (1, 1, 3))
    write_box(column, "5", (0, 0, 3), (0.05, 0.05, 3.05))
    write_box(column, "6", (7, 0, 0), (8, 1, 1))
    assert main(["doctor", str(column), "--json", "--picture", str(tmp_path / "column.png")]) == 1
    record = json.loads(capsys.readouterr().out)
    findings = {report["name"]: " ".join(report["findings"]) for report in record["parts"]}
    assert "is not closed" in findings["3"]
    assert "is a duplicate of part 2" in findings["4"]
    assert "passes through part 2" in findings["4"]
    assert "is tiny" in findings["5"]
    assert "touches no other part; part" in findings["6"]
    assert not findings["0"]
    assert not findings["1"]
    assert not record["loads"]
    assert not record["loads_with_it"]
    assert record["parts"][3]["volume_m3"] is None
    assert (tmp_path / "column.png").stat().st_size > 1000


def test_mended_parts_are_named(column: Path) -> None:
    write_box(column, "2", (0, 0, 2), (1, 1, 3), faces=10)  # the last side is missing
    found = doctor(column)
    assert found.loads
    assert found.parts[2].repairs == "closed flat holes"
    assert not found.parts[1].repairs


def test_what_is_divided_between_two_parts_is_no_fault(column: Path) -> None:
    write_box(column, "2", (0, 0, 1.996), (1, 1, 3))
    assert doctor(column).loads
    with pytest.warns(ContactWarning, match="overlap up to 4 mm"):
        assert load_structure(column).part_count == 3


def test_depth_of_every_overlap_and_not_of_joints(column: Path) -> None:
    """Overlaps that a joint divides are no fault; those of another size are, with their depth."""
    write_box(column, "2", (0, 0, 1.9), (1, 1, 3))
    write_box(column, "3", (0.2, 0.2, 2.5), (0.8, 0.8, 3.5))
    found = doctor(column)
    assert not found.loads
    assert [len(report.findings) for report in found.parts] == [0, 0, 1, 1]
    (finding,) = found.parts[2].findings
    assert re.fullmatch(r"passes through part 3 by 4[89]\d mm", finding)
    assert not found.additions


def test_lengths_that_are_given_may_be_the_fault(column: Path) -> None:
    write_box(column, "2", (0, 0, 1.996), (1, 1, 3))
    add(column, {"contact": {"gap": 0.001, "overlap": 0.001}})
    found = doctor(column)
    assert not found.loads
    assert found.parts[2].findings == ("passes through part 1 by 4 mm",)
    assert any("it loads without the lengths gap and overlap" in remark for remark in found.remarks)


def test_a_support_that_is_a_surface_is_mended(column: Path) -> None:
    (column / "0.obj").write_text("v -1 -1 1\nv 2 -1 1\nv 2 2 1\nv -1 2 1\nf 1 2 3 4\n")
    found = doctor(column)
    assert found.loads
    assert found.parts[0].repairs == "given a thickness"
    assert not found.doubtful


def test_boundary_and_unit_are_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for level in range(3):
        write_box(tmp_path, f"{level}", (0, 0, 300 * level), (300, 300, 300 * level + 300))
    found = doctor(tmp_path)
    assert found.units == ("mm",)
    assert found.additions == {"unit": "mm", "boundary": [0]}
    assert found.cured
    assert any("no part is fixed, so a ground was added" in remark for remark in found.remarks)
    assert main(["doctor", str(tmp_path)]) == 0
    last = capsys.readouterr().out.splitlines()[-2:]
    assert last == ["it loads", 'add to assembly.json: "unit": "mm", "boundary": [0]']
    assert doctor(tmp_path, "mm").additions == {"boundary": [0]}


def test_proposals_are_those_for_the_likely_unit(tmp_path: Path) -> None:
    """Parts that are too large for the unit of the file count all the same, here the only one on the ground."""
    write_box(tmp_path, "bed", (0, 0, 0), (1500, 300, 100))
    for level in range(3):
        write_box(tmp_path, f"stone{level}", (0, 0, 300 * level + 100), (300, 300, 300 * level + 400))
    found = doctor(tmp_path)
    assert found.additions == {"unit": "mm", "boundary": ["bed"]}
    assert found.cured
    assert found.extent == pytest.approx((1.5, 0.3, 1.0))
    assert found.contacts == 3
    assert "parts must be 0.1 mm to 1 km" in found.error
    assert found.remarks[0] == "a typical part would be 520 m long: the unit is taken to be mm"


def test_what_is_proposed_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for level in range(3):
        write_box(tmp_path, f"s{level}", (0, 0, 300 * level), (300, 300, 300 * level + 300))
    assert main(["doctor", str(tmp_path), "--friction", "0.5", "--write"]) == 0
    written = json.loads((tmp_path / "assembly.json").read_text())
    assert written == {"unit": "mm", "boundary": ["s0"], "friction": 0.5}
    assert "all together 300 mm by 300 mm and 900 mm high" in capsys.readouterr().out
    assert load_structure(tmp_path).friction == 0.5
    assert main(["doctor", str(tmp_path), "--density", "99", "--write"]) == 2
    assert "is there already and stays as it is; nothing is missing in it" in capsys.readouterr().err
    assert json.loads((tmp_path / "assembly.json").read_text()) == written


def test_proposals_stand_beside_a_single_file(tmp_path: Path) -> None:
    path = write_wall(tmp_path / "wall.obj")
    assert main(["doctor", str(path), "--write"]) == 0
    assert "boundary" in json.loads((tmp_path / "assembly.json").read_text())
    assert load_structure(path).boundary.any()


@pytest.mark.parametrize(
    ("size", "options", "message"),
    [
        (50, (), "is not written: the unit may be mm or cm or in; say which by --unit"),
        (1, ("--boundary", "0", "--cell", "c.toml"), "--write is about the file of a structure; leave out the cell"),
        (1, ("--ground",), "loads as it is, and no option is given to be kept"),
    ],
)
def test_nothing_is_written_in_doubt(
    tmp_path: Path, size: int, options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for level in range(2):
        write_box(tmp_path, f"{level}", (0, 0, size * level), (size, size, size * level + size))
    assert main(["doctor", str(tmp_path), *options, "--write"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "assembly.json").exists()


def test_files_that_cannot_be_read_are_parts_in_doubt(column: Path) -> None:
    (column / "1.obj").write_text("v 0 0 zero\n")
    found = doctor(column)
    assert found.parts[1].findings
    assert "touches no other part" in found.parts[2].findings[0]


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no"):
        doctor(tmp_path / "nothing")
    assert "no mesh" in doctor(tmp_path).error
    (tmp_path / "damaged.json").write_text('{"dtype": "compas.datastructures/Mesh", "data": {}}')
    assert "cannot be read as COMPAS data" in doctor(tmp_path / "damaged.json").error


def test_the_verdict_is_that_of_loading(public_structure_path: Callable[[str], Path]) -> None:
    path = public_structure_path("topolite-chips-256")
    found = doctor(path)
    if found.loads:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load_structure(path)
    else:
        with pytest.raises(InputError, match=re.escape(found.error)):
            load_structure(path)
        assert found.doubtful
    assert len(found.parts) == 256


BRICKS = [
    ((c * 2.0 + r % 2, 0, r * 0.5), (c * 2.0 + 2 + r % 2, 0.5, r * 0.5 + 0.5)) for r in range(3) for c in range(5)
]
"""A wall of three courses of five bricks, 2 m long each."""


def write_wall(path: Path, turn: Callable[[np.ndarray], np.ndarray] = lambda points: points) -> Path:
    """Write the wall as one OBJ file."""
    lines = []
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    for number, (low, high) in enumerate(BRICKS):
        points = turn(np.where(corners, high, low))
        lines += [f"o brick-{number}", *(f"v {x} {y} {z}" for x, y, z in points)]
        lines += [f"f {a + 1 + 8 * number} {b + 1 + 8 * number} {c + 1 + 8 * number}" for a, b, c in BOX]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_one_file_and_a_folder_get_the_same_advice(tmp_path: Path) -> None:
    folder = tmp_path / "wall"
    folder.mkdir()
    for number, (low, high) in enumerate(BRICKS):
        write_box(folder, f"brick-{number}", low, high)
    one, many = doctor(write_wall(tmp_path / "wall.obj")), doctor(folder)
    for found in (one, many):
        assert [report.size for report in found.parts] == pytest.approx([np.sqrt(4 + 0.25 + 0.25)] * 15)
        assert found.additions == {"boundary": [f"brick-{number}" for number in range(5)]}
        assert found.cured
    assert [remark.replace(".obj:", ":") for remark in one.remarks] == list(many.remarks)


def test_an_open_part_is_told_as_it_is(tmp_path: Path) -> None:
    """Whatever the format; its support is proposed, and it is not."""
    for suffix in ("obj", "ply", "stl"):
        folder = tmp_path / suffix
        folder.mkdir()
        write_box(folder, "base", (0, 0, 0), (1, 1, 1))
        write_box(folder, "top", (0, 0, 1), (1, 1, 2), faces=7)
        if suffix != "obj":
            trimesh = pytest.importorskip("trimesh")
            trimesh.load(folder / "top.obj", process=False).export(folder / f"top.{suffix}")
            (folder / "top.obj").unlink()
        found = doctor(folder)
        assert found.error.startswith("part top is not closed")
        assert found.parts[1].size == pytest.approx(np.sqrt(3))
        assert found.additions == {"boundary": ["base"]}
        assert not found.cured


def test_no_advice_fixes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        write_box(tmp_path, f"slab-{number}", (number, 0, 0), (number + 1, 2, 0.5))
    found = doctor(tmp_path)
    assert not found.additions
    assert any("name them (--boundary), or put a --ground" in remark for remark in found.remarks)
    grounded = doctor(tmp_path, ground=True)
    assert grounded.loads
    assert "no part is boundary" not in grounded.remarks
    assert main(["doctor", str(tmp_path), "--boundary", "slab-0,slab-1,slab-2"]) == 0
    assert "every part is boundary: nothing can move" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "finding"),
    [
        ({"density": 2.4}, r"the density is 2\.4 kg/m3"),
        ({"density": [2400, 2400, 24000]}, "the density of part 2 is 24000 kg/m3"),
        ({"friction": 35.0}, "a coefficient of friction is 35"),
        ({"boundary": ["2"]}, "part 0 reaches lower than every part that is boundary"),
        ({"boundary": ["0-2"]}, "every part is boundary"),
        ({"density": 2400, "friction": 0.6}, ""),
    ],
)
def test_doubts_about_the_options(options: dict, finding: str, column: Path) -> None:
    remarks = " ".join(doctor(column, **options).remarks)
    assert re.search(finding, remarks) if finding else not remarks


def test_doubts_about_entries_of_the_file(column: Path) -> None:
    add(column, {"joints": [{"friction": 30}], "density": 24})
    remarks = " ".join(doctor(column).remarks)
    assert "friction is 30" in remarks
    assert "density is 24 kg/m3" in remarks


def test_y_up_is_seen(tmp_path: Path) -> None:
    """Of a wall all bricks lie at the lowest level then; of a table the plate hangs beside its legs."""
    turned = write_wall(tmp_path / "wall.obj", lambda points: points[:, [0, 2, 1]] * (1, 1, -1))
    found = doctor(turned, stands=stands)
    assert any("all parts lie on the ground" in remark for remark in found.remarks)
    assert "boundary" not in found.additions
    upright = doctor(write_wall(tmp_path / "wall.obj"), stands=stands)
    assert not any("y up" in remark for remark in upright.remarks)
    table = tmp_path / "table"
    table.mkdir()
    write_box(table, "plate", (0, 1, 0), (3, 1.2, 2))
    for number, x in enumerate((0, 2.5)):
        write_box(table, f"leg-{number}", (x, 0, 0.8), (x + 0.5, 1, 1.2))
    assert any("falls as it is, but would stand with y up" in one for one in doctor(table, stands=stands).remarks)


@pytest.mark.parametrize("spec", ["vault:parts=30", "dome:rings=3,blocks=8", "arch:blocks=9", "wall"])
@pytest.mark.parametrize("named", [False, True])
def test_which_way_is_up_is_seen_of_shells(tmp_path: Path, spec: str, named: bool) -> None:
    """Their stones may touch no other from above; whether they stand tells."""
    structure = load_structure(spec)
    boundary = [name for name, fixed in zip(structure.names, structure.boundary, strict=True) if fixed]
    for turned in (False, True):
        folder = tmp_path / str(turned)
        folder.mkdir()
        for mesh in structure.meshes:
            points = mesh.vertices[:, [0, 2, 1]] * (1, 1, -1) if turned else mesh.vertices
            lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
            (folder / f"{mesh.name}.obj").write_text("\n".join(lines))
        found = doctor(folder, stands=stands, boundary=boundary if named else None)
        assert any("y up" in remark for remark in found.remarks) == turned
        if not named:
            assert sorted(found.additions.get("boundary", [])) == ([] if turned else sorted(boundary))


def test_an_arch_that_stands_on_its_side(tmp_path: Path) -> None:
    """So does a straight vault of two rows: that none of its joints is inclined tells that it lies."""
    arch = load_structure("arch:blocks=8")
    for turned in (False, True):
        lines, first = list[str](), 1
        for row in range(2):
            for mesh in arch.meshes:
                points = mesh.vertices.copy()
                points[:, 1] = 0.2 * np.sign(points[:, 1]) + 0.4 * row  # abutments are wider
                points = points[:, [0, 2, 1]] * (1, 1, -1) if turned else points
                lines += [f"o {mesh.name}-{row}", *(f"v {x} {y} {z}" for x, y, z in points)]
                lines += [f"f {a + first} {b + first} {c + first}" for a, b, c in mesh.faces]
                first += len(points)
        path = tmp_path / f"{turned}.obj"
        path.write_text("\n".join(lines))
        found = doctor(path, stands=stands)
        assert any("if that is meant, export the model with z up" in one for one in found.remarks) == turned
        assert len(found.additions.get("boundary", [])) == (0 if turned else 4)


@pytest.mark.parametrize(
    ("third", "wrong"),
    [
        (((1, 0, 1), (1.6, 1, 2)), ""),
        (((0, 0, 2.01), (1, 1, 3)), "touches no other part"),
        (((0, 0, 1.5), (1, 1, 2.5)), "passes through"),
    ],
    ids=["hangs beside", "gap", "overlap"],
)
def test_other_faults_are_not_blamed_on_the_axis(
    tmp_path: Path, third: tuple[tuple[float, ...], tuple[float, ...]], wrong: str
) -> None:
    """With y up all bricks of a straight wall lie on the ground, and none of them hangs."""
    for number, (low, high) in enumerate((((0, 0, 0), (1, 1, 1)), ((0, 0, 1), (1, 1, 2)), third)):
        write_box(tmp_path, f"{number}", low, high)
    found = doctor(tmp_path)
    assert not any("y up" in remark for remark in found.remarks)
    assert found.additions == {"boundary": [0]}
    assert not wrong or any(wrong in finding for part in found.doubtful for finding in part.findings)


def test_detailed_parts_in_each_other_are_told_of_in_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Joints of parts that lie in each other would take minutes to find, and are not looked for."""
    around = 2 * np.pi * np.arange(60) / 60
    for number, shift in enumerate((0.0, 0.001)):
        ring = np.stack([np.cos(around) + shift, np.sin(around)], axis=1)
        points = np.concatenate([np.column_stack([ring, np.full(60, z)]) for z in (0, 1)])
        lines = [f"v {x} {y} {z}" for x, y, z in points]
        lines += [f"f {i + 1} {(i + 1) % 60 + 1} {(i + 1) % 60 + 61} {i + 61}" for i in range(60)]
        lines += ["f " + " ".join(map(str, range(60, 0, -1))), "f " + " ".join(map(str, range(61, 121)))]
        (tmp_path / f"{number}.obj").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr("falsework.assembly.doctor.find_joints", None)
    found = doctor(tmp_path)
    assert all("passes through" in part.findings[0] for part in found.parts)


@pytest.mark.parametrize("ground", [None, True])
def test_a_structure_in_which_nothing_can_move(tmp_path: Path, ground: bool | None) -> None:
    for level in range(2):
        write_box(tmp_path, f"{level}", (0, 0, level), (1, 1, level + 1))
    found = doctor(tmp_path, boundary=[0, 1], ground=ground)
    assert any("every part is boundary" in remark for remark in found.remarks)


def test_a_unit_is_proposed_only_where_there_is_one(tmp_path: Path) -> None:
    for level in range(2):
        write_box(tmp_path, f"{level}", (0, 0, 50 * level), (50, 50, 50 * level + 50))
    found = doctor(tmp_path)
    assert any("the unit may be mm or cm or in" in remark for remark in found.remarks)
    assert found.additions == {"boundary": [0]}
    assert found.units == ("mm", "cm", "in")


def test_what_was_read_in_another_way_is_told(tmp_path: Path) -> None:
    path = write_wall(tmp_path / "wall.obj")
    path.write_text(re.sub(r"o brick-\d+", "o brick", path.read_text()) + "l 1 2\n")
    remarks = " ".join(doctor(path).remarks)
    assert "15 objects are called brick" in remarks
    assert "left out: 1 of 'l'" in remarks


def test_a_fallen_vault_that_friction_might_hold_falls(tmp_path: Path) -> None:
    """Forces balance a vault on its side, but its parts slide: what counts is whether it stands from rest."""
    vault, lines, first = load_structure("vault:parts=30"), list[str](), 1
    for name, mesh in zip(vault.names, vault.meshes, strict=True):
        lines.append(f"o {name}")
        lines += [f"v {x:.6f} {z:.6f} {-y:.6f}" for x, y, z in mesh.vertices.tolist()]
        lines += ["f " + " ".join(str(corner + first) for corner in face) for face in mesh.faces.tolist()]
        first += len(mesh.vertices)
    path = tmp_path / "vault.obj"
    path.write_text("\n".join(lines))
    springers = np.flatnonzero(vault.boundary).tolist()
    found = doctor(path, stands=stands, boundary=springers)
    assert any("falls as it is, but would stand with y up" in remark for remark in found.remarks)


@pytest.mark.parametrize(("edge", "unit", "asked"), [(50.0, None, True), (0.5, None, False), (50.0, "m", False)])
def test_a_folder_whose_unit_nothing_says_is_not_read_in_silence(
    tmp_path: Path, edge: float, unit: str | None, asked: bool
) -> None:
    """Where its parts would have an unlikely size in metres; a unit that is given, or a description, is believed."""
    for level in range(2):
        write_box(tmp_path, f"{level}", (0, 0, level * edge), (edge, edge, (level + 1) * edge))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_structure(tmp_path, unit=unit)
    said = [str(warning.message) for warning in caught if "nothing says the unit" in str(warning.message)]
    assert bool(said) == asked
    if asked:
        assert "a typical part is 86.6 m long: give --unit mm or cm or in, or --unit m if that is right" in said[0]
    (tmp_path / "assembly.json").write_text('{"boundary": [0]}')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_structure(tmp_path)
    assert not any("nothing says the unit" in str(warning.message) for warning in caught)


def test_an_empty_path_is_not_the_present_folder() -> None:
    with pytest.raises(InputError, match="the structure has no name"):
        doctor("")
