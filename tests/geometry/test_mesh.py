"""Masses against closed forms, additivity, and an independent library."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from falsework.errors import MeshError
from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.mesh import mass_properties


def test_box_matches_the_closed_form_wherever_it_stands(shapes):
    sides = np.array([0.3, 0.5, 0.7])
    rotation, shift = shapes.rotation(1), np.array([100.0, -200.0, 50.0])
    box = shapes.moved(shapes.box((0, 0, 0), sides), shift, rotation)
    found = mass_properties([box], np.array([2000.0]))
    mass = 2000.0 * sides.prod()
    principal = mass / 12 * (np.sum(sides**2) - sides**2)
    assert found.mass[0] == pytest.approx(mass, rel=1e-9)
    assert found.center[0] == pytest.approx(rotation @ (sides / 2) + shift, abs=1e-9)
    assert found.inertia[0] == pytest.approx(rotation @ np.diag(principal) @ rotation.T, rel=1e-7, abs=1e-7)


def test_random_polyhedra_agree_with_trimesh():
    random = np.random.default_rng(2)
    for _ in range(5):
        points = random.standard_normal((20, 3))
        hull = trimesh.Trimesh(points, ConvexHull(points).simplices)
        hull.fix_normals()
        found = mass_properties([TriangleMesh.from_arrays("hull", hull.vertices, hull.faces)], np.array([3.0]))
        assert found.volume[0] == pytest.approx(hull.volume, rel=1e-9)
        assert found.center[0] == pytest.approx(hull.center_mass, abs=1e-9)
        assert found.inertia[0] == pytest.approx(3.0 * hull.moment_inertia, rel=1e-9, abs=1e-9)


def test_two_halves_weigh_and_turn_as_the_whole(shapes):
    whole = shapes.extruded([(0, 0), (2, 0), (2, 1), (1, 1), (1, 3), (0, 3)], 0, 1)
    halves = [shapes.box((0, 0, 0), (2, 1, 1)), shapes.box((0, 1, 0), (1, 3, 1))]
    one = mass_properties([whole], np.array([5.0]))
    two = mass_properties(halves, np.array([5.0, 5.0]))
    assert two.mass.sum() == pytest.approx(one.mass[0])
    centre = two.mass @ two.center / two.mass.sum()
    assert centre == pytest.approx(one.center[0])
    arm = two.center - centre
    steiner = two.mass[:, None, None] * (
        (arm**2).sum(axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    )
    assert (two.inertia + steiner).sum(axis=0) == pytest.approx(one.inertia[0])


def test_density_is_per_part(shapes):
    boxes = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((2, 0, 0), (3, 1, 1))]
    assert mass_properties(boxes, np.array([1.0, 7.0])).mass == pytest.approx([1.0, 7.0])


def test_a_part_that_looks_inwards_is_refused(shapes):
    box = shapes.box((0, 0, 0), (1, 1, 1), "kerb")
    inside_out = TriangleMesh.from_arrays("kerb", box.vertices, box.faces[:, ::-1])
    with pytest.raises(MeshError, match="kerb"):
        mass_properties([inside_out], np.array([1.0]))


def test_arrays_are_checked_and_frozen():
    with pytest.raises(MeshError, match=r"\(2, 2\)"):
        TriangleMesh.from_arrays("x", np.zeros((2, 2)), [(0, 1, 1)])
    with pytest.raises(MeshError, match="4"):
        TriangleMesh.from_arrays("x", np.zeros((3, 3)), [(0, 1, 2, 0)])
    with pytest.raises(MeshError, match="3 vertices"):
        TriangleMesh.from_arrays("x", np.zeros((3, 3)), [(0, 1, 3)])
    mesh = TriangleMesh.from_arrays("x", np.zeros((3, 3)), [(0, 1, 2)])
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1.0
