"""Meshes cut by a plane: volumes agree with an independent cut, and nothing is left beyond the plane."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from falsework.viewer.section import Axis, Plane, cut

SOLIDS = {
    "box": trimesh.creation.box(),
    "ball": trimesh.creation.icosphere(subdivisions=2),
    "pipe": trimesh.creation.annulus(0.5, 1.0, 1.0),
    "ring": trimesh.creation.torus(1.0, 0.3),
}


@pytest.mark.parametrize("keeps_high", [False, True])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("solid", list(SOLIDS))
def test_volumes_add_up(solid: str, axis: Axis, keeps_high: bool) -> None:
    """A closed cut encloses what a cut by trimesh encloses, holes and several outlines included."""
    pytest.importorskip("mapbox_earcut", reason="trimesh closes cuts with it")
    mesh, plane = SOLIDS[solid], Plane(axis, 0.13, keeps_high)
    vertices, faces = cut(mesh.vertices, np.asarray(mesh.faces), plane)
    assert plane.heights(vertices[np.unique(faces)]).min() > -1e-9
    out = np.zeros(3)
    out[plane.column] = 1.0 if keeps_high else -1.0
    other = trimesh.intersections.slice_mesh_plane(mesh, out, 0.13 * np.abs(out), cap=True)
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(other.volume, rel=1e-5)


def test_whole_and_gone() -> None:
    box = SOLIDS["box"]
    assert len(cut(box.vertices, np.asarray(box.faces), Plane("x", 2.0))[1]) == len(box.faces)
    assert len(cut(box.vertices, np.asarray(box.faces), Plane("x", -2.0))[1]) == 0


def test_an_open_mesh_is_cut_too() -> None:
    """Its outline is open, so the cut is not closed."""
    box = SOLIDS["box"]
    vertices, faces = cut(box.vertices, np.asarray(box.faces)[:3], Plane("z", 0.1))
    assert len(faces)
    assert vertices[np.unique(faces), 2].max() <= 0.1 + 1e-12
