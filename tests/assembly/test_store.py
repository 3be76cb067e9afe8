"""Assemblies on disk: nothing is lost on the way, and nothing half-written is left."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from falsework import Assembly, load_structure
from falsework.assembly.assembly_model import ContactEntry
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import AssemblyError, InputError, ReadWarning
from falsework.geometry import ContactSettings, TriangleMesh
from falsework.geometry.mesh.obj import obj_text

FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
     (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)  # fmt: skip
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
REAL = ["bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72"]


def box(name: str, low: tuple[float, ...], size: tuple[float, ...] = (1, 1, 1)) -> TriangleMesh:
    return TriangleMesh.from_arrays(name, np.asarray(low) + CORNERS * np.asarray(size), FACES)


@pytest.fixture
def assembly() -> Assembly:
    meshes = [box("sill", (0, 0, 0)), box("post", (0.1, 1 / 3, 1)), box("lintel", (0, 0, 2), (2, 2, np.pi))]
    return Assembly.from_meshes(
        meshes,
        boundary=[0],
        density=[1 / 3, 2.0, 3.0],
        friction=0.1 + 0.2,
        name="door",
        contact_settings=ContactSettings(gap=0.0003),
    )


@pytest.fixture
def folder(tmp_path: Path, assembly: Assembly) -> Path:
    return save_assembly(assembly, tmp_path / "door")


def edit(folder: Path, **changes) -> None:
    described = json.loads((folder / "assembly.json").read_text()) | changes
    kept = {key: value for key, value in described.items() if value is not None}
    (folder / "assembly.json").write_text(json.dumps(kept))


def test_nothing_is_lost(assembly: Assembly, folder: Path):
    back = load_assembly(folder)
    assert back.identity == assembly.identity
    assert back.names == assembly.names
    assert back.name == "door"
    assert back.contact_settings == assembly.contact_settings
    assert (back.contacts.points == assembly.contacts.points).all()
    assert json.loads((folder / "assembly.json").read_text())["format"] == "falsework.assembly/1"


@pytest.mark.parametrize("name", REAL)
def test_identity_of_real_structures_survives(shared_assembly, tmp_path: Path, name: str):
    assembly = load_assembly(shared_assembly(name))
    described = json.loads((shared_assembly(name) / "assembly.json").read_text())
    assert assembly.name == name
    assert np.flatnonzero(assembly.boundary).tolist() == described["boundary"]
    assert (assembly.density == described["density"]).all()
    assert assembly.friction == described["friction"]
    assert load_assembly(save_assembly(assembly, tmp_path / "copy")).identity == assembly.identity


def test_arguments_come_before_the_file(folder: Path):
    back = load_assembly(folder, friction=0.9, density=5.0, boundary=[1], contact_settings=ContactSettings())
    assert (back.friction, back.density.tolist(), back.boundary.tolist()) == (0.9, [5.0] * 3, [False, True, False])
    assert back.contact_settings == ContactSettings()
    assert load_assembly(folder, unit="dm").mass.volume[0] == pytest.approx(1e-3)


def test_boundary_by_name(folder: Path):
    edit(folder, boundary=["lintel", 0])
    assert load_assembly(folder).boundary.tolist() == [True, False, True]


def test_a_folder_without_description_stands_on_a_ground(tmp_path: Path):
    for part in range(2):
        (tmp_path / f"{part}.obj").write_text(obj_text(box(str(part), (0, 0, part))))
    with pytest.raises(AssemblyError, match=r"no part is boundary.*--ground"):
        load_assembly(tmp_path, boundary=[])
    with pytest.warns(ReadWarning, match="no part is fixed, so a ground was added under the lowest point"):
        unsaid = load_assembly(tmp_path)
    grounded = load_assembly(tmp_path, ground=True)
    assert unsaid.identity == grounded.identity
    assert unsaid.settlement is None
    assert grounded.names == ("0", "1", "ground")
    assert grounded.boundary.tolist() == [False, False, True]
    assert grounded.name == tmp_path.name
    assert load_assembly(tmp_path, boundary=[0]).friction == 0.55


def test_one_file_with_its_description_beside_it(tmp_path: Path):
    shifted = box("post", (0, 0, 1))
    lines = obj_text(box("sill", (0, 0, 0))) + f"o {shifted.name}\n"
    lines += "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in shifted.vertices.tolist())
    lines += "".join(f"f {a + 9} {b + 9} {c + 9}\n" for a, b, c in shifted.faces.tolist())
    (tmp_path / "pair.obj").write_text(lines)
    (tmp_path / "assembly.json").write_text(json.dumps({"boundary": ["sill"], "unit": "cm"}))
    back = load_assembly(tmp_path / "pair.obj")
    assert back.names == ("sill", "post")
    assert back.name == "pair"
    assert back.mass.volume == pytest.approx([1e-6, 1e-6])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "falsework.assembly/2"}, r"format 'falsework.assembly/2'; this version reads"),
        ({"friction": "high"}, "friction is 'high'; give a number"),
        ({"friction": True}, "friction is True; give a number"),
        ({"friction": -1}, "friction is -1"),
        ({"density": {}}, r"density is \{\}; give a number or a list"),
        ({"density": 0}, "density of part 0 is 0"),
        ({"boundary": 0}, "boundary is 0; give a list"),
        ({"boundary": [7]}, "boundary part 7 does not exist"),
        ({"boundary": [0, 0]}, "part 0 twice"),
        (
            {"boundary": ["roof"]},
            "assembly.json: boundary is part 'roof', which does not exist; give an id from 0 to 2",
        ),
        ({"boundary": [[0]]}, r"assembly\.json: boundary parts are \[\[0\]\]; give a list of part numbers or names"),
        (
            {"boundary": [[0, 1], [2]]},
            r"assembly\.json: boundary parts are \[\[0, 1\], \[2\]\]; give a list of part numbers or names",
        ),
        ({"boundary": [[0], "0"]}, "boundary parts are"),
        ({"boundary": []}, "--ground"),
        ({"unit": "furlong"}, "unknown unit 'furlong'"),
        ({"unit": 3}, "unit is 3; give a text"),
        ({"parts": 4}, "has 3 meshes, but assembly.json says 4"),
        ({"frictoin": 0.3}, "has the entry 'frictoin', which is unknown; write 'friction'"),
        ({"load": []}, "has the entry 'load', which is unknown; write 'loads'"),
        ({"names": ["a", "b"]}, "names in assembly.json must be 3"),
        ({"names": ["a", "a", "b"]}, "names in assembly.json must be 3"),
        ({"names": [1, 2, 3]}, r"names\[0\] is 1; give a text"),
        ({"contact": {"slack": 1}}, "contact.slack is not known; known are angle, corner"),
        ({"contact": {"gap": -1}}, "gap is -1"),
        ({"contact": {"gap": "wide"}}, "contact.gap is 'wide'; give a number"),
        ({"contact": {"gap": []}}, r"contact.gap is \[\]; give a number"),
        ({"contact": {"angle": True}}, "contact.angle is True; give a number"),
        ({"contact": []}, r"contact is \[\]; give an object"),
    ],
)
def test_a_wrong_description_gets_one_line(folder: Path, changes: dict, message: str):
    edit(folder, **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_assembly(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", '{"name": "x"', "[1]", "\x00"])
def test_a_damaged_description_gets_one_line(folder: Path, text: str):
    (folder / "assembly.json").write_text(text)
    with pytest.raises(AssemblyError, match=r"assembly\.json") as caught:
        load_assembly(folder)
    assert "\n" not in str(caught.value)


def test_saving_again_replaces_all_of_it(folder: Path, assembly: Assembly):
    pair = Assembly.from_meshes(assembly.meshes[:2], boundary=[0], name="pair")
    save_assembly(pair, folder)
    assert sorted(file.name for file in folder.iterdir()) == ["0.obj", "1.obj", "assembly.json"]
    assert [entry.name for entry in folder.parent.iterdir()] == ["door"], "nothing temporary is left"


def test_saving_does_not_touch_what_is_not_an_assembly(tmp_path: Path, assembly: Assembly):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not an assembly"):
        save_assembly(assembly, tmp_path)
    with pytest.raises(InputError, match="not an assembly"):
        save_assembly(assembly, tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_failure_while_writing_leaves_the_old_one(folder: Path, assembly: Assembly, monkeypatch):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}

    def full_disk(self: Path, *args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(InputError, match=r"cannot write .*No space left"):
        save_assembly(assembly, folder)
    monkeypatch.undo()
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert os.listdir(folder.parent) == ["door"]


def test_structures_by_path(folder: Path, assembly: Assembly):
    assert load_structure(folder).identity == assembly.identity
    assert load_structure(str(folder), friction=0.8, unit=None).friction == 0.8
    with pytest.raises(InputError, match="there is no"):
        load_structure(folder.parent / "nowhere")


def test_structures_by_name(folder: Path, monkeypatch):
    monkeypatch.chdir(folder.parent)
    folder.rename("arch")
    arch = load_structure("arch:blocks=9", friction=0.9, ground=True)
    assert arch.friction == 0.9
    assert arch.names[-1] == "ground"
    assert load_structure("./arch").name == "door", "a folder of the same name is reached by its path"
    free = np.flatnonzero(~arch.boundary)[:1].tolist()
    assert np.flatnonzero(load_structure("arch:blocks=9", boundary=free).boundary).tolist() == free
    with pytest.raises(InputError, match=r"structure 'arhc'; built in are arch"):
        load_structure("arhc")
    with pytest.raises(InputError, match="its own unit"):
        load_structure("arch:", unit="mm")
    with pytest.warns(ReadWarning, match="arch is a folder or file here, which is read, and .* which is arch:"):
        assert load_structure("arch").name == "door", "the user means what is there"
    assert load_structure("arch:").name == "arch"


def test_the_model_has_the_tolerances_of_contacts() -> None:
    assert structs.asdict(ContactEntry()) == asdict(ContactSettings())


def test_names_that_no_file_may_have_are_not_written(tmp_path: Path) -> None:
    meshes = [box("post", (0, 0, height)) for height in range(2)]
    with pytest.raises(InputError, match="2 parts have the name 'post'"):
        save_assembly(Assembly.from_meshes(meshes, boundary=[0]), tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
