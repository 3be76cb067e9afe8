"""COMPAS data: what the real packages write is read, what is written they read, and nothing is lost on the way."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, export, load_structure
from falsework.assembly import ContactWarning
from falsework.cli.main import main
from falsework.errors import AssemblyError, InputError, MeshError, ReadWarning
from falsework.interop import to_compas
from falsework.interop.compas_read import READER as COMPAS

MODEL = "compas_model.models/Model"
KINDS = ("meshes", "assembly", "dem")


COMPAS_FORMATS = {"meshes": "compas", "assembly": "compas-assembly", "dem": "compas-dem"}


@pytest.fixture
def compas() -> Any:
    """The package itself."""
    return pytest.importorskip("compas", reason="needs compas; pip install compas")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spec", ["arch:blocks=7", "vault", "bottle"])
def test_there_and_back_without_the_packages(spec: str, kind: Any, tmp_path: Path) -> None:
    assembly = load_structure(spec)
    export(assembly, tmp_path / "out.json", format=COMPAS_FORMATS[kind])
    again = COMPAS.read(tmp_path / "out.json")
    assert again.identity == assembly.identity
    assert again.names == assembly.names


@pytest.mark.parametrize("kind", KINDS)
def test_there_and_back_through_the_packages(kind: Any, compas: Any, arch: Assembly, tmp_path: Path) -> None:
    pytest.importorskip("compas_assembly")
    pytest.importorskip("compas_dem")
    export(arch, tmp_path / "out.json", format=COMPAS_FORMATS[kind])
    compas.json_dump(compas.json_load(tmp_path / "out.json"), tmp_path / "again.json")
    again = COMPAS.read(tmp_path / "again.json")
    assert again.identity == arch.identity
    assert again.names == arch.names


def test_compas_assembly_sees_blocks_supports_and_interfaces(compas: Any, arch: Assembly, tmp_path: Path) -> None:
    pytest.importorskip("compas_assembly")
    export(arch, tmp_path / "out.json", format="compas-assembly")
    found = compas.json_load(tmp_path / "out.json")
    assert [block.volume() for block in found.blocks()] == pytest.approx(arch.mass.volume)
    supports = [found.graph.node_attribute(node, "is_support") for node in found.graph.nodes()]
    assert supports == arch.boundary.tolist()
    assert {tuple(edge) for edge in found.graph.edges()} == {tuple(pair) for pair in arch.contacts.parts.tolist()}
    for number, (a, b) in enumerate(arch.contacts.parts.tolist()):
        (interface,) = found.graph.edge_attribute((a, b), "interfaces")
        assert interface.size == pytest.approx(arch.contacts.areas[number])
        assert interface.polygon.area == pytest.approx(arch.contacts.areas[number])
        assert np.allclose(interface.frame.zaxis, arch.contacts.normals[number])


def test_a_line_is_an_interface_of_two_points(compas: Any, beam_on_ridge: Assembly, tmp_path: Path) -> None:
    pytest.importorskip("compas_assembly")
    export(beam_on_ridge, tmp_path / "out.json", format="compas-assembly")
    (interface,) = compas.json_load(tmp_path / "out.json").graph.edge_attribute((1, 2), "interfaces")
    assert np.allclose(interface.points, beam_on_ridge.contacts.points[-2:])
    assert interface.size == pytest.approx(beam_on_ridge.contacts.areas[1])
    with pytest.warns(ContactWarning):
        assert COMPAS.read(tmp_path / "out.json").identity == beam_on_ridge.identity


def test_compas_dem_finds_the_same_contacts(compas: Any, arch: Assembly, tmp_path: Path) -> None:
    pytest.importorskip("compas_dem")
    export(arch, tmp_path / "out.json", format="compas-dem")
    model = compas.json_load(tmp_path / "out.json")
    assert [element.is_support for element in model.elements()] == arch.boundary.tolist()
    model.compute_contacts(tolerance=1e-4, minimum_area=1e-4)
    area = sum(contact.size for contact in model.contacts())
    assert area == pytest.approx(float(arch.contacts.areas.sum()), rel=1e-3)


def test_an_assembly_made_with_compas_assembly(compas: Any, tmp_path: Path) -> None:
    datastructures = pytest.importorskip("compas_assembly.datastructures")
    from compas.geometry import Box, Translation

    model = datastructures.Assembly(name="tower")
    for level in range(3):
        block = datastructures.Block.from_shape(Box(1.0).transformed(Translation.from_vector([0, 0, level + 0.5])))
        model.add_block(block, is_support=level == 0)
    compas.json_dump(model, tmp_path / "tower.json")
    tower = COMPAS.read(tmp_path / "tower.json", friction=0.7)
    assert tower.boundary.tolist() == [True, False, False]
    assert tower.mass.volume == pytest.approx(1.0)
    assert tower.mass.center[:, 2] == pytest.approx([0.5, 1.5, 2.5])
    assert len(tower.contacts) == 2
    assert tower.friction == 0.7


def test_a_model_of_compas_dem_with_transformations(compas: Any, tmp_path: Path) -> None:
    elements = pytest.importorskip("compas_dem.elements")
    models = pytest.importorskip("compas_dem.models")
    from compas.datastructures import Mesh
    from compas.geometry import Box, Rotation, Translation

    model = models.BlockModel("tower")
    mesh = Mesh.from_shape(Box(2.0, 1.0, 1.0))
    foot = elements.Block.from_mesh(mesh, is_support=True, name="foot")
    model.add_element(foot)
    # A child of a turned and lifted parent, itself lifted: places multiply down the tree.
    turned = Translation.from_vector([0, 0, 1]) * Rotation.from_axis_and_angle([0, 0, 1], np.pi / 2)
    middle = elements.Block.from_mesh(mesh, transformation=turned, name="middle")
    model.add_element(middle)
    top = elements.Block.from_mesh(mesh, transformation=Translation.from_vector([0, 0, 1]), name="top")
    model.add_element(top, parent=middle)
    model.transformation = Translation.from_vector([10, 0, 0])
    compas.json_dump(model, tmp_path / "tower.json")
    tower = COMPAS.read(tmp_path / "tower.json")
    assert tower.names == ("foot", "middle", "top")
    assert tower.boundary.tolist() == [True, False, False]
    for element, mesh_of in zip(model.elements(), tower.meshes, strict=True):
        points = np.array([element.modelgeometry.vertex_coordinates(v) for v in element.modelgeometry.vertices()])
        assert np.allclose(mesh_of.bounds, [points.min(axis=0), points.max(axis=0)])


def test_meshes_and_shapes_in_a_dictionary_in_millimetres(compas: Any, tmp_path: Path) -> None:
    from compas.datastructures import Mesh
    from compas.geometry import Box, Frame, Point

    box = Mesh.from_shape(Box(1000.0))
    content = {"site": {"foot": box, "head": Box(1000.0, frame=Frame([0, 0, 1000], [0, 1, 0], [-1, 0, 0]))}}
    compas.json_dump({**content, "north": Point(0, 1, 0)}, tmp_path / "model.json")
    with pytest.warns(ReadWarning, match=r"what bounds no solid was left out: 1 compas\.geometry/Point"):
        model = COMPAS.read(tmp_path / "model.json", unit="mm", boundary=[0])
    assert model.mass.volume == pytest.approx(1.0)
    assert model.mass.center[:, 2] == pytest.approx([0.0, 1.0])
    assert len(model.contacts) == 1


def test_the_same_structure_gives_the_same_file(arch: Assembly) -> None:
    for kind in KINDS:
        assert json.dumps(to_compas(arch, kind)) == json.dumps(to_compas(load_structure("arch:blocks=7"), kind))


def test_the_command_line_takes_it_for_a_structure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*words: str | Path) -> int:
        return main([str(word) for word in words])

    model, plan = tmp_path / "model.json", tmp_path / "plan.json"
    assert run("export", "arch:blocks=5", "--format", "compas-dem", "--out", model) == 0
    assert run("plan", model, "--out", plan) == 0
    assert run("check", plan) == 0
    assert json.loads(plan.read_text())["structure"]["source"] == {"path": "model.json"}
    assert run("plan", model, "--unit", "furlong", "--out", plan) == 2
    assert "furlong" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["assembly", "dem"])
def test_the_name_of_a_structure_comes_back(kind: Any, arch: Assembly, tmp_path: Path) -> None:
    export(arch.replace(name="north arch"), tmp_path / "out.json", format=COMPAS_FORMATS[kind])
    assert load_structure(tmp_path / "out.json").name == "north arch"
    data = json.loads((tmp_path / "out.json").read_text())
    data["data"].get("attributes", {}).pop("name", "")
    data["name"] = data["dtype"].partition("/")[2]  # as COMPAS calls what has no name
    (tmp_path / "out.json").write_text(json.dumps(data))
    assert load_structure(tmp_path / "out.json").name == "out"


def box(**changes: Any) -> dict[str, Any]:
    """A mesh as COMPAS writes it, with changes."""
    mesh = to_compas(load_structure("arch:blocks=3"), "meshes")[0]
    return {**mesh, "data": {**mesh["data"], **changes}}


def shape(kind: str, xaxis: list[float] | None = None, **sizes: float) -> str:
    """A shape of COMPAS in a file."""
    frame = {"point": [0, 0, 0], "xaxis": xaxis or [1, 0, 0], "yaxis": [0, 1, 0]}
    return json.dumps([{"dtype": f"compas.geometry/{kind}", "data": {"frame": frame, **sizes}}])


def named(name: str, **attributes: Any) -> dict[str, Any]:
    """A mesh with a name and attributes."""
    return {**box(attributes=attributes), "name": name}


@pytest.mark.parametrize(
    ("content", "kind", "hint"),
    [
        ("{", InputError, "it is not valid JSON at line 1, column 2; it may be truncated"),
        ('{"dtype": "compas.geometry/Point", "data": [0, 0, 0]}', InputError, "no block"),
        ("[]", InputError, "no block"),
        (json.dumps([box(vertex=3)]), InputError, r"\[0\]\.data\.vertex is 3; give an object"),
        (json.dumps([box(vertex={"0": {"x": "left"}})]), InputError, r"data\.vertex\.0\.x is 'left'; give a number"),
        (json.dumps([box(vertex={"0": {"x": 1e999}})]), InputError, r"data\.vertex\.0\.x is not finite; give a number"),
        (
            json.dumps([box(face={"0": [0, 1, 77]})]),
            InputError,
            r"\[0\]\.data\.face\.0 uses the vertex 77, which does not",
        ),
        (
            json.dumps([box(face={"0": [0, 1, True]})]),
            InputError,
            r"\[0\]\.data\.face\.0\[2\] is True; give a whole number",
        ),
        (json.dumps([box(vertex={"0": {"x": None}})]), InputError, r"data\.vertex\.0\.x is None; give a number"),
        (
            json.dumps([box(attributes={"density": "x"})]),
            InputError,
            r"attributes\.density is 'x'; give a number \(kg/m3\)",
        ),
        (json.dumps([{**box(), "inheritance": 1}]), InputError, r"\[0\]\.inheritance is 1; give a list"),
        (json.dumps([{**box(), "name": []}]), InputError, r"\[0\]\.name is \[\]; give a number or a text"),
        (json.dumps([{**box(), "data": 3}]), InputError, r"\[0\]\.data is 3; give an object"),
        (json.dumps([{"dtype": "compas.datastructures/Mesh"}]), InputError, r"\[0\]\.data is missing"),
        (shape("Sphere", radius=-1), InputError, r"data\.radius is -1; give a number > 0"),
        (shape("Box", xsize=1, ysize=1), InputError, r"data\.zsize is missing"),
        (shape("Sphere", radius=1, xaxis=[0, 2, 0]), InputError, r"the axes of \[0\]\.data\.frame span no plane"),
        (json.dumps([box(face={"0": [0, 1]})]), MeshError, "face"),
        (json.dumps([box(face={})]), MeshError, "no faces"),
        (json.dumps([box(face={"0": [0, 1, 2]})]), MeshError, "not closed"),
        ("[" * 100_000, InputError, "nested deeper"),
        (json.dumps([named(str(mu), friction=mu) for mu in (0.1, 0.2)]), AssemblyError, "--friction"),
        (
            json.dumps({"dtype": "x/Y", "inheritance": ["compas_model.models/Model"], "data": {}}),
            InputError,
            r"data\.elements is missing; write it again with compas\.json_dump",
        ),
    ],
)
def test_what_cannot_be_read(content: str, kind: type[Exception], hint: str, tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text(content)
    with pytest.raises(kind, match=hint) as caught:
        COMPAS.read(tmp_path / "model.json")
    assert "\n" not in str(caught.value)


def test_no_such_file_and_no_such_kind(arch: Assembly, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        COMPAS.read(tmp_path / "model.json")
    with pytest.raises(InputError, match="meshes, assembly, dem"):
        to_compas(arch, "brep")  # type: ignore[arg-type]
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not text"):
        COMPAS.read(tmp_path / "bytes.json")
