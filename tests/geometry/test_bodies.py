"""Blocks in one surface are told apart, however they touch; one solid stays one."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.bodies import separate_solids


def soup(solids, rng=None):
    """Return all triangles with vertices of their own, in any order, as STL has them."""
    corners = np.concatenate([solid.triangles for solid in solids])
    if rng is not None:
        corners = corners[rng.permutation(len(corners))]
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def volumes(vertices, solids):
    return sorted(TriangleMesh.from_arrays("", vertices, faces).volume for faces in solids)


def cuboids(shapes, rng, size=3):
    """Cut a cube into cuboids by random cuts, and leave some out."""
    todo, done = [(np.zeros(3), np.full(3, float(size)))], []
    while todo:
        low, high = todo.pop()
        axis = int(np.argmax((high - low) * rng.uniform(0.5, 1, 3)))
        if high[axis] - low[axis] > 1 and rng.uniform() < 0.9:
            cut = np.floor(rng.uniform(low[axis] + 1, high[axis]))
            middle = np.where(np.arange(3) == axis, cut, high), np.where(np.arange(3) == axis, cut, low)
            todo += [(low, middle[0]), (middle[1], high)]
        else:
            done.append(shapes.box(low, high))
    keep = rng.uniform(size=len(done)) < 0.8
    return [solid for solid, kept in zip(done, keep, strict=True) if kept] or done[:1]


@pytest.mark.parametrize("seed", range(40))
def test_blocks_that_fill_space_with_common_faces_edges_and_corners(shapes, seed):
    rng = np.random.default_rng(seed)
    blocks = cuboids(shapes, rng)
    turned = [shapes.moved(block, (0, 0, 0), shapes.rotation(seed)) for block in blocks]
    vertices, faces = soup(turned, rng)
    found = separate_solids(vertices, faces)
    assert volumes(vertices, found) == pytest.approx(sorted(block.volume for block in blocks))


@pytest.mark.parametrize("seed", range(10))
def test_vertices_that_blocks_share(shapes, seed):
    """As in a model whose vertices were merged, with the faces between the blocks still in it twice."""
    rng = np.random.default_rng(seed)
    blocks = cuboids(shapes, rng, 2)
    vertices, faces = soup(blocks, rng)
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    found = separate_solids(merged, index.ravel()[faces])
    assert volumes(merged, found) == pytest.approx(sorted(block.volume for block in blocks))


def test_wedges_around_an_edge_are_solids_of_their_own(shapes):
    """Prisms like slices of a cake share one edge, and each two of them a face or nothing."""
    angles = np.linspace(0, 2 * np.pi, 8)[:-1]
    slices = [
        shapes.extruded([(0, 0), (np.cos(a), np.sin(a)), (np.cos(b), np.sin(b))], 0, 1)
        for a, b in zip(angles, np.roll(angles, -1), strict=True)
    ]
    for some in (slices, slices[::2], slices[:3]):
        vertices, faces = soup(some)
        assert len(separate_solids(vertices, faces)) == len(some)


def test_hollows_belong_to_the_solid_around_them(shapes):
    outer, inner, other = (
        shapes.box((0, 0, 0), (3, 3, 3)),
        shapes.box((1, 1, 1), (2, 2, 2)),
        shapes.box((3, 0, 0), (4, 3, 3)),
    )
    hollow = TriangleMesh.from_arrays("", inner.vertices, inner.faces[:, ::-1])
    vertices, faces = soup([outer, hollow, other])
    assert volumes(vertices, separate_solids(vertices, faces)) == pytest.approx([9, 26])
    assert len(separate_solids(vertices, faces[:, ::-1])) == 2, "a file that is inside out as a whole"
    vertices, faces = soup([outer, inner])
    assert len(separate_solids(vertices, faces)) == 2, "a solid in a solid is no hollow, and refused later"


def test_solids_that_share_an_edge_and_overlap_are_two(shapes):
    vertices, faces = soup([shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 0), (0.5, 2, 1))])
    assert volumes(vertices, separate_solids(vertices, faces)) == pytest.approx([1, 1])


def test_rounding_of_vertices_tears_no_solid(shapes):
    rng = np.random.default_rng(0)
    solid = shapes.moved(shapes.box((0, 0, 0), (1, 2, 3)), (0, 0, 0), shapes.rotation(1))
    other = shapes.box((9, 0, 0), (10, 1, 1))
    vertices, faces = soup([solid, other])
    assert len(separate_solids(vertices + rng.uniform(-1e-8, 1e-8, vertices.shape), faces)) == 2


def test_faces_without_an_extent_and_doubled_ones_join_nothing(shapes):
    vertices, faces = soup([shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((1, 0, 0), (2, 1, 1))])
    more = np.concatenate([faces, faces[:1], [[0, 0, 1]]])
    found = separate_solids(vertices, more)
    assert sorted(map(len, found)) == [12, 13]


def test_a_fin_makes_it_unclear(shapes):
    box = shapes.box((0, 0, 0), (1, 1, 1))
    edge = box.vertices[box.faces[0]]
    corners = np.concatenate([box.triangles, [[edge[0], edge[1], (5.0, 5.0, 5.0)]]])
    assert separate_solids(corners.reshape(-1, 3), np.arange(39).reshape(-1, 3)) == []
