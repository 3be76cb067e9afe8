"""Interfaces that COMPAS files store: taken as contacts, compared with those that are found, refused where they lie."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, export, load_structure
from falsework.assembly import ContactWarning, complete_state
from falsework.assembly.store import save_assembly
from falsework.cli.main import main
from falsework.errors import AssemblyError, ExportWarning, InputError
from falsework.interop.compas_read import READER as COMPAS
from falsework.interop.compas_read import read_compas
from falsework.stability.stiffness import normal_stiffness


@pytest.fixture
def written(arch: Assembly, tmp_path: Path) -> Path:
    export(arch, tmp_path / "arch.json", format="compas-assembly")
    return tmp_path / "arch.json"


def changed(path: Path, change: Callable[[list[dict[str, Any]]], Any]) -> Path:
    """Rewrite a file with another list of interfaces at its first edge."""
    data = json.loads(path.read_text())
    edges = data["data"]["graph"]["data"]["edge"]
    first = next(edge for others in edges.values() for edge in others.values())
    change(first["interfaces"])
    path.write_text(json.dumps(data))
    return path


def test_what_was_found_and_stored_comes_back(arch: Assembly, written: Path) -> None:
    found, stored = COMPAS.read(written), COMPAS.read(written, interfaces="stored")
    assert np.array_equal(stored.contacts.parts, arch.contacts.parts)
    assert np.allclose(stored.contacts.normals, arch.contacts.normals)
    assert np.allclose(stored.contacts.areas, arch.contacts.areas)
    assert found.identity == arch.identity
    assert stored.identity != arch.identity
    both = [
        StabilityOracle(assembly).verdicts(complete_state(arch.boundary), require_certificate=True)
        for assembly in (arch, stored)
    ]
    assert both[0].verdict.tolist() == both[1].verdict.tolist() == [1]


def test_lines_come_back_with_their_normals(beam_on_ridge: Assembly, tmp_path: Path) -> None:
    export(beam_on_ridge, tmp_path / "beam.json", format="compas-assembly")
    with pytest.warns(ContactWarning):
        stored = COMPAS.read(tmp_path / "beam.json", interfaces="stored")
    assert stored.contacts.dimension.tolist() == beam_on_ridge.contacts.dimension.tolist()
    assert np.allclose(stored.contacts.normals, beam_on_ridge.contacts.normals)


def test_order_of_corners_and_of_parts_does_not_matter(written: Path) -> None:
    before = COMPAS.read(written, interfaces="stored")
    after = COMPAS.read(changed(written, lambda some: some[0]["data"]["points"].reverse()), interfaces="stored")
    assert np.allclose(after.contacts.normals, before.contacts.normals)
    assert np.allclose(after.contacts.areas, before.contacts.areas)


def notch(some: list[dict[str, Any]]) -> None:
    """Cut a corner of the polygon between two corners, by one inside: its hull is the same."""
    points = some[0]["data"]["points"]
    first, second, *_ = points
    middle = [sum(point[k] for point in points) / len(points) for k in range(3)]
    points.insert(1, [0.4 * a + 0.4 * b + 0.2 * c for a, b, c in zip(first, second, middle, strict=True)])


def test_the_area_of_an_interface_is_part_of_what_a_structure_is(tmp_path: Path) -> None:
    """It decides how stiff the contact is, even where the corners of its hull are the same."""
    path = tmp_path / "stack.json"
    export(load_structure("stack"), path, format="compas-assembly")
    before = COMPAS.read(path, interfaces="stored")
    after = COMPAS.read(changed(path, notch), interfaces="stored")
    for name in ("frames", "points"):
        np.testing.assert_array_equal(getattr(after.contacts, name), getattr(before.contacts, name))
    assert (normal_stiffness(after) != normal_stiffness(before)).any()
    assert after.identity != before.identity


def test_comparison_says_what_differs(written: Path, recwarn: pytest.WarningsRecorder) -> None:
    COMPAS.read(written, interfaces="compare")
    assert not recwarn.list
    changed(written, lambda some: some.clear())
    with pytest.warns(ContactWarning, match="7 of 7 stored interfaces are found, 7 of them .* 1 pairs .* not stored: "):
        COMPAS.read(written, interfaces="compare")


def shift(some: list[dict[str, Any]]) -> None:
    for point in some[0]["data"]["points"]:
        point[2] += 5.0


def flatten(some: list[dict[str, Any]]) -> None:
    points = some[0]["data"]["points"]
    points[:] = [[(1 - t) * a + t * b for a, b in zip(*points[:2], strict=True)] for t in (0.0, 0.5, 1.0)]


@pytest.mark.parametrize(
    ("change", "says"),
    [(shift, r"do not fit the parts: that of .* m away from part"), (flatten, "has no area")],
)
def test_interfaces_that_do_not_fit_are_refused(change: Any, says: str, written: Path) -> None:
    changed(written, change)
    with pytest.raises(AssemblyError, match=says):
        COMPAS.read(written, interfaces="stored")
    assert COMPAS.read(written).part_count == 9


def test_an_interface_of_no_part_is_refused(written: Path) -> None:
    data = json.loads(written.read_text())
    edges = data["data"]["graph"]["data"]["edge"]
    edges["0"]["99"] = next(iter(edges["0"].values()))
    written.write_text(json.dumps(data))
    with pytest.raises(AssemblyError, match="a part that does not exist"):
        COMPAS.read(written, interfaces="stored")


def test_where_none_are_stored(tmp_path: Path, arch: Assembly) -> None:
    export(arch, tmp_path / "meshes.json", format="compas")
    for structure in (tmp_path / "meshes.json", "arch:blocks=5", save_assembly(arch, tmp_path / "folder")):
        with pytest.raises(InputError, match="stores no interfaces"):
            load_structure(structure, interfaces="stored")
        assert load_structure(structure, interfaces="found").part_count > 2


def test_given_contacts_are_kept_or_refused(written: Path, tmp_path: Path) -> None:
    stored = COMPAS.read(written, interfaces="stored")
    assert stored.replace(friction=0.9).contacts is stored.contacts
    with pytest.raises(AssemblyError, match="know no ground"):
        stored.with_ground()
    with pytest.raises(InputError, match="cannot keep"):
        save_assembly(stored, tmp_path / "folder")
    for name, form in (("out.glb", None), ("out.usda", None), ("out.json", "compas"), ("out.json", "compas-dem")):
        with pytest.warns(ExportWarning, match="have no given contacts: those of arch:blocks=7 are left out"):
            export(stored, tmp_path / name, format=form)
    export(stored, tmp_path / "out.json", format="compas-assembly")
    again = COMPAS.read(tmp_path / "out.json", interfaces="stored")
    np.testing.assert_allclose(again.contacts.areas, stored.contacts.areas)


def test_a_plan_remembers_where_its_contacts_came_from(written: Path, tmp_path: Path) -> None:
    plan = str(tmp_path / "plan.json")
    assert main(["stability", str(written), "--interfaces", "stored"]) == 0
    assert main(["plan", str(written), "--interfaces", "stored", "--out", plan]) == 0
    assert json.loads(Path(plan).read_text())["structure"]["source"]["interfaces"] == "stored"
    assert main(["check", plan, "--interfaces", "stored"]) == 0
    assert main(["check", plan]) == 3
    assert main(["check", plan, "--interfaces", "found"]) == 2


@pytest.mark.parametrize(
    ("name", "parts", "supports", "interfaces"),
    [
        ("armadillo_cra", 399, 33, 1014),
        ("compas_dem_problem_barrel", 121, 26, 320),
        ("compas_dem_blockmodel_old", 184, 4, 488),
    ],
)
def test_public_files(
    name: str, parts: int, supports: int, interfaces: int, public_structure_path: Callable[[str], Path]
) -> None:
    draft = read_compas(public_structure_path(f"formats/{name}.json"))
    assert len(draft.blocks) == parts
    assert len(draft.interfaces) == interfaces
    assembly = draft.assemble(interfaces="stored")
    assert assembly.boundary.sum() == supports
    assert len(assembly.contacts) == interfaces
    # Normals lead away from part `a`: the interface of two convex neighbours separates their centres.
    a, b = assembly.mass.center[assembly.contacts.parts.T]
    assert np.mean(np.einsum("ci,ci->c", b - a, assembly.contacts.normals) > 0) > 0.99


def test_a_problem_brings_density_and_friction(public_structure_path: Callable[[str], Path]) -> None:
    path = public_structure_path("formats/compas_dem_problem_barrel.json")
    assembly = load_structure(path, interfaces="stored")
    assert assembly.friction == pytest.approx(0.5)
    assert (assembly.density == 2000).all()
    assert load_structure(path, interfaces="compare").contacts.areas.sum() == pytest.approx(
        assembly.contacts.areas.sum(), rel=1e-6
    )


def test_a_problem_without_its_model(tmp_path: Path) -> None:
    (tmp_path / "problem.json").write_text('{"dtype": "compas_dem.problem/Problem", "data": {"model_id": "x"}}')
    with pytest.raises(InputError, match="names a model that is not in it"):
        load_structure(tmp_path / "problem.json")
    mesh = '{"dtype": "compas.datastructures/Mesh", "data": {"vertex": {}, "face": {}}}'
    (tmp_path / "problem.json").write_text(f'{{"dtype": "compas_dem.problem/Problem", "data": {{"model": {mesh}}}}}')
    with pytest.raises(
        InputError, match=r"data\.model is a compas\.datastructures/Mesh, not a BlockModel; write it again"
    ):
        load_structure(tmp_path / "problem.json")
