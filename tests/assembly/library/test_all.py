"""Laws of every built-in structure."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh

from falsework import Assembly
from falsework.assembly import library
from falsework.assembly.library import structures
from falsework.geometry import TriangleMesh

NAMES = [entry.name for entry in structures()]
SPECS = [
    *NAMES,
    "arch:blocks=4,radius=3.5,thickness=1.2,depth=2",
    "catenary:blocks=8,span=1,rise=2.5,thickness=0.1",
    "catenary:blocks=9,span=30,rise=1",
    "dome:rings=3,blocks=5,stagger=0",
    "dome:rings=1,blocks=3,thickness=0.5",
    "vault:parts=30,rise=0.2",
    "vault:parts=125,rise=2,thickness=0.3,support=1.2",
    "vault:parts=90,span=0.5,rise=0.2,thickness=0.01,support=0.05",
    "wall:bricks=1,courses=5",
    "stack:blocks=1,overhang=0",
    "corbel:courses=2",
    "bottle:pieces=20,seed=3",
    "bottle:pieces=4,width=3,height=4",
    "polycube:pieces=6,size=3,seed=5",
    "house:storeys=1,pitch=5,thickness=0.02",
    "house:storeys=4,length=2,width=0.3",
    "shelf:shelves=0",
    "shelf:shelves=5,width=2,thickness=0.05",
]


@cache
def build(spec: str) -> Assembly:
    """Build once what several tests look at."""
    return library.build(spec)


@pytest.mark.parametrize("spec", SPECS)
def test_every_part_is_a_closed_solid(spec: str) -> None:
    for mesh in build(spec).meshes:
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert solid.is_watertight, mesh.name
        assert solid.is_winding_consistent, mesh.name
        assert solid.volume > 0, mesh.name
        assert np.isfinite(mesh.vertices).all()


def winding(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """How often a surface winds around points, from the solid angles of its triangles (van Oosterom, Strackee 1983)."""
    a, b, c = (mesh.triangles[None, :, k] - points[:, None] for k in range(3))
    length_a, length_b, length_c = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    triple = np.einsum("pti,pti->pt", a, np.cross(b, c))
    rest = length_a * length_b * length_c + np.einsum("pti,pti->pt", a, b) * length_c
    rest += np.einsum("pti,pti->pt", b, c) * length_a + np.einsum("pti,pti->pt", c, a) * length_b
    return np.arctan2(triple, rest).sum(axis=1) / (2 * np.pi)


@pytest.mark.parametrize("spec", SPECS)
def test_just_inside_a_face_is_one_part_alone(spec: str) -> None:
    """Parts that passed through each other would share points just inside some face."""
    meshes = build(spec).meshes
    size = np.median([np.ptp(mesh.bounds, axis=0).min() for mesh in meshes])
    inside, owner = [], []
    for number, mesh in enumerate(meshes):
        corners = mesh.triangles
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        inside.append(corners.mean(axis=1) - 1e-5 * size * normals)
        owner.append(np.full(len(corners), number))
    points, owners = np.concatenate(inside), np.concatenate(owner)
    low, high = np.array([mesh.bounds for mesh in meshes]).transpose(1, 0, 2)
    for number, mesh in enumerate(meshes):
        near = ((points >= low[number]) & (points <= high[number])).all(axis=1)
        around = np.round(winding(points[near], mesh))
        np.testing.assert_array_equal(around == 1, owners[near] == number, err_msg=mesh.name)


@pytest.mark.parametrize("name", NAMES)
def test_defaults_stand(name: str, stands) -> None:
    assert stands(build(name))


@pytest.mark.parametrize("spec", SPECS)
def test_the_name_builds_the_same_structure_again(spec: str) -> None:
    first = build(spec)
    again = library.build(first.name)
    assert again.name == first.name
    assert again.identity == first.identity
    for mesh, other in zip(first.meshes, again.meshes, strict=True):
        np.testing.assert_array_equal(mesh.vertices, other.vertices)
        np.testing.assert_array_equal(mesh.faces, other.faces)


@pytest.mark.parametrize("name", NAMES)
def test_parts_are_numbered_and_boundary_comes_last(name: str) -> None:
    assembly = build(name)
    assert [int(part.rpartition("-")[2]) for part in assembly.names] == list(range(assembly.part_count))
    assert 0 < assembly.boundary.sum() < assembly.part_count
    assert (np.diff(assembly.boundary.astype(int)) >= 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_free_lies_below_the_ground(name: str) -> None:
    assembly = build(name)
    lowest = min(mesh.bounds[0, 2] for mesh, fixed in zip(assembly.meshes, assembly.boundary, strict=True) if not fixed)
    assert lowest >= -1e-12
