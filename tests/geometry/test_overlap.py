"""Parts that pass through each other are named with their depth; parts that touch never are."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

from falsework.errors import AssemblyError
from falsework.geometry import ContactSettings, TriangleMesh, find_contacts
from falsework.geometry.contact.overlap import depth


def test_depth_of_a_layer_is_its_thickness(shapes):
    for seed in range(3):
        rotation = shapes.rotation(seed)
        one = shapes.moved(shapes.box((0, 0, 0), (1, 2, 1)), rotation=rotation)
        two = shapes.moved(shapes.box((0.2, 0.1, 0.93), (0.8, 3, 2)), rotation=rotation)
        assert depth(one, two) == pytest.approx(0.07, abs=1e-9)
        assert depth(two, one) == pytest.approx(0.07, abs=1e-9)


def test_depth_of_a_corner_is_how_far_it_sticks_in(shapes):
    """A cube on its corner, driven into a slab."""
    corner = np.array([1, 1, 1]) / np.sqrt(3)
    axis = np.cross(corner, (0, 0, -1))
    sine, cosine = np.linalg.norm(axis), -corner[2]
    axis /= sine
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
    cube = shapes.moved(shapes.box((-1, -1, -1), (0, 0, 0)), rotation=rotation)
    cube = shapes.moved(cube, (0, 0, -0.05 - cube.vertices[:, 2].min()))
    assert depth(cube, shapes.box((-2, -2, -1), (2, 2, 0))) == pytest.approx(0.05, abs=1e-9)


def test_depth_of_parts_that_coincide_or_cross_is_half_their_width(shapes):
    cube = shapes.box((0, 0, 0), (1, 1, 1))
    assert depth(cube, cube) == pytest.approx(0.5, abs=0.01)
    bars = shapes.box((-2, 0, 0), (3, 1, 1)), shapes.box((0, -2, 0), (1, 3, 1))
    assert depth(*bars) == pytest.approx(0.5, abs=0.05)


def test_parts_that_touch_or_are_apart_have_no_depth(shapes):
    cube = shapes.box((0, 0, 0), (1, 1, 1))
    assert depth(cube, shapes.box((0, 0, 1), (1, 1, 2))) == pytest.approx(0, abs=1e-12)
    assert depth(cube, shapes.box((0, 0, 3), (1, 1, 4))) == 0


EXPLICIT = ContactSettings(gap=0.001)


@pytest.mark.parametrize(("into", "settings"), [(0.002, EXPLICIT), (0.05, EXPLICIT), (0.5, EXPLICIT), (0.5, None)])
def test_faces_that_overlap_beyond_what_is_allowed_are_named(shapes, into, settings):
    """Lengths that are given hold; without them a joint may take up a third of the smaller part."""
    blocks = [shapes.box((0, 0, 0), (1, 1, 1), "sill"), shapes.box((0.1, 0.1, 1 - into), (1.1, 1.1, 2), "post")]
    with pytest.raises(AssemblyError) as caught:
        find_contacts(blocks, settings)
    message = str(caught.value)
    found = re.search(r"parts sill and post pass through each other by ([\d.]+) mm, and ([\d.]+) mm is", message)
    assert found, message
    assert float(found[1]) == pytest.approx(1000 * min(into, 0.5), rel=0.2)
    assert "\n" not in message


def test_the_first_pair_that_is_too_deep_is_named(shapes):
    blocks = [shapes.box((0, 0, z), (1, 1, z + 1 + into), f"b{z}") for z, into in enumerate((0, 0.03, 0.04, 0))]
    with pytest.raises(AssemblyError, match="parts b1 and b2 pass through each other by 30 mm"):
        find_contacts(blocks, EXPLICIT)


@pytest.mark.parametrize("count", [20, 60])
def test_rings_that_lie_in_each_other_are_refused_before_joints_are_sought(count, monkeypatch):
    """Rings of 800 and 7,200 triangles, almost the same; their faces look at each other across the hole."""
    monkeypatch.setattr("falsework.geometry.contact.interfaces.find_joints", None)
    around, along = 2 * np.pi * np.arange(count) / count, 2 * np.pi * np.arange(2 * count) / (2 * count)
    b, a = (values.ravel() for values in np.meshgrid(around, along))
    reach = 1 + 0.3 * np.cos(b)
    i, j = (index.ravel() for index in np.mgrid[: 2 * count, :count])
    one, two = i * count + j, (i + 1) % (2 * count) * count + j
    three, four = (i + 1) % (2 * count) * count + (j + 1) % count, i * count + (j + 1) % count
    faces = np.stack([one, two, three, one, three, four], axis=1).reshape(-1, 3)
    rings = [
        TriangleMesh.from_arrays(
            name, np.stack([wide * reach * np.cos(a), flat * reach * np.sin(a), 0.3 * np.sin(b)], axis=1), faces
        )
        for name, wide, flat in (("first", 1.0, 1.0), ("second", 1.0, 0.97), ("third", 1.02, 1.0))
    ]
    begin = time.process_time()
    with pytest.raises(AssemblyError, match=r"parts first and second pass through each other by 29\d mm, and at most"):
        find_contacts(rings)
    assert time.process_time() - begin < 8


def test_one_inside_the_other_is_named(shapes):
    with pytest.raises(AssemblyError, match="parts outer and inner"):
        find_contacts([shapes.box((0, 0, 0), (3, 3, 3), "outer"), shapes.box((1, 1, 1), (2, 2, 2), "inner")])


def test_a_part_given_twice_is_named(shapes):
    block = shapes.moved(shapes.box((0, 0, 0), (1, 2, 3)), rotation=shapes.rotation(1))
    with pytest.raises(AssemblyError, match="parts one and two"):
        find_contacts([shapes.moved(block, name="one"), shapes.moved(block, name="two")])


def test_a_larger_tolerance_lets_it_pass(shapes):
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 0.99), (1, 1, 2))]
    contacts = find_contacts(blocks, ContactSettings(gap=0.001, overlap=0.011))
    assert contacts.areas == pytest.approx([1.0])


def test_corners_may_cut_in_deeper_than_faces(shapes):
    """Two stones that meet at a bevelled edge: 5 mm of an edge are modelling, 100 mm are not."""
    quarter = np.radians(45)
    turn = np.array([[np.cos(quarter), 0, -np.sin(quarter)], [0, 1, 0], [np.sin(quarter), 0, np.cos(quarter)]])
    reach = np.sqrt(0.5)
    slab = shapes.box((-2, -2, -1), (2, 2, 0), "slab")
    edge_down = shapes.moved(shapes.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), rotation=turn, name="stone")
    find_contacts([slab, shapes.moved(edge_down, (0, 0, reach - 0.005))])
    with pytest.raises(AssemblyError, match=r"slab and stone .* by 100 mm"):
        find_contacts([slab, shapes.moved(edge_down, (0, 0, reach - 0.1))])
    with pytest.raises(AssemblyError, match=r"slab and stone .* by 5 mm, and 1 mm is allowed"):
        find_contacts([slab, shapes.moved(edge_down, (0, 0, reach - 0.005))], ContactSettings(gap=0.001, corner=0.001))


def test_parts_that_interlock_exactly_are_fine(shapes):
    """A bar in a channel touches three sides of it."""
    channel = shapes.extruded([(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)], 0, 1)
    contacts = find_contacts([channel, shapes.box((1, 1, 0), (2, 2, 1))])
    assert len(contacts) == 3
