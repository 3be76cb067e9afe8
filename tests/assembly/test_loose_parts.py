"""Assemblies with clearance that nothing describes: they load with no setting, and come apart."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Outcome, find_plans, load_structure
from falsework.errors import ReadWarning, UntouchedPartError
from falsework.geometry import TriangleMesh
from falsework.search.plans.plan_check import validate_plan
from tests.assembly.test_settling import box, lid, wheel

NAMES = (
    "shaft in two bearings", "wheel between bearings", "two dowelled plates", "four dowelled plates", "rings on a post",
    "bolt with a head", "conical plug", "piston", "hinge", "drawer", "chest of three drawers", "lid with a lip",
    "sliding lid", "nested boxes", "tenon", "table", "tongued boards", "dovetail", "keyed shaft", "sleeve and cap",
)  # fmt: skip
CAD = ("asap-beam/original", "fabrica-beam", "fabrica-plumbers_block")
"""Not fabrica-car and fabrica-duct, which take longer than a test should: `benchmarks/contacts.py --loose` has both."""


@pytest.fixture
def loose(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The makers of the assemblies, which a benchmark times."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return import_module("loose_parts")


def plan_unasked(folder: Path) -> tuple[Any, list[str]]:
    """Load a folder with no setting; a plan of it is found and checked. The assembly, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assembly = load_structure(folder)
    result = find_plans(assembly, robots=2, deadline=60)
    assert result.outcome is Outcome.FOUND
    assert validate_plan(result.plans[0], assembly).good
    return assembly, [str(warning.message) for warning in caught]


def test_every_assembly_is_tested(loose: Any) -> None:
    assert tuple(loose.LOOSE) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_assemblies_with_clearance_load_with_no_setting_and_are_planned(name: str, loose: Any, tmp_path: Path) -> None:
    parts: Sequence[TriangleMesh] = loose.LOOSE[name]()
    assembly, messages = plan_unasked(loose.write_meshes(parts, tmp_path))
    assert any("no part is fixed, so a ground was added" in message for message in messages)
    assert assembly.part_count == len(parts) + 1
    assert sum("so parts settle into their clearance by at most" in message for message in messages) <= 1
    if assembly.settlement is not None:
        assert assembly.settlement.stopped.all()
        assert 0 < assembly.settlement.motion.max() < min(part.thickness for part in parts)


@pytest.mark.parametrize("name", CAD)
def test_published_assemblies_load_with_no_setting_and_are_planned(
    name: str, public_structure_path: Callable[[str], Path]
) -> None:
    plan_unasked(public_structure_path(f"cad/{name}"))


def test_only_what_nothing_describes_settles(loose: Any, tmp_path: Path) -> None:
    """Who names the fixed parts, or asks for a ground, is told that parts can settle."""
    folder = loose.write_meshes(wheel(), tmp_path)
    for setting in ({"boundary": ["0"]}, {"ground": True}, {"settle": 0.0}):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ReadWarning)
            with pytest.raises(UntouchedPartError, match=r"touches no other part.*let parts settle"):
                load_structure(folder, **setting)


def test_a_gap_larger_than_a_part_is_no_clearance(loose: Any, tmp_path: Path) -> None:
    apart = [box("low", (0, 0, 0), (0.1, 0.1, 0.02)), box("high", (0, 0, 0.05), (0.1, 0.1, 0.07))]
    with (
        pytest.warns(ReadWarning, match="a part touches no other, so parts settle"),
        pytest.warns(ReadWarning, match="nothing stopped part 1 within"),
        pytest.warns(ReadWarning, match="a ground was added"),
        pytest.raises(UntouchedPartError, match="part 1 touches no other part; part 0 is nearest"),
    ):
        load_structure(loose.write_meshes(apart, tmp_path))


def test_what_stands_with_clearance_stays(loose: Any, tmp_path: Path) -> None:
    """A block between two others that it does not touch; the gaps are those of a fit."""
    blocks = [box(str(n), (0.1001 * n, 0, 0), (0.1001 * n + 0.1, 0.1, 0.1)) for n in range(3)]
    with pytest.warns(ReadWarning, match="a ground was added"):
        assembly = load_structure(loose.write_meshes(blocks, tmp_path))
    assert assembly.clearance_hint
    assert assembly.settlement is None


def test_what_falls_settles_only_into_clearance(loose: Any, tmp_path: Path) -> None:
    """A column that leans too far is left as it is, and judged unstable."""
    blocks = [box(str(n), (0.04 * n, 0, 0.1 * n), (0.04 * n + 0.1, 0.1, 0.1 * n + 0.1)) for n in range(4)]
    with pytest.warns(ReadWarning, match="a ground was added"):
        assembly = load_structure(loose.write_meshes(blocks, tmp_path))
    assert assembly.settlement is None
    assert np.ptp(assembly.mass.center[:4, 0]) == pytest.approx(0.12)


def test_files_of_one_mesh_are_no_other_case(loose: Any, tmp_path: Path) -> None:
    folder = loose.write_meshes(lid(), tmp_path / "parts")
    lines, count = list[str](), 0
    for file in sorted(folder.glob("*.obj")):
        text = [line.split() for line in file.read_text().splitlines()]
        corners = [row for row in text if row and row[0] == "v"]
        faces = [[str(int(index.split("/")[0]) + count) for index in row[1:]] for row in text if row and row[0] == "f"]
        lines += [f"o {file.stem}", *map(" ".join, corners), *("f " + " ".join(face) for face in faces)]
        count += len(corners)
    (tmp_path / "model.obj").write_text("\n".join(lines) + "\n")
    with pytest.warns(ReadWarning, match="so parts settle"), pytest.warns(ReadWarning, match="a ground was added"):
        one = load_structure(tmp_path / "model.obj")
    with pytest.warns(ReadWarning):
        many = load_structure(folder)
    assert one.identity == many.identity
