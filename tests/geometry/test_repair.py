"""Repairs and refusals of meshes; a sound mesh is left alone."""

from __future__ import annotations

import dataclasses
import sys
import warnings

import numpy as np
import pytest

from falsework.errors import MeshError, ReadWarning
from falsework.geometry import RepairWarning
from falsework.geometry.mesh.mesh import mass_properties
from falsework.geometry.mesh.repair import check_mesh, check_meshes


@pytest.fixture
def box(shapes):
    return shapes.box((0, 0, 0), (0.2, 0.3, 0.4))


def test_a_sound_mesh_is_left_alone(box):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = check_mesh("p", box.vertices, box.faces)
    assert (mesh.triangles == box.triangles).all()


def test_separate_vertices_are_joined_silently(box):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = check_mesh("p", box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert len(mesh.vertices) == 8
    assert (mesh.triangles == box.triangles).all()


def test_edges_that_four_faces_share_are_closed(shapes):
    one, two = shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((1, 1, 0), (2, 2, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "part p consists of 2 separate solids")
        mesh = check_mesh("p", np.concatenate([one.vertices, two.vertices]), np.concatenate([one.faces, two.faces + 8]))
    assert mesh.volume == pytest.approx(2.0)
    assert len(mesh.vertices) == 14


def test_inside_out_is_turned(box):
    with pytest.warns(RepairWarning, match="part p .*inside out"):
        mesh = check_mesh("p", box.vertices, box.faces[:, ::-1])
    assert mesh.volume == pytest.approx(0.024)


@pytest.mark.parametrize("flipped", [(), (0,), (1,), (0, 1), (2,), (0, 1, 2)])
def test_surfaces_of_a_hollow_part_look_away_from_its_material(shapes, flipped):
    """A box with a hollow, and a loose box in the hollow, each of them turned either way."""
    shells = [
        shapes.box((0, 0, 0), (4, 4, 4)),
        shapes.box((1, 1, 1), (3, 3, 3)),
        shapes.box((1.5, 1.5, 1.5), (2, 2, 2)),
    ]
    faces = [shell.faces[:, ::-1] if number in flipped else shell.faces for number, shell in enumerate(shells)]
    vertices = np.concatenate([shell.vertices for shell in shells])
    faces = np.concatenate([face + 8 * number for number, face in enumerate(faces)])
    if flipped == (1,):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "part p consists of 2 separate solids")
            mesh = check_mesh("p", vertices, faces)
    else:
        with pytest.warns(RepairWarning, match="inside out"):
            mesh = check_mesh("p", vertices, faces)
    assert mesh.volume == pytest.approx(64 - 8 + 0.125)


@pytest.mark.parametrize("wrong", [[0], [3, 7], [1, 2, 5, 11], list(range(7))])
def test_faces_that_look_the_other_way_are_turned(box, wrong):
    faces = box.faces.copy()
    faces[wrong] = faces[wrong][:, ::-1]
    with pytest.warns(RepairWarning, match="look the same way"):
        mesh = check_mesh("p", box.vertices, faces)
    assert mesh.volume == pytest.approx(0.024)


def test_vertices_that_almost_coincide_are_merged(box):
    scattered = box.triangles.reshape(-1, 3) + np.random.default_rng(0).uniform(-1e-8, 1e-8, (36, 3))
    with pytest.warns(RepairWarning, match="almost coincide"):
        mesh = check_mesh("p", scattered, np.arange(36).reshape(-1, 3))
    assert len(mesh.vertices) == 8
    assert mesh.volume == pytest.approx(0.024, rel=1e-6)


def test_doubled_and_degenerate_faces_are_dropped(box):
    faces = np.concatenate([box.faces, box.faces[:2], [(0, 0, 1)]])
    with pytest.warns(RepairWarning, match="dropped"):
        mesh = check_mesh("p", box.vertices, faces)
    assert len(mesh.faces) == 12


@pytest.mark.parametrize("missing", [[0], [0, 1], [4, 5], [0, 1, 2, 3]])
def test_flat_holes_are_closed(shapes, missing):
    box = shapes.moved(shapes.box((0, 0, 0), (0.2, 0.3, 0.4)), rotation=shapes.rotation(4))
    with pytest.warns(RepairWarning, match="flat holes"):
        mesh = check_mesh("p", box.vertices, np.delete(box.faces, missing, axis=0))
    assert mesh.volume == pytest.approx(0.024)


def test_a_concave_flat_hole_is_closed_without_folds(shapes):
    prism = shapes.extruded([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)], 0, 1)
    tops = (prism.vertices[prism.faces][:, :, 2] == 1).all(axis=1)
    with pytest.warns(RepairWarning, match="flat holes"):
        mesh = check_mesh("p", prism.vertices, prism.faces[~tops])
    assert mesh.volume == pytest.approx(prism.volume)
    corners = mesh.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).sum() == tops.sum(), "every triangle of the cap looks up"


def test_a_hole_that_is_not_flat_is_refused(box):
    with pytest.raises(MeshError, match=r"part wedge is not closed: \d+ edges"):
        check_mesh("wedge", box.vertices, np.delete(box.faces, [1, 10], axis=0))


def test_one_lone_face_is_refused():
    with pytest.raises(MeshError, match="part leaf"):
        check_mesh("leaf", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])


def test_no_volume_is_refused():
    flat = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    with pytest.raises(MeshError, match="part sheet has no volume"):
        check_mesh("sheet", flat, [(0, 1, 2), (0, 2, 1)])


def test_nan_is_refused_by_vertex(box):
    vertices = box.vertices.copy()
    vertices[5, 1] = np.nan
    with pytest.raises(MeshError, match="part p: vertex 5 is NaN"):
        check_mesh("p", vertices, box.faces)


@pytest.mark.parametrize("scale", [1e4, 1e-4])
def test_a_size_that_betrays_the_unit_is_refused(box, scale):
    with pytest.raises(MeshError, match=r"part p is .* m?m long.*unit"):
        check_mesh("p", box.vertices * scale, box.faces)


def test_no_faces_is_refused():
    with pytest.raises(MeshError, match="part p has no faces"):
        check_mesh("p", np.zeros((3, 3)), np.zeros((0, 3)))


def together(*meshes):
    """Vertices and faces of meshes in one pair of arrays."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces)


def united(*meshes):
    """The part that meshes make, which must have overlapped, with its mass properties."""
    with pytest.warns(RepairWarning, match="part p was repaired: .*overlapped"):
        mesh = check_mesh("p", *together(*meshes))
    return mesh, mass_properties([mesh], np.array([2000.0]))


def test_two_cubes_that_overlap_weigh_as_much_as_their_union(shapes):
    _, mass = united(shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0.7, 0.5, 0.25), (1.7, 1.5, 1.25)))
    common = 0.3 * 0.5 * 0.75
    center = (np.array([0.5, 0.5, 0.5]) + [1.2, 1.0, 0.75] - common * np.array([0.85, 0.75, 0.625])) / (2 - common)
    assert mass.volume[0] == pytest.approx(2 - common, rel=1e-9)
    assert mass.mass[0] == pytest.approx(2000 * (2 - common), rel=1e-9)
    np.testing.assert_allclose(mass.center[0], center, rtol=1e-9)


def test_the_warning_says_how_much_counted_twice(shapes):
    with pytest.warns(RepairWarning, match="250 dm3 in common"):
        check_mesh("p", *together(shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0.75, 0, 0), (1.75, 1, 1))))


@pytest.mark.parametrize("seed", range(4))
def test_turned_cubes_that_overlap(shapes, seed):
    """In any attitude the union is as large as one cube and the corner that the other adds."""
    rotation = shapes.rotation(seed)
    boxes = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0.5, 0.5, 0.5), (2, 2, 2)), shapes.box((0, 0, 2), (1, 1, 3))]
    _, mass = united(*(shapes.moved(box, rotation=rotation) for box in boxes))
    assert mass.volume[0] == pytest.approx(1 + 1.5**3 - 0.125 + 1, rel=1e-9)


def test_a_hollow_stays_where_another_solid_does_not_fill_it(shapes):
    """A bar runs through the hollow of a box, and out of the box."""
    outer, hollow = shapes.box((0, 0, 0), (4, 4, 4)), shapes.box((1, 1, 1), (3, 3, 3))
    _, mass = united(outer, hollow, shapes.box((1.5, 1.5, -1), (2.5, 2.5, 5)))
    assert mass.volume[0] == pytest.approx(64 - 8 + 2 + 2, rel=1e-9)


def test_a_beam_between_the_corners_of_a_bent_part(shapes):
    """All corners of the beam are in the legs of a U, and its middle is not: it is no hollow."""
    legs = shapes.extruded([(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)], 0, 1)
    _, mass = united(legs, shapes.box((0.5, 2, 0.25), (3.5, 2.5, 0.75)))
    assert mass.volume[0] == pytest.approx(8 + 2 * 0.5 * 0.5, rel=1e-9)


def test_cubes_that_share_an_edge_and_overlap(shapes):
    _, mass = united(shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 0), (0.5, 2, 1)))
    assert mass.volume[0] == pytest.approx(1.5, rel=1e-9)


@pytest.mark.parametrize("shift", [0.0, 1e-4])
def test_a_cube_given_twice_counts_once(box, shift):
    copy = dataclasses.replace(box, vertices=box.vertices + shift)
    with pytest.warns(RepairWarning, match="doubled" if shift == 0 else "overlapped"):
        mesh = check_mesh("p", *together(box, copy))
    assert mesh.volume == pytest.approx(0.024, rel=2e-3)


@pytest.mark.parametrize("low", [(1, 0, 0), (1, 0.5, 0.25), (1, 1, 0), (1, 1, 1), (1.5, 0, 0), (1 - 1e-8, 0.5, 0.25)])
def test_surfaces_that_touch_or_are_apart_are_left_alone(shapes, low):
    boxes = shapes.box((0, 0, 0), (1, 1, 1)), shapes.box(low, np.add(low, 1))
    with pytest.warns(ReadWarning, match="part p consists of 2 separate solids, which count as") as caught:
        mesh = check_mesh("p", *together(*boxes))
    assert len(caught) == 1
    assert mesh.volume == pytest.approx(2)
    assert len(mesh.faces) == 24


def test_without_manifold3d_the_line_says_what_to_install(shapes, monkeypatch):
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    boxes = shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0.5, 0, 0), (1.5, 1, 1))
    with pytest.raises(MeshError, match=r"part p: .*overlap.*falsework\[repair\]") as error:
        check_mesh("p", *together(*boxes))
    assert "\n" not in str(error.value)
    assert check_mesh("p", *together(boxes[0])).volume == pytest.approx(1)


def test_a_hole_with_a_rim_that_is_bent_a_little_is_closed(box):
    points = box.vertices.copy()
    points[7] += (0, 0, 0.005)
    with pytest.warns(RepairWarning, match="flat holes"):
        mesh = check_mesh("p", points, box.faces[~(points[box.faces][:, :, 2] > 0.35).all(axis=1)])
    assert mesh.volume == pytest.approx(0.024, rel=0.02)


def test_a_slit_round_a_corner_is_closed(box):
    """A slit 0.1 mm wide along two edges has hardly an area, and its area vector says nothing about its plane."""
    corner = int(np.flatnonzero((box.vertices == (0.2, 0, 0.4)).all(axis=1))[0])
    points = np.concatenate([box.vertices, [(0.2, 0, 0.3999)]])
    faces = box.faces.copy()
    below = ~(points[faces][:, :, 2] == 0.4).all(axis=1)
    faces[below] = np.where(faces[below] == corner, 8, faces[below])
    with pytest.warns(RepairWarning, match="flat holes"):
        assert check_mesh("p", points, faces).volume == pytest.approx(0.024, rel=1e-3)


def test_parts_that_are_repaired_alike_are_one_warning(box):
    """A file with a hundred blocks that store each face twice is said to do so once."""
    corners, faces = box.vertices, box.faces
    doubled = np.concatenate([faces, faces[:2]])
    parts = [(f"p{number}", corners, doubled) for number in range(8)]
    with pytest.warns(RepairWarning) as caught:
        meshes = check_meshes([*parts, ("alone", corners, faces[:, ::-1]), ("good", corners, faces)])
    assert [mesh.name for mesh in meshes] == [*(name for name, *_ in parts), "alone", "good"]
    assert [str(warning.message) for warning in caught] == [
        "parts p0, p1, p2, p3, p4 and 3 more were repaired: dropped faces that are degenerate or doubled",
        "part alone was repaired: turned surfaces inside out",
    ]
