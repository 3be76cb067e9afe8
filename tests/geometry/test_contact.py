"""Contacts: closed forms, invariances, the wrench theorem, and agreement with sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize
from hypothesis import example, given, settings
from hypothesis import strategies as st

from falsework.errors import InputError
from falsework.geometry import Contacts, ContactSettings, TriangleMesh, find_contacts, load_meshes
from falsework.geometry.contact.creases import Surface
from falsework.geometry.contact.grouping import planes
from falsework.geometry.contact.patches import face_patches, opposed_faces
from falsework.geometry.mesh.collision import Body

linprog: Any = vars(scipy.optimize)["linprog"]  # without types, which take a type checker long to infer
REAL = ["bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72"]


def corners(contacts: Contacts, contact: int) -> np.ndarray:
    return contacts.points[contacts.start[contact] : contacts.start[contact + 1]]


def same_points(one: np.ndarray, two: np.ndarray, tolerance: float = 1e-9) -> bool:
    """Whether two sets of points are equal in some order."""
    if one.shape != two.shape:
        return False
    distance = np.linalg.norm(one[:, None] - two[None], axis=2)
    return bool((distance.min(axis=0) <= tolerance).all() and (distance.min(axis=1) <= tolerance).all())


def assert_sound(contacts: Contacts) -> None:
    """What must hold for contacts of anything."""
    count = len(contacts)
    assert contacts.frames.shape == (count, 3, 3)
    assert contacts.frames @ contacts.frames.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (count, 1, 1)))
    assert np.linalg.det(contacts.frames) == pytest.approx(np.ones(count))
    assert (contacts.parts[:, 0] < contacts.parts[:, 1]).all()
    assert contacts.parts.tolist() == sorted(contacts.parts.tolist())
    assert contacts.start[0] == 0
    assert contacts.start[-1] == len(contacts.points)
    assert (np.diff(contacts.start) >= 3).all()
    assert (contacts.areas > 0).all()
    for contact in range(count):
        flat = corners(contacts, contact) @ contacts.frames[contact, 1:].T
        edge = np.roll(flat, -1, axis=0) - flat
        after = np.roll(edge, -1, axis=0)
        assert (edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] > 0).all(), "counter-clockwise and convex"


def test_one_block_on_another(shapes):
    contacts = find_contacts([shapes.box((0, 0, 0), (2, 2, 1)), shapes.box((1, 1, 1), (4, 3, 2))])
    assert_sound(contacts)
    assert contacts.parts.tolist() == [[0, 1]]
    assert contacts.normals[0] == pytest.approx([0, 0, 1])
    assert contacts.areas == pytest.approx([1.0])
    assert same_points(contacts.points, np.array([(1, 1, 1), (2, 1, 1), (2, 2, 1), (1, 2, 1)], float))


def test_the_order_of_the_parts_turns_the_normal_and_nothing_else(shapes):
    one, two = shapes.box((0, 0, 0), (2, 2, 1)), shapes.box((1, 1, 1), (4, 3, 2))
    there, back = find_contacts([one, two]), find_contacts([two, one])
    assert back.normals == pytest.approx(-there.normals)
    assert same_points(back.points, there.points)


@pytest.mark.parametrize(
    "shift", [(2, 0, 1), (2, 2, 1), (2, 2, 0), (2.1, 0, 0), (0, 0, 1.1)], ids=["edge", "corner", "side", "gap", "above"]
)
def test_edges_and_corners_do_not_touch(shapes, shift):
    """Two boxes of 2 x 2 x 1 that share an edge, a corner, an upright edge, or nothing."""
    contacts = find_contacts([shapes.box((0, 0, 0), (2, 2, 1)), shapes.box(shift, np.add(shift, (2, 2, 1)))])
    assert len(contacts) == 0
    assert contacts.points.shape == (0, 3)


@given(seed=st.integers(0, 10_000))
@example(seed=244)  # edges nearly in line, of which general polygon overlay loses a whole triangle
@settings(max_examples=25, deadline=None)
def test_triangulation_and_position_do_not_matter(shapes, seed):
    """Stack of three in a random place: split at random, the contacts are the same."""
    rotation, shift = shapes.rotation(seed), np.random.default_rng(seed).uniform(-5, 5, 3)
    base = [
        shapes.box((0, 0, 0), (2, 2, 1)),
        shapes.extruded([(0.5, 0.5), (3, 0.5), (3, 1), (1, 1), (1, 1.7), (0.5, 1.7)], 1, 2),
        shapes.box((0, 0, 2), (3, 0.8, 2.5)),
    ]
    plain = [shapes.moved(mesh, shift, rotation) for mesh in base]
    fine = [shapes.split(mesh, seed + number) for number, mesh in enumerate(plain)]
    one, two = find_contacts(plain), find_contacts(fine)
    assert_sound(two)
    assert one.parts.tolist() == two.parts.tolist() == [[0, 1], [1, 2]]
    assert two.areas == pytest.approx(one.areas)
    assert two.frames == pytest.approx(one.frames, abs=1e-7)
    for contact in range(len(one)):
        assert same_points(corners(one, contact), corners(two, contact), 1e-7)
    still = find_contacts(base)
    assert one.normals == pytest.approx(still.normals @ rotation.T, abs=1e-9)
    for contact in range(len(one)):
        assert same_points(corners(one, contact), corners(still, contact) @ rotation.T + shift)


@pytest.mark.parametrize(("lift", "touches"), [(0.9, True), (-0.9, True), (1.1, False)])
def test_gaps_and_overlaps_up_to_the_tolerance_touch(shapes, lift, touches):
    tolerance = 1e-3
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 1 + lift * tolerance), (1, 1, 2))]
    contacts = find_contacts(blocks, ContactSettings(gap=tolerance))
    assert len(contacts) == int(touches)
    if touches:
        assert contacts.areas == pytest.approx([1.0])
        assert contacts.points[:, 2] == pytest.approx(np.full(4, 1 + lift * tolerance / 2)), "midway"


def test_gap_and_overlap_have_their_own_tolerances(shapes):
    wide = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 1.004), (1, 1, 2))]
    assert len(find_contacts(wide, ContactSettings(gap=0.005, overlap=0.001))) == 1
    assert len(find_contacts(wide, ContactSettings(gap=0.001, overlap=0.005))) == 0


@pytest.mark.parametrize(("degrees", "touches"), [(2.0, True), (4.0, False)])
def test_faces_touch_up_to_an_angle_and_only_where_they_are_near(shapes, degrees, touches):
    """A block tilted about one edge touches along a strip that is as wide as the tolerance allows."""
    angle, gap = np.radians(degrees), 1e-3
    tilt = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.moved(shapes.box((0, 0, 0), (1, 1, 1)), (0, 0, 1), tilt)]
    contacts = find_contacts(blocks, ContactSettings(gap=gap, angle=3.0))
    assert len(contacts) == int(touches)
    if touches:
        width = gap / (2 * np.tan(angle / 2))
        assert contacts.areas == pytest.approx([width], rel=1e-2)


def test_patches_of_one_plane_become_one_contact(shapes):
    """A bridge stands on two feet: one contact whose hull spans both."""
    bridge = shapes.extruded([(0, 0), (1, 0), (1, 1), (4, 1), (4, 0), (5, 0), (5, 2), (0, 2)], 0, 1, "bridge")
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    contacts = find_contacts([shapes.box((-1, -2, -1), (6, 2, 0)), shapes.moved(bridge, rotation=upright)])
    assert len(contacts) == 1
    assert contacts.areas == pytest.approx([2.0])
    assert same_points(contacts.points, np.array([(0, 0, 0), (5, 0, 0), (5, -1, 0), (0, -1, 0)], float))


def test_two_planes_stay_two_contacts(shapes):
    """The same bridge over a step: parallel planes at different heights."""
    bridge = shapes.extruded([(0, 0), (1, 0), (1, 1), (4, 1), (4, 0.5), (5, 0.5), (5, 2), (0, 2)], 0, 1)
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    step = shapes.moved(
        shapes.extruded([(-1, -1), (6, -1), (6, 0.5), (4, 0.5), (4, 0), (-1, 0)], -1, 2), rotation=upright
    )
    contacts = find_contacts([step, shapes.moved(bridge, rotation=upright)])
    heights = sorted(corners(contacts, contact)[:, 2].mean() for contact in range(len(contacts)))
    flat = np.abs(contacts.normals[:, 2]) > 0.5
    assert flat.sum() == 2
    assert heights[0] == pytest.approx(0)


def test_hull_corners_transmit_what_the_patches_can(shapes):
    """Any force in the friction cone, anywhere on the feet of the bridge, has a twin at the hull's corners."""
    bridge = shapes.extruded([(0, 0), (1, 0), (1, 1), (4, 1), (4, 0), (5, 0), (5, 2), (0, 2)], 0, 1)
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    contacts = find_contacts([shapes.box((-1, -2, -1), (6, 2, 0)), shapes.moved(bridge, rotation=upright)])
    turn = 2 * np.pi * np.arange(8) / 8
    friction = 0.55
    rays = contacts.frames[0].T @ np.stack([np.ones(8), friction * np.cos(turn), friction * np.sin(turn)])
    columns = [np.concatenate([ray, np.cross(point, ray)]) for point in contacts.points for ray in rays.T]
    random = np.random.default_rng(0)
    for foot in (0.0, 4.0):
        for _ in range(20):
            point = np.array([foot + random.uniform(), -random.uniform(), 0.0])
            force = rays @ random.uniform(0, 1, 8)
            wrench = np.concatenate([force, np.cross(point, force)])
            found = linprog(np.zeros(len(columns)), A_eq=np.array(columns).T, b_eq=wrench)
            assert found.status == 0
    outside = np.array([5.5, -0.5, 0.0])
    force = np.array([0, 0, 1.0])
    wrench = np.concatenate([force, np.cross(outside, force)])
    assert linprog(np.zeros(len(columns)), A_eq=np.array(columns).T, b_eq=wrench).status == 2


@pytest.mark.parametrize(("facets", "phase"), [(72, 0.0), (72, 0.5), (60, 0.3)])
def test_a_peg_of_facets_in_a_hole(shapes, facets, phase):
    """72 facets against the same, turned, or fewer: the whole wall touches, in a handful of contacts."""
    radius, height = 0.1, 0.2
    pair = [shapes.peg(72, radius, height, phase), shapes.drilled(facets, radius, 0.3, height)]
    contacts = find_contacts(pair)
    assert_sound(contacts)
    assert contacts.areas.sum() == pytest.approx(2 * np.pi * radius * height, rel=2e-3)
    assert 24 <= len(contacts) <= 40
    assert len(contacts.points) <= 160
    assert np.linalg.norm(contacts.points[:, :2], axis=1) == pytest.approx(
        np.full(len(contacts.points), radius), abs=3e-4
    )
    assert contacts.normals[:, 2] == pytest.approx(np.zeros(len(contacts)), abs=1e-9)
    assert np.abs((contacts.normals * contacts.areas[:, None]).sum(axis=0)).max() < 1e-4, "pressure is in balance"
    outward = np.array([corners(contacts, contact).mean(axis=0)[:2] for contact in range(len(contacts))])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", outward, contacts.normals[:, :2]) > np.cos(np.radians(5))).all()


def test_interfaces_with_few_planes_are_not_rounded_off(shapes):
    """An octagonal peg keeps its eight planes, whatever the angle of curvature."""
    contacts = find_contacts([shapes.peg(8, 0.1, 0.2), shapes.drilled(8, 0.1, 0.3, 0.2)], ContactSettings(curvature=44))
    assert len(contacts) == 8


def test_thin_plates_touch_their_neighbours_alone(shapes):
    """Plates thinner than 1/2000 of their diagonal: the tolerance follows the thickness."""
    plates = [shapes.box((0, 0, 2e-4 * level), (0.5, 0.5, 2e-4 * (level + 1))) for level in range(10)]
    assert find_contacts(plates).parts.tolist() == [[level, level + 1] for level in range(9)]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_row_of_blocks_in_any_direction(shapes, axis):
    step = np.eye(3)[axis]
    blocks = [shapes.box(step * number, step * number + 1) for number in range(150)]
    contacts = find_contacts(blocks)
    assert contacts.parts.tolist() == [[number, number + 1] for number in range(149)]
    assert contacts.normals == pytest.approx(np.tile(step, (149, 1)))


@pytest.mark.parametrize(
    "wrong", [{"gap": 0.0}, {"gap": -1.0}, {"overlap": np.nan}, {"angle": 0.0}, {"curvature": 90.0}, {"corner": -1.0}]
)
def test_tolerances_are_checked(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        ContactSettings(**wrong)


@pytest.mark.parametrize("name", REAL)
def test_real_structures(shared_assembly, name):
    """Contacts of real data are sound, lie on both parts, and split the same from finer triangles."""
    meshes = load_meshes(shared_assembly(name))
    contacts = find_contacts(meshes)
    assert_sound(contacts)
    assert set(contacts.parts.ravel().tolist()) == set(range(len(meshes))), "every part touches another"
    bodies = [Body(mesh.vertices, mesh.faces) for mesh in meshes]
    tolerance = 2 * ContactSettings().lengths(meshes)[0]
    for contact, pair in enumerate(contacts.parts.tolist()):
        for part in pair:
            assert bodies[part].distances(corners(contacts, contact)).max() < tolerance


def test_vault_has_304_planes(shared_assembly):
    assert len(find_contacts(load_meshes(shared_assembly("vault-62")))) == 304


def test_area_agrees_with_sampling(shared_assembly):
    """Share of a part's surface that is near another part, by points on it, against the sum of the areas."""
    meshes = load_meshes(shared_assembly("vault-62"))
    contacts = find_contacts(meshes)
    random = np.random.default_rng(5)
    busiest = np.argsort(-np.bincount(contacts.parts.ravel()))[:3]
    for part in busiest.tolist():
        triangles = meshes[part].triangles
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area = np.linalg.norm(cross, axis=1) / 2
        count = 4000
        face = random.choice(len(area), count, p=area / area.sum())
        a, b = np.sort(random.uniform(size=(2, count)), axis=0)
        weights = np.stack([a, b - a, 1 - b], axis=1)
        points = np.einsum("pv,pvi->pi", weights, triangles[face])
        beside = contacts.parts[(contacts.parts == part).any(axis=1)]
        near = np.zeros(count, dtype=bool)
        for other in set(beside.ravel().tolist()) - {part}:
            near |= Body(meshes[other].vertices, meshes[other].faces).distances(points) < 1e-5
        expected = contacts.areas[(contacts.parts == part).any(axis=1)].sum() / area.sum()
        assert near.mean() == pytest.approx(expected, abs=4 * np.sqrt(0.25 / count))


def tube(name, inner, outer, sides, rows):
    """Tube whose inner and outer sides are cut into rows of facets."""
    low, high = np.linspace(0, 0.1, rows), np.linspace(0.1, 0, rows)
    radius = np.repeat([inner, outer], rows)
    height = np.concatenate([high, low])
    angle = 2 * np.pi * np.arange(sides) / sides
    points = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones(sides))], axis=-1
    )
    a = np.arange(2 * rows * sides).reshape(2 * rows, sides)
    b, c, d = np.roll(a, -1, axis=0), np.roll(a, -1, axis=1), np.roll(a, (-1, -1), axis=(0, 1))
    faces = np.concatenate([np.stack(half, -1).reshape(-1, 3) for half in ((a, c, d), (a, d, b))])
    mesh = TriangleMesh.from_arrays(name, points.reshape(-1, 3), faces)
    return mesh if mesh.volume > 0 else TriangleMesh.from_arrays(name, points.reshape(-1, 3), faces[:, ::-1])


def test_pairs_of_faces_that_are_compared_grow_with_the_faces_alone():
    """Of a bearing, also within the wide bounds of joints."""

    def compared(scale):
        faces = Surface.from_meshes(
            [tube("shaft", 0.005, 0.01, 24 * scale, 6 * scale), tube("bush", 0.0101, 0.02, 24, 6)]
        )
        extent = np.full(len(faces.part), 0.02)
        return sum(len(i) for i, _ in opposed_faces(faces, extent / 20, extent / 3, 30.0)), len(faces.part)

    (few, small), (many, large) = compared(2), compared(4)
    assert many / few < 1.5 * large / small


@pytest.mark.parametrize("coplanar", [0.1, 30.0])
def test_planes_by_the_tree_are_those_by_comparing_all(coplanar):
    meshes = [tube("shaft", 0.005, 0.01, 40, 5), tube("bush", 0.01, 0.02, 40, 7)]
    patches = face_patches(meshes, gap=1e-5, overlap=1e-5, angle=6.0)
    by_tree = planes(patches, coplanar, 1e-5, many=0)
    expected = planes(patches, coplanar, 1e-5, many=10**9)
    assert len(np.unique(by_tree)) == len(np.unique(expected))
    assert len(np.unique(np.stack([by_tree, expected]), axis=1).T) == len(np.unique(expected))
