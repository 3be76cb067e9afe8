"""Assemblies: what they refuse, what they keep, and what their identity depends on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly
from falsework.assembly import ContactWarning
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import AssemblyError
from falsework.geometry import ContactSettings, TriangleMesh

FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
     (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)  # fmt: skip
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])


def box(name: str, low: tuple[float, ...], size: tuple[float, ...] = (1, 1, 1)) -> TriangleMesh:
    return TriangleMesh.from_arrays(name, np.asarray(low) + CORNERS * np.asarray(size), FACES)


def stack(count: int = 3) -> list[TriangleMesh]:
    return [box(f"b{level}", (0, 0, level)) for level in range(count)]


def build(**changes) -> Assembly:
    options: dict[str, Any] = {"boundary": [0], "density": 2000.0, "friction": 0.5, "name": "stack"} | changes
    return Assembly.from_meshes(options.pop("meshes", stack()), **options)


def test_what_is_given_is_kept():
    assembly = build(density=[1.0, 2.0, 3.0], boundary=[2, 0])
    assert assembly.part_count == 3
    assert assembly.names == ("b0", "b1", "b2")
    assert assembly.boundary.tolist() == [True, False, True]
    assert assembly.mass.mass == pytest.approx([1, 2, 3])
    assert assembly.contacts.parts.tolist() == [[0, 1], [1, 2]]
    assert build(boundary=np.array([True, False, True])).boundary.tolist() == [True, False, True]
    for array in (assembly.boundary, assembly.density, assembly.mass.mass, assembly.contacts.points):
        assert not array.flags.writeable


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meshes": []}, "at least one part"),
        ({"boundary": []}, "--ground"),
        ({"boundary": [3]}, r"boundary part 3 does not exist; ids of parts are 0 to 2"),
        ({"boundary": [-1]}, "boundary part -1 does not exist"),
        ({"boundary": [0, 0]}, "part 0 twice"),
        ({"boundary": [0.5]}, "ids of parts"),
        ({"boundary": ["roof"]}, "boundary is part 'roof', which does not exist; give an id from 0 to 2 or a name"),
        ({"boundary": [True, False]}, r"mask has shape \(2,\)"),
        ({"friction": -0.1}, "friction is -0.1"),
        ({"friction": float("nan")}, "friction is nan"),
        ({"friction": "rough"}, "friction is 'rough'"),
        ({"density": 0.0}, "density of part 0 is 0"),
        ({"density": [1.0, -2.0, 1.0]}, "density of part 1 is -2"),
        ({"density": [1.0, 2.0]}, r"shape \(2,\).*3"),
        ({"density": float("inf")}, "density of part 0 is inf"),
        ({"density": 1e-320}, "density of part 0 is 9.99989e-321"),
        ({"friction": 1e12}, "friction is 1e"),
        ({"density": "heavy"}, "density is 'heavy'"),
        (
            {"meshes": [*stack(2), box("stray", (0, 0, 2.25))]},
            "part stray touches no other part; part b1 is nearest, 250 mm away",
        ),
        ({"meshes": [*stack(2), box("b2", (0, 0, 1.5))]}, "parts b1 and b2 pass through each other by 500 mm"),
    ],
)
def test_bad_input_gets_one_line(changes: dict, message: str):
    with pytest.raises(AssemblyError, match=message) as caught:
        build(**changes)
    assert "\n" not in str(caught.value)


def test_a_boundary_part_may_stand_alone():
    assert build(meshes=[*stack(2), box("kerb", (5, 5, 5))], boundary=[0, 2]).part_count == 3


def test_ground_carries_what_stands_lowest():
    meshes = [box("left", (0, 0, 0.5)), box("right", (3, 0, 0.5)), box("beam", (0, 0, 1.5), (4, 1, 1))]
    assembly = build(meshes=meshes, boundary=[], ground=True)
    assert assembly.names[-1] == "ground"
    assert assembly.boundary.tolist() == [False, False, False, True]
    assert assembly.meshes[-1].bounds[1, 2] == 0.5
    assert assembly.mass.volume[-1] > 0
    pairs = assembly.contacts.parts.tolist()
    assert [0, 3] in pairs
    assert [1, 3] in pairs
    assert [2, 3] not in pairs
    again = build().with_ground()
    assert again.boundary.tolist() == [True, False, False, True]
    twice = again.with_ground()
    assert len(set(twice.names)) == 5


def test_identity_depends_on_what_a_verdict_depends_on():
    base = build()
    same = [
        build(name="other"),
        build(meshes=[TriangleMesh.from_arrays("x" + mesh.name, mesh.vertices, mesh.faces) for mesh in stack()]),
        base.replace(friction=0.7).replace(friction=0.5),
    ]
    assert {assembly.identity for assembly in same} == {base.identity}
    renumbered = np.arange(8)[::-1]
    again = [TriangleMesh.from_arrays(m.name, m.vertices[renumbered], renumbered[m.faces]) for m in stack()]
    assert build(meshes=again).identity == base.identity
    different = [
        build(friction=0.6),
        build(density=2001.0),
        build(boundary=[0, 1]),
        build(meshes=[*stack(2), box("b2", (0, 0, 2), (1, 1, 1 + 1e-12))]),
        build(contact_settings=ContactSettings(gap=1e-3)),
    ]
    identities = {assembly.identity for assembly in different} | {base.identity}
    assert len(identities) == len(different) + 1
    assert all(len(identity) == 64 for identity in identities)


def test_replace_keeps_contacts_and_clearance():
    base = build()
    table = base.clearance
    other = base.replace(friction=0.9, density=1000.0, boundary=[1], name="new")
    assert other.contacts is base.contacts
    assert other.clearance is table
    assert (other.friction, other.name, other.boundary.tolist()) == (0.9, "new", [False, True, False])
    assert other.mass.mass == pytest.approx(base.mass.mass / 2)
    assert base.friction == 0.5


@pytest.mark.parametrize("wrong", [{"friction": -1.0}, {"density": 0.0}, {"boundary": []}, {"boundary": [9]}])
def test_replace_refuses_what_from_meshes_refuses(wrong: dict):
    with pytest.raises(AssemblyError, match=next(iter(wrong))):
        build().replace(**wrong)


def test_clearance_of_a_stack():
    assembly = build(meshes=stack(3))
    assert assembly.clearance.can_leave(np.ones((1, 3), np.uint8)).all(), "all can slide out sideways"
    assert assembly.clearance is assembly.clearance


def test_real_structure_stands_on_its_boundary(shared_assembly: Callable):
    assembly = load_assembly(shared_assembly("vault-62"))
    assert assembly.part_count == 62
    assert assembly.boundary.sum() == 17
    assert assembly.mass.center[:, 2].min() > assembly.meshes[0].bounds[0, 2] - 1
    reached, frontier = set(np.flatnonzero(assembly.boundary).tolist()), True
    while frontier:
        frontier = False
        for a, b in assembly.contacts.parts.tolist():
            if (a in reached) != (b in reached):
                reached |= {a, b}
                frontier = True
    assert len(reached) == 62


def test_a_line_is_a_contact_with_a_warning(beam_on_ridge: Assembly, tmp_path: Path):
    assert beam_on_ridge.warnings == ("parts roof and beam touch along a line only: verdicts may depend on it",)
    assert beam_on_ridge.contacts.dimension.tolist() == [2, 1]
    save_assembly(beam_on_ridge, tmp_path / "beam")
    with pytest.warns(ContactWarning, match="parts roof and beam touch along a line only"):
        again = load_assembly(tmp_path / "beam")
    assert again.identity == beam_on_ridge.identity
    assert again.contacts.points == pytest.approx(beam_on_ridge.contacts.points)
    way = beam_on_ridge.clearance.exit_direction(np.array([2, 2, 1], np.uint8), 2)
    assert way is not None
    assert way[2] >= 0, "it can leave, and not through the ridge"


@pytest.mark.parametrize(
    ("contact", "advice"),
    [
        ({}, r'8 mm away, and 1\.\d+ mm is allowed; .*"gap": 0\.0082'),
        ({"gap": 0.005}, r'8 mm away, and 5 mm is allowed; .*"gap": 0\.0082'),
        ({"gap": 0.03}, r"8 mm away, within the gap of 30 mm that is allowed, but no faces .* 6 degrees"),
        ({"gap": 0.03, "angle": 9.0}, "no faces look at each other there to within 9 degrees"),
    ],
)
def test_advice_on_a_part_that_touches_nothing_is_not_what_was_done(contact: dict[str, float], advice: str) -> None:
    """A block on its edge above the edge of another: nothing touches, however large the gap."""
    turn = np.array([[np.sqrt(0.5), 0, -np.sqrt(0.5)], [0, 1, 0], [np.sqrt(0.5), 0, np.sqrt(0.5)]])
    blocks = [box("low", (0, 0, 0)), box("high", (0, 0, 0))]
    low, high = (mesh.vertices - mesh.vertices.mean(axis=0) for mesh in blocks)
    up = (low @ turn.T)[:, 2].max() - (high @ turn.T)[:, 2].min() + 0.008
    meshes = [
        TriangleMesh.from_arrays("low", low @ turn.T, blocks[0].faces),
        TriangleMesh.from_arrays("high", high @ turn.T + [0, 0, up], blocks[1].faces),
    ]
    with pytest.raises(AssemblyError, match=advice) as caught:
        Assembly.from_meshes(meshes, boundary=[0], contact_settings=ContactSettings(**contact))
    assert "\n" not in str(caught.value)
