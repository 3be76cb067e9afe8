"""Structures of other people are found, refused where they differ from the manifest, or skipped with the reason."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bench.__main__ import DONE, NO, WRONG, main
from bench.bricks import unpack
from bench.questions import CRITERIA, questions, questions_of
from bench.structures import BRICKS, HERE, MANIFEST, MOST_BRICKS, NotHereError, Structure, manifest, pinned, structures
from falsework import load_structure
from falsework.assembly.store import save_assembly
from falsework.errors import InputError
from tests.bench.conftest import CATENARY, Paper

EXTERNAL = [one for one in manifest().values() if not one.generated]
TOWER = "2x4 (0,0,0)\n2x4 (0,0,1)\n"


@pytest.fixture
def arch(data: Path) -> Structure:
    """A structure of somebody, in a clone of a repository, as the manifest would have it."""
    made = load_structure("arch:blocks=5")
    save_assembly(made, data / "somebody" / "meshes")
    boundary = [part for part, fixed in enumerate(made.boundary) if fixed]
    options = {"unit": "m", "density": 2000.0, "friction": 0.6, "boundary": boundary}
    bare = Structure(
        "an-arch", "test", 7, repository="github.com/x/somebody", commit="abc", path="meshes", options=options
    )
    return replace(bare, identity=bare.load(data).identity)


def test_the_manifest_says_where_each_structure_comes_from() -> None:
    for one in EXTERNAL:
        assert one.repository, one.name
        assert len(one.commit) == 40
        assert one.licence == "MIT"
        assert one.holder
        assert len(one.identity) == 64
        assert one.path or "converted" in one.note
    assert all(one.parts for one in manifest().values())
    assert {one.split for one in manifest().values()} | {BRICKS} == set(
        json.loads(MANIFEST.read_text(encoding="utf-8"))["splits"]
    )


def test_the_benchmark_carries_no_geometry() -> None:
    suffixes = {path.suffix for path in HERE.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert suffixes <= {".py", ".json", ".jsonl"}


def test_a_structure_is_read_with_the_options_of_the_manifest_alone(arch: Structure, data: Path) -> None:
    described = data / "somebody" / "meshes" / "assembly.json"
    assert described.is_file()
    described.write_text('{"friction": 0.1}', encoding="utf-8")
    found = arch.load(data)
    assert (found.friction, found.identity) == (0.6, arch.identity)


def test_it_is_found_under_its_name_too(arch: Structure, data: Path) -> None:
    (data / "structures").mkdir()
    (data / "somebody" / "meshes").rename(data / "structures" / "an-arch")
    assert arch.load(data).identity == arch.identity


def test_a_changed_file_is_refused(arch: Structure, data: Path) -> None:
    mesh = data / "somebody" / "meshes" / "3.obj"
    lines = mesh.read_text(encoding="utf-8").splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("v "))
    x, y, z = map(float, lines[at].split()[1:4])
    lines[at] = f"v {x} {y + 1e-9} {z}"
    mesh.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(NotHereError, match="other contents than the manifest says"):
        arch.load(data)


def test_a_file_that_cannot_be_read_is_a_reason_to_skip(arch: Structure, data: Path) -> None:
    (data / "somebody" / "meshes" / "3.obj").write_text("v 0 0\n", encoding="utf-8")
    with pytest.raises(NotHereError, match="an-arch cannot be read"):
        arch.load(data)
    for file in (data / "somebody" / "meshes").iterdir():
        file.unlink()
    with pytest.raises(NotHereError, match="has no meshes"):
        arch.load(data)


def test_what_is_not_here_is_skipped_with_the_source(
    data: Path, paper: Paper, capsys: pytest.CaptureFixture[str]
) -> None:
    paper.add("plan/contact/dog-35/2")
    assert main(["check", str(paper.path), "--data", str(data)]) == NO
    said = capsys.readouterr().out
    assert "skipped  1 question: dog-35 is not below" in said
    assert "github.com/KIKI007/LearningToAssemble at 0403bfd" in said
    assert main(["structures", "--only", "genevault-110", "--data", str(data)]) == DONE
    assert "no public file in a known format" in capsys.readouterr().out


def test_the_commands_that_fetch_sources_name_each_repository_once(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["structures", "--sources", "--data", str(data)]) == DONE
    said = capsys.readouterr().out.splitlines()
    repositories = {one.repository for one in EXTERNAL if one.path}
    assert len(said) == len(repositories)
    assert all(line.startswith("git clone https://github.com/") and str(data) in line for line in said)


def test_numbers_of_parts_and_hashes_are_filled_in(tmp_path: Path, data: Path) -> None:
    path = tmp_path / "structures.json"
    entries = [{"name": CATENARY, "split": "a"}, {"name": "nobody's", "split": "a", "path": "b", "repository": "x/y"}]
    path.write_text(json.dumps({"structures": entries}), encoding="utf-8")
    assert pinned(path, data) == 1
    written = json.loads(path.read_text(encoding="utf-8"))["structures"]
    assert written == [{**entries[0], "parts": 6}, entries[1]]


def test_a_structure_twice_in_a_manifest_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "structures.json"
    path.write_text(json.dumps({"structures": [{"name": "a", "split": "b"}] * 2}), encoding="utf-8")
    with pytest.raises(InputError, match="has a twice"):
        manifest(path)


def test_texts_of_bricks_make_a_split(data: Path) -> None:
    (data / BRICKS).mkdir()
    for number in range(MOST_BRICKS + 2):
        (data / BRICKS / f"model-{number:03d}.txt").write_text(TOWER, encoding="utf-8")
    found = [one for one in structures(data).values() if one.split == BRICKS]
    assert len(found) == MOST_BRICKS
    assert found[0].load(data).part_count == 3
    assert len(questions(data, splits=[BRICKS])) == 3 * MOST_BRICKS


def test_bricks_come_from_a_parquet_file(tmp_path: Path, data: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    def write(**columns: list[object]) -> Path:
        parquet.write_table(pyarrow.table(columns), tmp_path / "test.parquet")
        return tmp_path / "test.parquet"

    assert unpack(write(structure_id=["a-1", "b_2"], bricks=[TOWER, TOWER], captions=["x", "y"]), data) == 2
    assert structures(data)[f"{BRICKS}/a-1"].load(data).part_count == 3
    with pytest.raises(InputError, match="no column bricks, but captions"):
        unpack(write(captions=["x"]), data)
    with pytest.raises(InputError, match=r"structure '\.\./a', which makes no file"):
        unpack(write(structure_id=["../a"], bricks=[TOWER]), data)
    (tmp_path / "test.parquet").write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be read as a parquet file"):
        unpack(tmp_path / "test.parquet", data)


def test_an_unknown_split_is_refused(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["questions", "--splits", "lunar", "--data", str(data)]) == WRONG
    assert "no split 'lunar'" in capsys.readouterr().err


def test_questions_have_names_of_their_own_and_states_that_fit() -> None:
    found = list(questions_of(manifest()))
    assert len({question.name for question in found}) == len(found)
    assert {question.task for question in found} == set(CRITERIA)
    for question in found:
        if question.state:
            boundary = question.structure.options.get("boundary")
            assert len(question.state) == question.structure.parts
            if boundary is not None:
                assert all(question.state[part] == "2" for part in boundary)
                assert question.state.count("2") - len(boundary) <= question.robots
