"""The structures of the paper are made from a clone of its repository."""

from __future__ import annotations

import re
from pathlib import Path

import paper_structures
import pytest

import falsework as fw
from falsework.errors import InputError

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one structure: an arch in the place of bottle-12."""
    arch = fw.load_structure("arch:blocks=3")
    about = paper_structures.Published("tetris-1", arch.part_count, 100.0, (3, 4))
    monkeypatch.setattr(paper_structures, "STRUCTURES", {"bottle-12": about})
    folder = tmp_path / "clone" / "data" / "assembly" / "tetris-1"
    folder.mkdir(parents=True)
    for number, mesh in enumerate(arch.meshes):
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
        (folder / f"{number}.obj").write_text("\n".join(lines) + "\n")
    return tmp_path / "clone"


def test_a_clone_gives_a_structure(clone: Path, tmp_path: Path) -> None:
    folder = paper_structures.copy_structure("bottle-12", clone, tmp_path / "assemblies")
    found = fw.load_structure(folder)
    assert (found.name, found.part_count, found.friction) == ("bottle-12", 5, 0.55)
    assert found.boundary.nonzero()[0].tolist() == [3, 4]
    with pytest.raises(InputError, match="bottle-12 exists; remove it, or choose another --out"):
        paper_structures.copy_structure("bottle-12", clone, tmp_path / "assemblies")


def test_another_folder_is_refused_and_nothing_is_written(clone: Path, tmp_path: Path) -> None:
    (clone / "data" / "assembly" / "tetris-1" / "4.obj").unlink()
    with pytest.raises(InputError, match=re.escape("has no 4.obj; give a clone of github.com/KIKI007")):
        paper_structures.copy_structure("bottle-12", clone, tmp_path / "assemblies")
    assert not (tmp_path / "assemblies").exists()


def test_the_page_lists_what_the_script_makes() -> None:
    page = (REPOSITORY / "docs" / "reproduce-the-paper.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\w-]+) \| `([\w-]+)` \| (\d+) \| (\d+) \|", page, re.MULTILINE)
    made = {(n, a.folder, str(a.parts), str(len(a.boundary))) for n, a in paper_structures.STRUCTURES.items()}
    assert set(rows) == made


def test_they_are_those_of_the_tests(shared_assembly: object) -> None:
    for name, about in paper_structures.STRUCTURES.items():
        found = fw.load_structure(shared_assembly(name))  # type: ignore[operator]
        assert found.part_count == about.parts
        assert found.boundary.nonzero()[0].tolist() == list(about.boundary)
        assert found.friction == paper_structures.FRICTION
