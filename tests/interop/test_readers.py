"""Rhino and STEP files: units, layers, kinds of objects, and errors in one line."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import doctor, load_structure
from falsework.errors import DependencyError, InputError, ReadWarning
from falsework.geometry import RepairWarning

CUBE = [(1, 3, 2, 0), (6, 7, 5, 4), (4, 5, 1, 0), (3, 7, 6, 2), (2, 6, 4, 0), (5, 7, 3, 1)]
"""Faces of a box whose corners run through z, then y, then x."""

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux limits the memory of a process")


@pytest.fixture
def rhino(read_here: None) -> Any:
    return pytest.importorskip("rhino3dm", reason="needs rhino3dm; pip install 'falsework[rhino]'")


@pytest.fixture
def step_writer() -> Any:
    return pytest.importorskip("OCP.STEPControl", reason="needs cadquery-ocp; pip install 'falsework[step]'")


class Model:
    """Rhino file in the making."""

    def __init__(self, rhino: Any, unit: str = "Millimeters") -> None:
        self.rhino, self.file = rhino, rhino.File3dm()
        self.file.Settings.ModelUnitSystem = getattr(rhino.UnitSystem, unit)

    def layer(self, name: str) -> int:
        return self.file.Layers.AddLayer(name, (0, 0, 0, 255))

    def box(self, bottom: float, layer: int, name: str = "", size: float = 100.0) -> Any:
        mesh = self.rhino.Mesh()
        for x in (0, size):
            for y in (0, size):
                for z in (bottom, bottom + size):
                    mesh.Vertices.Add(x, y, z)
        for face in CUBE:
            mesh.Faces.AddFace(*face)
        attributes = self.rhino.ObjectAttributes()
        attributes.LayerIndex, attributes.Name = layer, name
        self.file.Objects.AddMesh(mesh, attributes)
        return mesh

    def sheet(self, layer: int, name: str) -> None:
        mesh = self.rhino.Mesh()
        for x, y in ((0, 0), (100, 0), (100, 100), (0, 100)):
            mesh.Vertices.Add(x, y, 0)
        mesh.Faces.AddFace(0, 1, 2, 3)
        attributes = self.rhino.ObjectAttributes()
        attributes.LayerIndex, attributes.Name = layer, name
        self.file.Objects.AddMesh(mesh, attributes)

    def write(self, path: Path) -> Path:
        self.file.Write(str(path), 8)
        return path


def test_layers_units_and_names_of_a_rhino_file(rhino: Any, tmp_path: Path) -> None:
    model = Model(rhino)
    supports, blocks, other = (model.layer(name) for name in ("supports", "Blocks", "Sketch"))
    model.box(0, supports, "base")
    model.box(100, blocks, "top")
    model.box(700, other, "far away")
    with pytest.warns(ReadWarning, match="parts beside the layer Blocks were left out: 1 on other layers"):
        assembly = load_structure(model.write(tmp_path / "model.3dm"))
    assert assembly.names == ("base", "top")
    assert assembly.boundary.tolist() == [True, False]
    assert assembly.mass.volume == pytest.approx(1e-3)
    assert len(assembly.contacts) == 1
    with pytest.warns(ReadWarning):
        assert load_structure(tmp_path / "model.3dm", unit="cm").mass.volume == pytest.approx(1.0)


def test_assembly_json_beside_a_file_is_read(rhino: Any, tmp_path: Path) -> None:
    model = Model(rhino)
    for number in range(2):
        model.box(100 * number, model.layer("Stones"), f"stone {number}")
    path = model.write(tmp_path / "model.3dm")
    (tmp_path / "assembly.json").write_text('{"boundary": ["stone 0"], "friction": 0.7, "density": 2000}')
    assembly = load_structure(path)
    assert assembly.boundary.tolist() == [True, False]
    assert assembly.friction == 0.7
    assert assembly.mass.mass == pytest.approx(2.0)
    assert load_structure(path, friction=0.3).friction == 0.3


@pytest.mark.usefixtures("rhino")
def test_extrusions_have_render_meshes(public_structure_path: Callable[[str], Path]) -> None:
    path = public_structure_path("formats/simple_stack.3dm")
    with pytest.warns(ReadWarning) as caught:
        assembly = load_structure(path, ground=True)
    texts = " ".join(str(warning.message) for warning in caught)
    assert "surfaces that are not solids were left out: 1 on layer Default" in texts
    assert "all objects are hidden; they were read as if they were visible" in texts
    assert assembly.part_count == 5
    assert assembly.mass.volume[:4] == pytest.approx(6e-9)
    assert len(np.unique(assembly.contacts.parts, axis=0)) == 4


def test_genevault_as_rhino_has_it(public_structure_path: Callable[[str], Path]) -> None:
    """Read in a process of its own."""
    pytest.importorskip("rhino3dm", reason="needs rhino3dm; pip install 'falsework[rhino]'")
    found = doctor(public_structure_path("formats/genevault.3dm"))
    assert any(remark.endswith("left out: 198 on layer RBE::Interfaces") for remark in found.remarks)
    assert any("hidden objects were left out: 6 on layer Default, 6 on" in remark for remark in found.remarks)
    assert found.loads
    assert len(found.parts) == 98
    assert not found.doubtful
    fixed = [report for report in found.parts if report.boundary]
    assert len(fixed) == 29
    assert {report.repairs for report in fixed} == {"given a thickness"}


def test_supports_that_are_surfaces_are_given_a_thickness(rhino: Any, tmp_path: Path) -> None:
    model = Model(rhino)
    supports, blocks = model.layer("Supports"), model.layer("Blocks")
    model.sheet(supports, "ground")
    model.sheet(blocks, "drawing")
    model.box(0, blocks, "stone")
    with pytest.warns((RepairWarning, ReadWarning)) as caught:
        assembly = load_structure(model.write(tmp_path / "model.3dm"))
    texts = [str(warning.message) for warning in caught]
    assert any("open surfaces (1, the first is part ground)" in text for text in texts)
    assert any(text.endswith("left out: 1 on layer Blocks") for text in texts)
    assert assembly.names == ("ground", "stone")
    assert assembly.boundary.tolist() == [True, False]
    assert assembly.meshes[0].bounds[:, 2] == pytest.approx([-np.sqrt(2) / 1000, 0])
    assert assembly.contacts.areas == pytest.approx([0.01])


def test_a_rhino_file_without_meshes(rhino: Any, tmp_path: Path) -> None:
    path = Model(rhino).write(tmp_path / "model.3dm")
    with pytest.raises(InputError, match="no mesh or solid"):
        load_structure(path)


def test_a_brep_without_a_render_mesh(rhino: Any, tmp_path: Path) -> None:
    model = Model(rhino)
    box = rhino.BoundingBox(rhino.Point3d(0, 0, 0), rhino.Point3d(1, 1, 1))
    model.file.Objects.AddBrep(rhino.Brep.CreateFromBox(rhino.Box(box)), None)
    with pytest.raises(InputError, match="has no render mesh"):
        load_structure(model.write(tmp_path / "model.3dm"))


def test_a_rhino_file_of_an_unknown_unit(rhino: Any, tmp_path: Path) -> None:
    model = Model(rhino, "Unset")
    for number in range(2):
        model.box(100 * number, model.layer("Supports" if number == 0 else "Parts"))
    path = model.write(tmp_path / "model.3dm")
    with pytest.raises(InputError, match="unit Unset, whose length is not known"):
        load_structure(path)
    assert load_structure(path, unit="mm").mass.volume == pytest.approx(1e-3)


@pytest.mark.parametrize("suffix", [".3dm", ".step"])
def test_a_missing_package_is_named(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rhino3dm", None)
    fake_open_cascade(tmp_path, monkeypatch, "", installed=False)
    (tmp_path / f"model{suffix}").write_text("?")
    with pytest.raises(DependencyError, match=r"pip install 'falsework\[(rhino|step)\]'"):
        load_structure(tmp_path / f"model{suffix}")


def fake_open_cascade(folder: Path, monkeypatch: pytest.MonkeyPatch, read: str, *, installed: bool = True) -> None:
    """Put packages named like those of Open CASCADE in its place, for the process that reads STEP files.

    Args:
        folder: for the packages.
        monkeypatch: of the test.
        read: what its reader does with a file.
        installed: whether they can be imported.
    """
    package = folder / "packages" / "OCP"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("" if installed else "raise ImportError")
    for module, content in {
        "BRepMesh": "BRepMesh_IncrementalMesh = None",
        "IFSelect": "IFSelect_RetDone = 1",
        "STEPControl": f"import os, sys\nclass STEPControl_Reader:\n    def ReadFile(self, path):\n        {read}",
        "TopAbs": "TopAbs_EDGE = TopAbs_FACE = TopAbs_SOLID = None",
        "TopExp": "TopExp_Explorer = None",
    }.items():
        (package / f"{module}.py").write_text(content + "\n")
    monkeypatch.setenv("PYTHONPATH", str(package.parent))


@pytest.mark.parametrize(
    ("read", "message"),
    [
        pytest.param("os.kill(os.getpid(), 11)", r"stopped \(SIGSEGV\)", marks=posix),
        pytest.param("os.abort()", r"stopped \(SIGABRT\)", marks=posix),
        ("os._exit(3)", r"stopped \(exit code 3\)"),
        pytest.param("bytearray(1 << 40)", "takes more memory than a file of its size may", marks=linux),
        ("print('noise'); return 2", "is not a STEP file, or is damaged; export it again"),
    ],
)
def test_a_step_file_cannot_end_the_process(
    read: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    fake_open_cascade(tmp_path, monkeypatch, read)
    (tmp_path / "model.step").write_text("?")
    with pytest.raises(InputError, match=message) as raised:
        load_structure(tmp_path / "model.step")
    assert str(tmp_path / "model.step") in str(raised.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("rhino")
def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "model.3dm").write_text("?")
    with pytest.raises(InputError, match="not a Rhino file"):
        load_structure(tmp_path / "model.3dm")


@pytest.fixture
def step_file(step_writer: Any, tmp_path: Path) -> Callable[..., Path]:
    """Write shapes of Open CASCADE, in millimetres, as a STEP file."""

    def write(*shapes: Any) -> Path:
        writer = step_writer.STEPControl_Writer()
        for shape in shapes:
            writer.Transfer(shape, step_writer.STEPControl_StepModelType.STEPControl_AsIs)
        writer.Write(str(tmp_path / "model.step"))
        return tmp_path / "model.step"

    return write


def test_solids_of_a_step_file(step_file: Callable[..., Path]) -> None:
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
    from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt

    drum = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(500, 500, 200), gp_Dir(0, 0, 1)), 300, 500).Shape()
    path = step_file(BRepPrimAPI_MakeBox(gp_Pnt(0, 0, 0), gp_Pnt(1000, 1000, 200)).Shape(), drum)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReadWarning)  # of the curved face
        assembly = load_structure(path, boundary=[0])
    assert assembly.mass.volume[0] == pytest.approx(0.2)
    assert assembly.mass.volume[1] == pytest.approx(np.pi * 0.3**2 * 0.5, rel=2e-3)
    assert assembly.contacts.areas.sum() == pytest.approx(np.pi * 0.3**2, rel=2e-3)
    with pytest.raises(InputError, match="leave out --unit"):
        load_structure(path, unit="mm")


def test_a_step_file_without_solids(step_file: Callable[..., Path], tmp_path: Path) -> None:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.gp import gp_Dir, gp_Pln, gp_Pnt

    plane = BRepBuilderAPI_MakeFace(gp_Pln(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), 0.0, 1.0, 0.0, 1.0).Face()
    with pytest.raises(InputError, match="has no solid"):
        load_structure(step_file(plane))
    (tmp_path / "text.step").write_text("?")
    with pytest.raises(InputError, match="not a STEP file"):
        load_structure(tmp_path / "text.step")
