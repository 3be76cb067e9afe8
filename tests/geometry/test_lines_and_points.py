"""Lines and points: where edges and corners touch, what they are worth, and where they must not be found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from falsework.assembly import library
from falsework.assembly.store import load_assembly
from falsework.geometry import Contacts, ContactSettings, TriangleMesh, find_contacts
from falsework.geometry.contact.interfaces import default_gap
from falsework.geometry.contact.narrow_phase import NARROW

REAL = ["bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72"]
GAP = 1e-3
FINE = ContactSettings(gap=GAP)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Turns a prism along z into one along -y, its outline in the plane of x and z."""


def prism(shapes: Any, outline: list[tuple[float, float]], low: float = -1.0, high: float = 0.0) -> TriangleMesh:
    """Prism with its outline in the plane of x and z, from y = -high to y = -low."""
    return shapes.moved(shapes.extruded(outline, low, high), rotation=UPRIGHT)


def roof(shapes: Any, flat: float = 0.0) -> TriangleMesh:
    """Ridge along y from 0 to 1 at x = 3, z = 1; its top may be cut off flat."""
    top = [(3.0, 1.0)] if flat == 0 else [(3 + flat / 2, 1.0), (3 - flat / 2, 1.0)]
    return prism(shapes, [(2.5, 0.0), (3.5, 0.0), *top])


def pyramid(tip: tuple[float, float, float], up: float = 1.0, name: str = "pyramid") -> TriangleMesh:
    """Four-sided pyramid of height 1 whose tip points down; up if `up` is -1."""
    base = np.array([(-0.3, -0.3, 1), (0.3, -0.3, 1), (0.3, 0.3, 1), (-0.3, 0.3, 1)]) * (1, up, up)
    faces = [(0, 1, 2), (0, 2, 3), (4, 1, 0), (4, 2, 1), (4, 3, 2), (4, 0, 3)]
    return TriangleMesh.from_arrays(name, np.array([*base, (0, 0, 0)]) + tip, faces)


def assert_line(contacts: Contacts, contact: int, ends: list[tuple[float, float, float]]) -> None:
    points = contacts.points[contacts.start[contact] : contacts.start[contact + 1]]
    assert contacts.dimension[contact] == len(points) - 1 == len(ends) - 1
    assert points == pytest.approx(np.array(ends, float), abs=1e-7)


def test_an_edge_on_a_face_is_a_line(shapes):
    meshes = [roof(shapes), shapes.box((0, 0.4, 1), (3.2, 2, 1.1))]
    contacts = find_contacts(meshes, FINE)
    assert contacts.parts.tolist() == [[0, 1]]
    assert_line(contacts, 0, [(3, 0.4, 1), (3, 1, 1)])
    assert contacts.normals[0] == pytest.approx([0, 0, 1])
    assert contacts.areas == pytest.approx([0.6 * default_gap(meshes)]), "a strip as wide as the default gap"
    assert contacts.frames[0] @ contacts.frames[0].T == pytest.approx(np.eye(3))


@pytest.mark.parametrize("flat", [0.0, 1e-4, 0.01, 0.4, 0.9, 1.5, 100.0])
@pytest.mark.parametrize("settings", [None, FINE, ContactSettings(gap=0.1)])
def test_a_contact_does_not_vanish_as_its_width_does(shapes, flat, settings):
    """A ridge with its top cut off, in millimetres: an area of that width, and a line where it is rounding."""
    meshes = [roof(shapes, flat * GAP), shapes.box((0, 0.4, 1), (3.2, 2, 1.1))]
    contacts = find_contacts(meshes, settings)
    wide = flat * GAP > NARROW * default_gap(meshes)
    assert contacts.dimension.tolist() == [2 if wide else 1]
    if wide:
        assert contacts.areas == pytest.approx([0.6 * flat * GAP], rel=1e-3)
        assert np.ptp(contacts.points[:, 0]) == pytest.approx(flat * GAP, rel=1e-3)
    assert contacts.points[:, 0] == pytest.approx(np.full(len(contacts.points), 3.0), abs=51 * GAP)
    assert [contacts.points[:, 1].min(), contacts.points[:, 1].max()] == pytest.approx([0.4, 1.0], abs=1e-6)


@pytest.mark.parametrize(("lift", "touches"), [(0.9, True), (-0.9, True), (1.1, False), (-1.1, False)])
def test_lines_have_the_tolerance_of_faces(shapes, lift, touches):
    contacts = find_contacts([roof(shapes), shapes.box((0, 0.4, 1 + lift * GAP), (3.2, 0.6, 1.1))], FINE)
    assert len(contacts) == int(touches)
    if touches:
        assert contacts.points[:, 2] == pytest.approx(np.full(2, 1 + lift * GAP / 2)), "midway"


def test_a_corner_on_a_face_is_a_point(shapes):
    meshes = [shapes.box((-1, -1, -1), (1, 1, 0)), pyramid((0.2, 0.1, 0))]
    contacts = find_contacts(meshes, FINE)
    assert_line(contacts, 0, [(0.2, 0.1, 0)])
    assert contacts.normals[0] == pytest.approx([0, 0, 1])
    assert contacts.areas == pytest.approx([default_gap(meshes) ** 2])


def test_edges_that_cross_are_a_point_with_a_normal_square_to_both(shapes):
    """A ridge along y below, one along x + y above, tip down."""
    above = prism(shapes, [(-0.5, 1.0), (0, 0), (0.5, 1.0)], -1, 1)
    turn = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0], [-np.sqrt(0.5), np.sqrt(0.5), 0], [0, 0, 1.0]])
    contacts = find_contacts([roof(shapes), shapes.moved(above, (3, 0.5, 1), turn)], FINE)
    assert_line(contacts, 0, [(3, 0.5, 1)])
    assert contacts.normals[0] == pytest.approx([0, 0, 1])


def test_parallel_ridges_have_no_normal(shapes):
    above = prism(shapes, [(2.5, 2.0), (3.0, 1.0), (3.5, 2.0)])
    assert len(find_contacts([roof(shapes), above], FINE)) == 0


@pytest.mark.parametrize(("shift", "found"), [(0.0, 0), (1e-4, 0), (0.05, 1), (0.5, 1), (2, 1)])
def test_on_the_rim_of_a_face_there_is_no_normal(shapes, shift, found):
    """A ridge under the end of a beam, and a tip on the edge of a plate: the force may point in many ways."""
    beam = shapes.box((0, 0, 1), (3 + shift * GAP, 1, 1.1))
    assert len(find_contacts([roof(shapes), beam], FINE)) == found
    plate = shapes.box((-1, -1, -1), (shift * GAP, 1, 0))
    assert len(find_contacts([plate, pyramid((0, 0, 0))], FINE)) == found


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("width", [1e-4, 3e-4, 1e-3, 3e-3, 0.03])
def test_bearings_along_the_rims_of_both_faces_keep_their_width(shapes, width, scale):
    """A beam of 1 m that lies on a strip of two supports."""
    supports = [shapes.box((-1.5, -0.5, -0.5), (-0.5, 0.5, 0)), shapes.box((0.5, -0.5, -0.5), (1.5, 0.5, 0))]
    beam = shapes.box((-0.5 - width, -0.25, 0), (0.5 + width, 0.25, 0.2))
    meshes = (*supports, beam)
    contacts = find_contacts([TriangleMesh.from_arrays(m.name, m.vertices * scale, m.faces) for m in meshes])
    assert contacts.parts.tolist() == [[0, 2], [1, 2]]
    assert contacts.areas == pytest.approx(np.full(2, 0.5 * width * scale**2), rel=1e-6)
    assert contacts.width == pytest.approx(np.full(2, width * scale), rel=0.1)


def test_strips_where_stones_meet_around_a_line_are_left_out(shapes):
    """Four blocks, two of which overlap by less than the tolerance across the corner; a key as low as that."""
    lower = [shapes.box((-1, 0, -1), (2e-4, 1, 0)), shapes.box((2e-4, 0, -1), (1, 1, 0))]
    upper = [shapes.box((-1, 0, 0), (0, 1, 1)), shapes.box((0, 0, 0), (1, 1, 1))]
    assert find_contacts([*lower, *upper]).parts.tolist() == [[0, 1], [0, 2], [1, 3], [2, 3]]
    assert find_contacts([lower[0], upper[1]]).parts.tolist() == [[0, 1]], "alone, the strip carries"
    step = prism(shapes, [(-1, -1), (1, -1), (1, 2e-4), (0, 2e-4), (0, 0), (-1, 0)])
    above = prism(shapes, [(-1, 0), (0, 0), (0, 2e-4), (1, 2e-4), (1, 1), (-1, 1)])
    assert (find_contacts([step, above]).normals[:, 2] > 0.99).all()


@pytest.mark.parametrize("lift", [0.0, 0.004, 0.008])
def test_a_larger_tolerance_finds_at_least_what_a_smaller_one_does(shapes, lift):
    """Prisms of 48 facets above each other, an edge and a tip: the pairs that touch, and their areas, only grow."""
    angle = 2 * np.pi * (np.arange(48) + 0.5) / 48 - np.pi / 2
    reach = 0.2 * np.cos(np.pi / 48)
    drums = [
        prism(shapes, [(0.2 * np.cos(t), height + 0.2 * np.sin(t)) for t in angle], -0.3)
        for height in (reach, 3 * reach + lift)
    ]
    low = shapes.box((-1, -1, -0.2), (1.5, 1, 0))
    wedge = prism(shapes, [(0.4, 0.3), (0.6, lift), (0.8, 0.3)], -0.3)
    spike = pyramid((1.1, 0, lift))
    meshes = [low, *drums, wedge, spike]
    before: dict[tuple[int, int], float] = {}
    for gap in (1e-4, 5e-4, 1e-3, 5e-3, 0.01, 0.03, 0.1):
        contacts = find_contacts(meshes, ContactSettings(gap=gap, overlap=1e-3))
        area: dict[tuple[int, int], float] = dict.fromkeys(map(tuple, contacts.parts.tolist()), 0.0)
        for pair, size in zip(contacts.parts.tolist(), contacts.areas.tolist(), strict=True):
            area[tuple(pair)] += size
        assert area.keys() >= before.keys()
        assert all(area[pair] >= 0.99 * size for pair, size in before.items() if size > 1e-4)
        before = area
    assert before.keys() >= {(0, 1), (1, 2), (0, 3), (0, 4)}


def test_an_edge_in_a_groove_touches_both_sides(shapes):
    """A wedge of 60 degrees in a groove of 120: a line with the normal of each side."""
    rise = np.tan(np.radians(30))
    groove = prism(shapes, [(-1, -1), (1, -1), (1, rise), (0, 0), (-1, rise)])
    wedge = prism(shapes, [(0, 0), (0.5, 0.5 / rise), (-0.5, 0.5 / rise)])
    contacts = find_contacts([groove, wedge], FINE)
    assert contacts.dimension.tolist() == [1, 1]
    assert contacts.normals[:, 2] == pytest.approx(np.full(2, np.cos(np.radians(30))))
    assert contacts.normals[:, 0].sum() == pytest.approx(0)


def test_areas_have_no_lines_at_their_edges(shapes):
    """Blocks flush, set back, turned, on feet and in a corner: their edges lie on faces that they touch anyway."""
    floor = shapes.box((-3, -3, -1), (3, 3, 0))
    bridge = prism(shapes, [(0, 0), (1, 0), (1, 1), (1.5, 1), (2, 0), (2.5, 1), (3, 1), (3, 0), (4, 0), (4, 2), (0, 2)])
    tilt = shapes.rotation(3)
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    corner = prism(shapes, [(-1, -1), (2, -1), (2, 0), (0, 0), (0, 2), (-1, 2)])
    for one, other, count in (
        (floor, shapes.box((-1, -1, 0), (1, 1, 1)), 1),
        (floor, shapes.moved(shapes.box((-1, -1, 0), (1, 1, 1)), rotation=turn), 1),
        (floor, shapes.box((1, 1, 0), (3, 3, 1)), 1),
        (floor, shapes.moved(bridge, (-2, 0, 0)), 1),
        (corner, shapes.box((0, 0.2, 0), (1, 0.7, 1)), 2),
    ):
        contacts = find_contacts([one, other], FINE)
        assert contacts.dimension.tolist() == [2] * count
        moved = find_contacts([shapes.moved(mesh, (1, 2, 3), tilt) for mesh in (one, other)], FINE)
        assert moved.dimension.tolist() == [2] * count


def test_a_foot_beside_an_area_is_a_line_of_its_own(shapes):
    """A block on one broad foot and one knife: the area as without the knife, and the line."""
    block = prism(shapes, [(0, 0), (1, 0), (1, 1), (2.5, 1), (3, 0), (3.5, 1), (4, 1), (4, 2), (0, 2)])
    meshes = [shapes.box((-1, -2, -1), (6, 2, 0)), block]
    contacts = find_contacts(meshes, FINE)
    assert contacts.dimension.tolist() == [2, 1]
    assert contacts.areas == pytest.approx([1.0, default_gap(meshes)])
    assert_line(contacts, 1, [(3, 0, 0), (3, 1, 0)])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_triangulation_position_and_order_do_not_matter(shapes, seed):
    rotation, shift = shapes.rotation(seed), np.random.default_rng(seed).uniform(-5, 5, 3)
    base = [roof(shapes), shapes.box((0, 0.4, 1), (3.2, 0.6, 1.1)), pyramid((1, 0.5, 1.1))]
    still = find_contacts(base, FINE)
    assert still.dimension.tolist() == [1, 0]
    plain = [shapes.moved(mesh, shift, rotation) for mesh in base]
    for meshes in (plain, [shapes.split(mesh, seed + number) for number, mesh in enumerate(plain)]):
        contacts = find_contacts(meshes, FINE)
        assert contacts.parts.tolist() == [[0, 1], [1, 2]]
        assert contacts.dimension.tolist() == [1, 0]
        assert contacts.normals == pytest.approx(still.normals @ rotation.T, abs=1e-7)
        scale = default_gap(meshes) / default_gap(base)
        assert contacts.areas == pytest.approx(still.areas * [scale, scale**2], rel=1e-4)
        expected = still.points @ rotation.T + shift
        apart = np.linalg.norm(contacts.points[:, None] - expected, axis=2)
        assert apart.min(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
    back = find_contacts(base[::-1], FINE)
    assert sorted(back.dimension.tolist()) == [0, 1]
    assert back.normals == pytest.approx(-still.normals[::-1])


@pytest.mark.parametrize("name", REAL)
def test_real_structures_touch_by_areas_alone(shared_assembly, name):
    """In the vault tips of stones reach its frame between two others: no line, since none of them protrudes."""
    assembly = load_assembly(shared_assembly(name))
    assert (assembly.contacts.dimension == 2).all()
    assert assembly.warnings == ()


@pytest.mark.parametrize("name", [entry.name for entry in library.structures()])
def test_built_in_structures_touch_by_areas_alone(name):
    assert (library.build(name).contacts.dimension == 2).all()
