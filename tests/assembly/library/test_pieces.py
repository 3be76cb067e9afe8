"""Polyominoes and polycubes: a cut is a partition, its pieces come apart, and columns carry themselves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from falsework.assembly.library import bottle, polycube
from falsework.assembly.library.polyominoes import bottle_outline
from falsework.assembly.library.voxels import Cell, Piece, neighbours, random_pieces, surface
from falsework.errors import InputError

SEEDS = range(8)


def connected(piece: Piece) -> bool:
    """Flood fill."""
    reached = {min(piece)}
    edge = list(reached)
    while edge:
        edge = [cell for near in edge for cell in neighbours(near) if cell in piece and cell not in reached]
        reached |= set(edge)
    return reached == piece


def cube(size: int) -> list[Cell]:
    return [(x, y, z) for x, y, z in itertools.product(range(size), repeat=3)]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("region", "pieces"), [(bottle_outline(6, 10), 11), (cube(4), 14), (cube(3), 5)])
def test_pieces_are_a_partition_into_connected_parts(region: list[Cell], pieces: int, seed: int) -> None:
    cut = random_pieces(region, pieces, seed=seed)
    assert len(cut) == pieces
    assert sorted(cell for piece in cut for cell in piece) == sorted(region)
    assert all(connected(piece) and len(piece) >= 2 for piece in cut)


@pytest.mark.parametrize("seed", SEEDS)
def test_polycube_comes_apart(seed: int) -> None:
    """Rays from each cube, in an order found by trying: independent of how the generator looks at it."""
    left = list(random_pieces(cube(4), 10, seed=seed))
    while left:
        for piece in left:
            others = {cell for other in left if other is not piece for cell in other}
            rays = [
                {tuple(np.add(cell, k * np.array(way))) for cell in piece for k in range(1, 5)}
                for way in ((0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
            ]
            if any(not ray & others for ray in rays):
                left.remove(piece)
                break
        else:
            pytest.fail("the pieces are locked")


@pytest.mark.parametrize("seed", SEEDS)
def test_they_stand_whatever_the_seed(seed: int, stands) -> None:
    assert stands(bottle(seed=seed))
    assert stands(polycube(seed=seed))


@pytest.mark.parametrize(("structure", "edge"), [(bottle, 0.25), (polycube, 0.1)])
def test_volume_and_contact_area_count_cubes_and_shared_faces(structure, edge: float) -> None:
    assembly = structure(seed=2)
    cells = bottle_outline(6, 10) if structure is bottle else cube(4)
    assert assembly.mass.volume[:-1].sum() == pytest.approx(len(cells) * edge**3)
    pieces = random_pieces(cells, assembly.part_count - 1, seed=2)
    of = {cell: number for number, piece in enumerate(pieces) for cell in piece}
    area: dict[tuple[int, int], float] = {}
    for cell in cells:
        for near in neighbours(cell):
            if near in of and of[near] > of[cell]:
                area[of[cell], of[near]] = area.get((of[cell], of[near]), 0.0) + edge**2
        if cell[2] == 0:
            key = of[cell], len(pieces)
            area[key] = area.get(key, 0.0) + edge**2
    found: dict[tuple[int, int], float] = {}
    for (a, b), size in zip(assembly.contacts.parts.tolist(), assembly.contacts.areas, strict=True):
        found[a, b] = found.get((a, b), 0.0) + size
    assert found.keys() == area.keys()
    for pair, size in area.items():
        assert found[pair] == pytest.approx(size, rel=1e-6)


def test_the_outline_never_widens_upwards() -> None:
    for width, height in itertools.product(range(3, 25), range(4, 49)):
        cells = set(bottle_outline(width, height))
        assert all((x, 0, z - 1) in cells for x, _, z in cells if z)
        assert max(z for _, _, z in cells) == height - 1
        assert sum(z == 0 for _, _, z in cells) == width


def test_seeds_differ() -> None:
    assert bottle(seed=1).identity != bottle(seed=2).identity
    assert polycube(seed=1).identity != polycube(seed=2).identity


def test_surface_of_a_known_piece() -> None:
    piece = frozenset({(0, 0, 0), (1, 0, 0), (1, 0, 1)})
    solid = surface("piece", piece, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    assert len(solid.rings) == 6 * 3 - 2 * 2
    assert len(solid.vertices) == 16


def test_too_many_pieces_are_refused_at_once() -> None:
    with pytest.raises(InputError, match="found no 5 pieces of at least 2 cubes in 8 cubes"):
        random_pieces(cube(2), 5, seed=0)
