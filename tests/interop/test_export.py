"""`falsework export`: what is written is what the name of the file says, and wrong input gets one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from falsework import Assembly, export, load_structure
from falsework.cli.main import main


def run(*words: str | Path | int | float) -> int:
    """The command in this process."""
    return main([str(word) for word in words])


@pytest.fixture
def plan_file(planned_once: Callable[..., bytes], tmp_path: Path) -> Path:
    """A plan for a small arch."""
    out = tmp_path / "plan.json"
    out.write_bytes(planned_once("arch:blocks=3"))
    return out


@pytest.mark.parametrize(
    ("name", "begins"),
    [("out.glb", b"glTF"), ("out.gltf", b'{"asset"'), ("out.usda", b"#usda 1.0"), ("out.usd", b"#usda 1.0")],
)
def test_the_name_says_the_format(name: str, begins: bytes, plan_file: Path, tmp_path: Path) -> None:
    for what in ("arch:blocks=3", plan_file):
        assert run("export", what, "--out", tmp_path / name) == 0
        assert (tmp_path / name).read_bytes().startswith(begins)


@pytest.mark.parametrize(
    ("form", "name", "message"),
    [
        ("glb", "out.pdf", "out.pdf has the ending of pdf, but glb is written; give a name that ends in .glb"),
        ("glb", "out.gltf", "out.gltf has the ending of gltf, but glb is written"),
        (
            "compas-dem",
            "out.glb",
            "out.glb has the ending of glb, but compas-dem is written; give a name that ends in .json",
        ),
        ("folder", "out.glb", "out.glb has the ending of glb, but folder is written; give a name without an ending"),
    ],
)
def test_a_name_that_says_another_format(
    form: str, name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", "arch:blocks=3", "--format", form, "--out", tmp_path / name) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_a_plan_says_how_long_a_step_takes(plan_file: Path, tmp_path: Path) -> None:
    assert run("export", plan_file, "--out", tmp_path / "out.gltf", "--step-seconds", 2.5) == 0
    scene = json.loads((tmp_path / "out.gltf").read_text())
    assert scene["extras"]["plan"]["steps"] == 6
    times = [
        accessor["max"][0] for accessor in scene["accessors"] if accessor["type"] == "SCALAR" and "max" in accessor
    ]
    assert max(times) == 15


def test_a_glb_is_a_structure_again(tmp_path: Path) -> None:
    assert run("export", "arch:blocks=5", "--out", tmp_path / "out.glb") == 0
    assert run("export", tmp_path / "out.glb", "--boundary", "springer-5,springer-6", "--out", tmp_path / "again") in (
        0,
        2,
    )
    again = load_structure(tmp_path / "out.glb", boundary=[0, 1])
    assert again.part_count == 7


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        (("--out", "out.json"), "cannot show a plan"),
        (("--out", "folder"), "cannot show a plan"),
        (("--out", "plan.obj"), "no export format ends in .obj"),
        (("--out", "out.glb", "--step-seconds", "0"), "0 seconds"),
        (("--out", "out.glb", "--step-seconds", "1e308"), "1e+308 seconds cannot be seen; give 0.001 to 1000"),
        (("--out", "no/out.glb"), "no folder"),
        (("--out", "out.glb", "--friction", "0.9"), "another structure"),
    ],
)
def test_what_a_plan_cannot_become(
    options: tuple[str, ...],
    hint: str,
    plan_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(plan_file.parent)
    before = sorted(plan_file.parent.iterdir())
    capsys.readouterr()
    assert run("export", plan_file, *options) == 2
    error = capsys.readouterr().err
    assert hint in error
    assert error.count("\n") == 1
    assert sorted(plan_file.parent.iterdir()) == before


def test_a_structure_has_no_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("export", "arch", "--out", tmp_path / "out.glb", "--step-seconds", 2) == 2
    assert "--step-seconds" in capsys.readouterr().err


def test_a_plan_of_another_version_is_still_taken_for_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "old.json").write_text('{"format": "falsework.plan/0"}')
    assert run("export", tmp_path / "old.json", "--out", tmp_path / "out.glb") == 2
    assert "this version reads 'falsework.plan/4' only" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["out.json", "out.usda", "out.glb"])
def test_joints_and_loads_are_left_out_with_a_warning(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tower.txt").write_text("2x4 (0,0,0)\n2x4 (0,0,1)\n")
    assert run("export", tmp_path / "tower.txt", "--out", tmp_path / name) == 0
    assert "have no joints: those of tower are left out" in capsys.readouterr().err
    assert run("export", "arch", "--load", "3=0,0,-10", "--out", tmp_path / name) == 0
    assert "have no loads: those of arch are left out" in capsys.readouterr().err


def test_names_of_several_lines_are_no_statements_of_a_folder(tmp_path: Path) -> None:
    arch = load_structure("arch:blocks=3")
    meshes = [replace(mesh, name=f"{mesh.name}\nv 0 0 0") for mesh in arch.meshes]
    named = Assembly.from_meshes(meshes, boundary=arch.boundary)
    export(named, tmp_path / "folder")
    read = load_structure(tmp_path / "folder")
    assert (read.names, read.identity) == (named.names, named.identity)
