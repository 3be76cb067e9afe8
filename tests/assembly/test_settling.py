"""Settling of parts into their clearance, on fits whose rest is known."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure
from falsework.assembly.store import save_assembly
from falsework.errors import AssemblyError, InputError, ReadWarning
from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.mesh import mass_properties
from falsework.geometry.settling.settle import settle_parts

COMPLETE = {
    "contact": StabilitySettings(criterion="contact"),
    "equilibrium": StabilitySettings(criterion="equilibrium"),
}


def revolved(name, profile, *, axis="z", at=(0.0, 0.0, 0.0), sides=48):
    """Solid of revolution of a closed polygon of radii and heights, none on the axis."""
    profile, angle = np.array(profile, dtype=float), 2 * np.pi * np.arange(sides) / sides
    radius, height = profile.T
    points = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones(sides))], axis=-1
    ).reshape(-1, 3)
    number = np.arange(len(points)).reshape(len(profile), sides)
    a, b = number, np.roll(number, -1, axis=0)
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, d, b], -1).reshape(-1, 3)])
    if axis == "y":
        points = points[:, [0, 2, 1]] * (1, -1, 1)
    mesh = TriangleMesh.from_arrays(name, points + at, faces)
    return mesh if mesh.volume > 0 else TriangleMesh.from_arrays(name, points + at, faces[:, ::-1])


def tube(name, inner, outer, low, high, **where):
    return revolved(name, [(inner, low), (outer, low), (outer, high), (inner, high)], **where)


def box(name, low, high):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=bool)
    faces = [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]  # fmt: skip
    return TriangleMesh.from_arrays(name, np.where(corners, high, low), faces)


def wheel(clearance=1e-4):
    axle = tube("axle", 0.002, 0.01, -0.05, 0.05, axis="y")
    return [axle, tube("wheel", 0.01 + clearance, 0.03, -0.01, 0.01, axis="y")]


def peg(play=5e-5, lifted=2e-4):
    block = tube("block", 0.01 + play, 0.03, 0.0, 0.03)
    floor = box("floor", (-0.05, -0.05, -0.01), (0.05, 0.05, 0.0))
    return [floor, block, tube("peg", 0.002, 0.01, lifted, 0.05)]


def lid(play=2e-4):
    case = box("case", (-0.05, -0.05, -0.05), (0.05, 0.05, 0.0))
    return [case, box("lid", (-0.05, -0.05, play), (0.05, 0.05, 0.01))]


def rings(count=5, play=1e-4):
    floor = box("floor", (-0.05, -0.05, -0.02), (0.05, 0.05, 0.0))
    post = tube("post", 0.002, 0.01, 0.0, 0.02 * count)
    return [floor, post] + [
        tube(f"ring-{n}", 0.0102, 0.03, n * 0.01 + (n + 1) * play, (n + 1) * (0.01 + play)) for n in range(count)
    ]


def settled(meshes, bound, boundary=(0,), **options):
    return Assembly.from_meshes(meshes, boundary=list(boundary), settle=bound, **options)


def stable(assembly, criterion="contact"):
    return bool(
        StabilityOracle(assembly, COMPLETE[criterion]).verdicts(np.where(assembly.boundary, 2, 1)[None]).stable[0]
    )


def test_a_wheel_hangs_on_its_axle_and_stands():
    assembly = settled(wheel(), 5e-4)
    assert assembly.settlement.translation[1] == pytest.approx([0, 0, -1e-4], abs=2e-6)
    assert np.abs(assembly.settlement.rotation).max() < 1e-3
    assert assembly.settlement.stopped.all()
    assert not assembly.settlement.translation[0].any()
    # It touches on the upper side of the axle alone.
    assert (assembly.contacts.normals @ (0, 0, 1) > 0.5).all()
    assert stable(assembly)


def test_without_settling_a_wheel_touches_nothing_and_the_message_says_what_helps():
    with pytest.raises(AssemblyError, match=r"part axle|part wheel touches no other part.*--settle 0\.1"):
        Assembly.from_meshes(wheel(), boundary=[0])


def test_a_peg_in_a_hole_comes_to_its_floor():
    assembly = settled(peg(), 5e-4, boundary=(0, 1))
    assert assembly.settlement.translation[2, 2] == pytest.approx(-2e-4, abs=2e-6)
    assert assembly.meshes[2].bounds[0, 2] == pytest.approx(0.0, abs=2e-6)
    assert stable(assembly)


def test_a_lid_with_play_lies_flat():
    assembly = settled(lid(), 1e-3)
    assert assembly.meshes[1].bounds[0, 2] == pytest.approx(0.0, abs=2e-6)
    assert len(assembly.contacts) == 1
    assert stable(assembly)


def test_loose_rings_come_to_rest_on_each_other():
    count, play = 5, 1e-4
    assembly = settled(rings(count, play), 2e-3, boundary=(0, 1))
    expected = -play * np.arange(1, count + 1)
    assert assembly.settlement.translation[2:, 2] == pytest.approx(expected, abs=5e-6)
    assert stable(assembly)


def test_a_tilted_rest_is_found():
    meshes = [
        box("floor", (-0.05, -0.05, -0.02), (0.05, 0.05, 0.0)),
        box("high", (-0.05, -0.05, 0.0), (-0.03, 0.05, 0.02)),
        box("low", (0.03, -0.05, 0.0), (0.05, 0.05, 0.0195)),
        box("bar", (-0.045, -0.02, 0.0202), (0.045, 0.02, 0.04)),
    ]
    assembly = settled(meshes, 1e-3, boundary=(0, 1, 2))
    # It turns about the inner edge of the high support until its end, 75 mm further, meets the low one.
    assert assembly.settlement.rotation[3] == pytest.approx([0, 0.5 / 75, 0], rel=2e-3, abs=1e-6)
    assert {tuple(pair) for pair in assembly.contacts.parts.tolist()} >= {(1, 3), (2, 3)}


def leaning(angle):
    """Block on a slope."""
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    parts = [box("slope", (-0.1, -0.1, -0.05), (0.1, 0.1, 0.0)), box("block", (-0.02, -0.02, 0.0), (0.02, 0.02, 0.03))]
    return [TriangleMesh.from_arrays(part.name, part.vertices @ turn.T, part.faces) for part in parts]


@pytest.mark.parametrize(("share", "moves"), [(0.95, False), (1.05, True)])
def test_a_block_on_a_slope_settles_if_friction_does_not_hold_it(share, moves):
    friction = 0.55
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assembly = settled(leaning(share * np.arctan(friction)), 1e-3, friction=friction)
    assert (assembly.settlement.motion[1] > 0) == moves
    assert any("nothing stopped part block" in str(warning.message) for warning in caught) == moves


@pytest.mark.parametrize("name", ["arch:blocks=9", "dome", "house", "wall"])
def test_structures_in_equilibrium_keep_their_poses(name):
    built = load_structure(name)
    assembly = settled(built.meshes, 1e-3, boundary=np.flatnonzero(built.boundary), friction=built.friction)
    assert not assembly.settlement.motion.any()
    assert assembly.identity == built.identity


def test_motion_does_not_depend_on_the_order_of_parts_or_on_the_density():
    forward = settled(rings(3), 2e-3, boundary=(0, 1)).settlement
    backward = settled(rings(3)[::-1], 2e-3, boundary=(3, 4), density=7800).settlement
    assert forward.translation == pytest.approx(backward.translation[::-1], abs=2e-6)


def test_no_point_moves_farther_than_the_bound_and_what_reaches_it_is_named():
    meshes = lid(play=2e-3)
    with (
        pytest.warns(ReadWarning, match="nothing stopped part lid within 1 mm of settling"),
        pytest.raises(AssemblyError, match=r"part lid touches no other part.*let parts settle farther \(--settle 2\)"),
    ):
        settled(meshes, 1e-3)
    free = [meshes[0], box("lid", (0.04, -0.02, 0.0), (0.10, 0.02, 0.04))]
    with pytest.warns(ReadWarning, match="nothing stopped part lid within"):
        assembly = settled(free, 1e-3)
    assert np.linalg.norm(assembly.meshes[1].vertices - free[1].vertices, axis=1).max() <= 1.001e-3
    assert not assembly.settlement.stopped[1]


def test_interference_is_neither_mended_nor_made_worse():
    meshes = lid(play=-1e-5)
    assembly = settled(meshes, 1e-3)
    assert abs(assembly.settlement.translation[1, 2]) < 2e-6


def test_the_answer_has_the_motion_of_each_part_that_moved():
    settlement = settled(rings(2), 2e-3, boundary=(0, 1)).settlement
    names = [mesh.name for mesh in rings(2)]
    record = settlement.to_dict(names)
    assert [entry["name"] for entry in record["parts"]] == ["ring-0", "ring-1"]
    assert record["bound_m"] == 2e-3
    assert record["parts"][1]["translation_m"][2] == pytest.approx(-2e-4, abs=5e-6)
    assert settlement.line(names).startswith("2 parts settled into the clearance, within 2 mm; ring-1 moved farthest")


@pytest.mark.parametrize("bound", [-1e-4, np.nan, np.inf])
def test_lengths_that_are_none_are_refused(bound):
    with pytest.raises(AssemblyError, match="give a length above zero"):
        settled(wheel(), bound)


def test_a_length_of_zero_leaves_parts_where_they_are():
    with pytest.raises(AssemblyError, match="part wheel touches no other part"):
        settled(wheel(), 0.0)


def test_a_clearance_larger_than_a_part_is_refused():
    with pytest.raises(AssemblyError, match=r"by 40 mm: part wheel is only 20 mm wide; give the clearance"):
        settled(wheel(), 0.04)


def test_parts_that_do_not_come_to_rest_are_named():
    meshes, fixed = wheel(), np.array([True, False])
    mass = mass_properties(meshes, np.full(2, 1000.0))
    with pytest.raises(AssemblyError, match=r"do not come to rest in 1 steps of settling: part wheel still moved by"):
        settle_parts(meshes, fixed, mass, 0.55, 5e-4, most_steps=1)


def test_given_contacts_cannot_settle():
    built = load_structure("arch:blocks=5")
    with pytest.raises(AssemblyError, match="cannot settle; find them"):
        Assembly.from_meshes(built.meshes, boundary=built.boundary, contacts=built.contacts, settle=1e-3)
    with pytest.raises(InputError, match="leave out settle"):
        load_structure("arch:blocks=5", settle=1e-3)


def test_a_file_may_ask_for_it_and_a_saved_structure_is_the_settled_one(tmp_path):
    loose = Assembly.from_meshes(lid(play=1e-6), boundary=[0])
    save_assembly(loose, tmp_path / "loose")
    file = tmp_path / "loose" / "assembly.json"
    for part, mesh in enumerate(lid(play=2e-4)):
        lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
        (tmp_path / "loose" / f"{part}.obj").write_text("\n".join(lines))
    file.write_text(file.read_text().replace('"unit"', '"settle": 0.001, "unit"'))
    assembly = load_structure(tmp_path / "loose")
    assert assembly.settlement is not None
    assert assembly.settlement.translation[1, 2] == pytest.approx(-2e-4, abs=2e-6)
    save_assembly(assembly, tmp_path / "settled")
    again = load_structure(tmp_path / "settled")
    assert again.settlement is None
    assert again.identity == assembly.identity


def test_unstable_parts_with_clearance_are_told_that_settling_exists():
    meshes = [
        tube("axle", 0.002, 0.01, -0.05, 0.05, axis="y"),
        tube("wheel", 0.0101, 0.03, -0.01, 0.01, axis="y", at=(0, 0, 1e-4)),
    ]
    assembly = Assembly.from_meshes(meshes, boundary=[0])  # it touches the axle from below alone
    assert not stable(assembly)
    assert "--settle" in assembly.clearance_hint
    assert stable(settled(meshes, 1e-3))
    assert load_structure("arch:blocks=5").clearance_hint == ""
    assert settled(wheel(), 5e-4).clearance_hint == ""
