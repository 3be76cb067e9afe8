"""Ways out in several straight moves, against a search over cells that shares nothing with the package."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from falsework import Assembly
from falsework.assembly.library.blocks import Solid, gather
from falsework.assembly.library.voxels import grow_pieces, pinches, surface
from falsework.geometry import find_contacts
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.path_search import PathSearch

EDGE = 0.1
Cells = frozenset[tuple[int, int, int]]
AXES = [d for d in product((-1, 0, 1), repeat=3) if sum(map(abs, d)) == 1]


def cells(x: range, y: range, z: range) -> Cells:
    return frozenset(product(x, y, z))


def solid(piece: Cells, *, fixed: bool = False) -> Solid:
    return replace(surface("piece", piece, (EDGE,) * 3, (0.0, 0.0, 0.0)), fixed=fixed)


def structure(*solids: Solid) -> Assembly:
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def motions_of(*solids: Solid) -> PartMotions:
    meshes = gather(solids).meshes
    return PartMotions(meshes, find_contacts(meshes), 1e-4)


def fewest_moves(piece: Cells, rest: Cells, most: int, aside: tuple[Cells, ...] = ()) -> int | None:
    """Straight moves by cells, of sets of pieces, after which the first is beside all others; None if none do."""
    own = [np.array(sorted(cells)) for cells in (piece, *aside)]
    count = len(own)
    others = np.array(sorted(rest.union(*aside)))
    size = int(np.ptp(np.concatenate([*own, others]), axis=0).max()) + 2
    sets = [some for some in product((0, 1), repeat=count) if any(some)]

    def free(at: tuple[tuple[int, ...], ...]) -> bool:
        filled = set(rest)
        for cells, offset in zip(own, at, strict=True):
            here = set(map(tuple, (cells + offset).tolist()))
            if not filled.isdisjoint(here):
                return False
            filled |= here
        return True

    def out(at: tuple[tuple[int, ...], ...]) -> bool:
        here = own[0] + at[0]
        there = np.concatenate([others, *(cells + offset for cells, offset in zip(own[1:], at[1:], strict=True))])
        return bool(((here > there.max(axis=0)).all(axis=0) | (here < there.min(axis=0)).all(axis=0)).any())

    home = ((0, 0, 0),) * count
    front, seen = {home}, {home}
    for number in range(1, most + 1):
        reached = set()
        for at, some, axis in product(front, sets, AXES):
            for length in range(1, 2 * size):
                shift = length * np.outer(some, axis)
                here = tuple(map(tuple, (np.array(at) + shift).tolist()))
                if not free(here) or np.abs(here).max() > size:
                    break
                if some == (1, *(0,) * (count - 1)) and out(here):
                    return number
                reached.add(here)
        front = reached - seen
        seen |= reached
        if not front:
            return None
    return most + 1


def tunnels(seed: int, size: int = 8) -> tuple[Cells, Cells]:
    """A piece, and a block in which it has dug tunnels at random; some lead out of the block."""
    rng = np.random.default_rng(seed)
    block, axis = cells(*[range(size)] * 3), 0
    while True:
        length = [1, 1, 1]
        length[int(rng.integers(3))] = int(rng.integers(1, 3))
        at = rng.integers(2, size - 3, 3)
        piece = frozenset(tuple((at + d).tolist()) for d in product(*map(range, length)))
        dug, here = set(piece), np.zeros(3, dtype=int)
        for _ in range(int(rng.integers(2, 7))):
            axis = (axis + int(rng.integers(1, 3))) % 3
            way = (1 if rng.random() < 0.5 else -1) * np.eye(3, dtype=int)[axis]
            for _ in range(int(rng.integers(2, 4))):
                here = here + way
                dug |= {tuple((np.array(cell) + here).tolist()) for cell in piece}
        frame = block - dug
        if piece <= block and len(frame) > size**2 and not any(pinches(cell, frame) for cell in frame):
            return piece, frame


@pytest.mark.parametrize("seed", range(40))
def test_pieces_leave_tunnels_in_as_few_moves_as_by_cells(seed: int) -> None:
    piece, frame = tunnels(seed)
    motions, most, others = motions_of(solid(piece), solid(frame)), 7, np.array([False, True])
    expected = fewest_moves(piece, frame, most)
    for moves in range(1, most + 1):
        found = PathSearch(motions, 0, others).run(moves)
        assert (found.way is not None) == (expected is not None and expected <= moves)
        if found.way is not None:
            assert len(found.way) == expected
            assert motions.leaves(found.way, others) == ""
            break
        assert not found.exact or expected is None
    else:
        assert expected is None or expected > most
        if expected is None:  # with one move more than there are poses to reach, the search says that it is proven
            assert PathSearch(motions, 0, others).run(30).exact


def test_tunnels_are_told_apart() -> None:
    found = [fewest_moves(*tunnels(seed), 7) for seed in range(40)]
    assert {None, 1, 2, 3, 5, 6} <= set(found)


def locked_pieces(seed: int) -> tuple[Cells, Cells, Cells, Cells]:
    """A box of cubes cut at random into four pieces, of which the first does not leave alone in one move."""
    rng = np.random.default_rng(seed)
    while True:
        drawn = grow_pieces([*product(range(4), range(3), range(3))], 4, rng)
        pieces = [frozenset(piece) for piece in drawn or ()]
        if pieces and fewest_moves(pieces[0], pieces[1] | pieces[2] | pieces[3], 1) != 1:
            return pieces[0], pieces[1], pieces[2], pieces[3]


@pytest.mark.parametrize("seed", range(1, 12))
def test_pieces_leave_past_others_that_move_aside_in_as_few_moves_as_by_cells(seed: int) -> None:
    pieces = locked_pieces(seed)
    motions, rest, most = motions_of(*map(solid, pieces)), np.array([False, False, False, True]), 3
    expected = fewest_moves(pieces[0], pieces[3], most, pieces[1:3])
    for moves in range(1, most + 1):
        found = PathSearch(motions, 0, rest, (1, 2)).run(moves)
        assert (found.way is not None) == (expected is not None and expected <= moves)
        if found.way is not None:
            assert len(found.way) == expected
            assert motions.leaves(found.way, np.ones(4, dtype=bool)) == ""
            break
        assert not found.exact or expected is None
