"""Joints whose faces overlap, gape, are warped or tessellated differently: contacts on the surface midway."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falsework import load_structure
from falsework.assembly import library
from falsework.errors import AssemblyError
from falsework.geometry import Contacts, ContactSettings, TriangleMesh, find_contacts
from falsework.geometry.contact.interfaces import exact_contacts
from falsework.geometry.contact.overlap import depth


def of_pair(contacts: Contacts, a: int, b: int) -> np.ndarray:
    return np.flatnonzero((contacts.parts == (a, b)).all(axis=1))


def warped(
    name: str, low: float, high: float, *, below: float, above: float, count: int, other: bool = False
) -> TriangleMesh:
    """Block of 1 m by 1 m over a grid whose lower and upper sides are hypars, cut along one diagonal or the other."""
    steps = np.linspace(0, 1, count + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    saddle = (x - 0.5) * (y - 0.5)
    vertices = np.concatenate([np.stack([x, y, z], axis=1) for z in (low + below * saddle, high + above * saddle)])
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    one, two = i * (count + 1) + j, (i + 1) * (count + 1) + j
    three, four = two + 1, one + 1
    cut = ((two, three, four), (two, four, one)) if other else ((one, two, three), (one, three, four))
    top = np.concatenate([np.stack(corners, axis=1) for corners in cut])
    layer = len(x)
    rim = np.concatenate(
        [
            np.arange(count) * (count + 1),
            count * (count + 1) + np.arange(count),
            (count - np.arange(count)) * (count + 1) + count,
            count - np.arange(count),
        ]
    )
    ahead = np.roll(rim, -1)
    sides = np.concatenate(
        [np.stack([rim, ahead, ahead + layer], axis=1), np.stack([rim, ahead + layer, rim + layer], axis=1)]
    )
    return TriangleMesh.from_arrays(name, vertices, np.concatenate([top[:, ::-1], top + layer, sides]))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("into", [0.01, 0.1, 0.3])
def test_an_overlap_is_divided_between_the_parts(shapes, into, seed):
    """A joint of 0.9 m by 0.9 m halfway between the two faces, whatever the sides of the parts do."""
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0.1, 0.1, 1 - into), (1.1, 1.1, 2))]
    rotation = shapes.rotation(seed)
    contacts = find_contacts([shapes.moved(block, rotation=rotation) for block in blocks])
    assert contacts.areas == pytest.approx([0.81])
    assert contacts.normals[0] == pytest.approx(rotation @ (0, 0, 1), abs=1e-9)
    assert (contacts.points @ rotation)[:, 2] == pytest.approx(np.full(4, 1 - into / 2))
    assert contacts.report.parts.tolist() == [[0, 1]]
    assert contacts.report.overlap == pytest.approx([into], abs=1e-9)
    assert contacts.report.gap == pytest.approx([0.0], abs=1e-9)


@pytest.mark.parametrize(("gap", "overlap", "bridged"), [(5, 4, True), (5, 0, False), (5, 1, False), (15, 10, False)])
def test_a_gap_is_bridged_if_it_is_small_and_the_parts_overlap_elsewhere(shapes, gap, overlap, bridged):
    """A plank of 1 m by 1 m on two pillars: lengths in millimetres, of which 10 are allowed."""
    meshes = [
        shapes.box((0, 0, 0), (1, 1, 1 + overlap / 1000)),
        shapes.box((3, 0, 0), (4, 1, 1 - gap / 1000)),
        shapes.box((0, 0, 1), (4, 1, 2)),
    ]
    contacts = find_contacts(meshes)
    assert contacts.parts.tolist() == [[0, 2], [1, 2]][: 1 + bridged]
    if bridged:
        assert contacts.report.gap.max() == pytest.approx(gap / 1000)


@pytest.mark.parametrize("share", [0.002, 0.005, 0.01, 0.02, 0.04])
def test_a_block_above_the_ground_touches_nothing_unless_the_gap_is_allowed(shapes, share):
    blocks = [shapes.box((-2, -2, -1), (2, 2, 0)), shapes.box((0, 0, share), (1, 1, 1 + share))]
    assert len(find_contacts(blocks)) == 0
    assert len(find_contacts(blocks, ContactSettings(gap=1.01 * share))) == 1


def test_joints_narrower_than_the_overlap_elsewhere_survive(shapes):
    """A global tolerance that lets 50 mm pass would drop a joint 20 mm wide."""
    meshes = [
        shapes.box((0, 0, 0), (4, 1, 1)),
        shapes.box((0, 0, 0.95), (1, 1, 2)),
        shapes.box((2, 0, 1), (2.02, 1, 2)),
    ]
    contacts = find_contacts(meshes)
    assert contacts.areas == pytest.approx([1.0, 0.02])
    assert contacts.report.parts.tolist() == [[0, 1]], "the other joint is exact"


def test_pairs_that_touch_exactly_keep_their_contacts(shapes):
    meshes = [shapes.box((0, 0, level), (1, 1, level + 1)) for level in range(3)]
    clean = find_contacts(meshes)
    contacts = find_contacts([*meshes, shapes.box((0, 0, 2.9), (1, 1, 4))])
    for name in ("parts", "frames", "points", "areas"):
        assert (getattr(contacts, name)[: len(getattr(clean, name))] == getattr(clean, name)).all()


@pytest.mark.parametrize("counts", [(1, 1), (1, 4), (5, 3)])
def test_tessellations_of_one_warped_face(counts):
    """Two tessellations of a hypar that rises by 0.15 m pass through each other; the joint follows the surface."""
    lower = warped("lower", 0, 1, below=0, above=0.3, count=counts[0])
    upper = warped("upper", 1, 2, below=0.3, above=0, count=counts[1], other=counts[0] == counts[1])
    contacts = find_contacts([lower, upper])
    assert float(np.abs(contacts.areas @ contacts.normals - (0, 0, 1)).max()) < 0.05
    x, y, z = contacts.points.T
    assert np.abs(z - 1 - 0.3 * (x - 0.5) * (y - 0.5)).max() < 0.05
    assert len(contacts) <= 12
    assert (contacts.normals[:, 2] > 0.9).all()


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ((0.2, 0.2, 0.2), (0.8, 0.8, 0.8), "outer and inner"),
        ((0.2, 0.2, 0.6), (0.8, 0.8, 0.995), "outer and inner"),
        ((0, 0, 0.6), (1, 1, 1.6), "pass through each other by 400 mm"),
        ((0.3, 0.3, -1), (0.7, 0.7, 2), "pass through each other by 200 mm"),
    ],
)
def test_what_cannot_be_a_joint_is_refused(shapes, low, high, message):
    with pytest.raises(AssemblyError, match=message) as caught:
        find_contacts([shapes.box((0, 0, 0), (1, 1, 1), "outer"), shapes.box(low, high, "inner")])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["arch", "polycube"])
@pytest.mark.parametrize("seed", range(2))
def test_parts_that_are_shifted_and_turned_a_little_keep_their_neighbours(name, seed):
    """Overlaps on one side and gaps on the other; parts that met along an edge only overlap in a strip."""
    assembly = library.build(name)
    rng = np.random.default_rng(seed)
    meshes = []
    for mesh in assembly.meshes:
        centre, reach = mesh.vertices.mean(axis=0), 0.003 * mesh.thickness
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.001).as_matrix()
        vertices = (mesh.vertices - centre) @ turn.T + centre + rng.normal(size=3) * reach
        meshes.append(TriangleMesh.from_arrays(mesh.name, vertices, mesh.faces))
    contacts = find_contacts(meshes)
    wide = assembly.contacts.dimension == 2
    least = 0.03 * assembly.contacts.areas.max()
    found = {tuple(pair) for pair in contacts.parts[contacts.areas > least].tolist()}
    before = {tuple(pair) for pair in assembly.contacts.parts[wide].tolist()}
    assert found <= before
    assert len(before - found) <= 1
    assert all(depth(meshes[a], meshes[b]) == 0.0 for a, b in before - found), "a gap with no overlap beside it"


def test_gaps_wider_than_the_overlaps_beside_them_stay_open(shapes):
    """Bricks with open head joints on a bed joint that overlaps by 5 mm."""
    meshes = [
        shapes.box((0, 0, 0), (3, 1, 1)),
        shapes.box((0, 0, 0.995), (1, 1, 2)),
        shapes.box((1.02, 0, 1), (2, 1, 2)),
    ]
    assert find_contacts(meshes).parts.tolist() == [[0, 1], [0, 2]]


def test_lengths_that_are_given_hold(shapes):
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 0.98), (1, 1, 2))]
    assert len(find_contacts(blocks)) == 1
    with pytest.raises(AssemblyError, match="20 mm, and 1 mm is allowed"):
        find_contacts(blocks, ContactSettings(gap=0.001, corner=0.001))


def test_models_without_overlaps_take_the_exact_path(shared_assembly):
    for name in ("vault-62", "dome-37"):
        assembly = load_structure(shared_assembly(name))
        contacts = exact_contacts(assembly.meshes, assembly.contact_settings)
        assert not len(assembly.report)
        for field in ("parts", "frames", "points", "start", "areas"):
            assert (getattr(assembly.contacts, field) == getattr(contacts, field)).all()


def cup(name, base, wall=0.002):
    """Conical cup without a floor, whose sides lean outwards by a third."""
    radius = np.array([0.01, 0.01 + wall, 0.02 + wall, 0.02])
    height = base + np.array([0.0, 0.0, 0.03, 0.03])
    angle = 2 * np.pi * np.arange(24) / 24
    points = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, np.ones(24))], axis=-1
    )
    a = np.arange(96).reshape(4, 24)
    b, c, d = np.roll(a, -1, axis=0), np.roll(a, -1, axis=1), np.roll(a, (-1, -1), axis=(0, 1))
    faces = np.concatenate([np.stack(half, -1).reshape(-1, 3) for half in ((a, c, d), (a, d, b))])
    return TriangleMesh.from_arrays(name, points.reshape(-1, 3), faces)


def test_the_far_sides_of_thin_walls_make_no_joint():
    """Cups that are nested and do not touch: the inside of one looks at the outside of the other, past both walls."""
    cups = [cup("lower", 0.0), cup("upper", 0.01)]
    assert all(mesh.volume > 0 for mesh in cups)
    assert len(find_contacts(cups)) == 0
