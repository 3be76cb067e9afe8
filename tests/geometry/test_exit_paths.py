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


def motions_of(*solids: Solid, turn: float = 0.0) -> PartMotions:
    """Swept tests of solids that are turned about the vertical, rad; only those that are not consist of cells."""
    matrix = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    meshes = gather([replace(one, vertices=one.vertices @ matrix.T) for one in solids]).meshes
    return PartMotions(meshes, find_contacts(meshes), 1e-4)


def fewest_moves(
    piece: Cells, rest: Cells, most: int, aside: tuple[Cells, ...] = (), beside: tuple[Cells, ...] = ()
) -> int | None:
    """Straight moves by cells, of sets of pieces, after which the first is beside all others; None if none do.

    With those of `beside`, as one body in the last move.
    """
    own = [np.array(sorted(cells)) for cells in (piece, *beside, *aside)]
    count, leaving = len(own), 1 + len(beside)
    others = np.array(sorted(rest.union(*aside)))
    size = int(np.ptp(np.concatenate([*own, np.array(sorted(rest))]), axis=0).max()) + 2
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
        placed = [cells + offset for cells, offset in zip(own, at, strict=True)]
        here, there = np.concatenate(placed[:leaving]), np.concatenate([others, *placed[leaving:]])
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
                if some == (1,) * leaving + (0,) * (count - leaving) and out(here):
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


@pytest.mark.parametrize(
    ("seed", "turn"), [*((seed, 0.0) for seed in range(24)), *((seed, 0.3) for seed in range(0, 24, 4))]
)
def test_pieces_leave_tunnels_in_as_few_moves_as_by_cells(seed: int, turn: float) -> None:
    piece, frame = tunnels(seed)
    motions, most, others = motions_of(solid(piece), solid(frame), turn=turn), 7, np.array([False, True])
    expected = fewest_moves(piece, frame, most)
    for moves in range(1, most + 1):
        found = PathSearch(motions, (0,), others).run(moves)
        assert (found.way is not None) == (expected is not None and expected <= moves)
        if found.way is not None:
            assert len(found.way) == expected
            assert motions.leaves(found.way, others) == ""
            break
        assert not found.exact or expected is None
    else:
        assert expected is None or expected > most
        if expected is None:  # with one move more than there are poses to reach, the search says that it is proven
            assert PathSearch(motions, (0,), others).run(30).exact


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


@pytest.mark.parametrize(
    ("seed", "turn"), [*((seed, 0.0) for seed in range(1, 12)), *((seed, 0.3) for seed in (1, 5, 9))]
)
def test_pieces_leave_past_others_that_move_aside_in_as_few_moves_as_by_cells(seed: int, turn: float) -> None:
    pieces = locked_pieces(seed)
    motions, rest, most = motions_of(*map(solid, pieces), turn=turn), np.array([False, False, False, True]), 3
    expected = fewest_moves(pieces[0], pieces[3], most, pieces[1:3])
    for moves in range(1, most + 1):
        found = PathSearch(motions, (0,), rest, (1, 2)).run(moves)
        assert (found.way is not None) == (expected is not None and expected <= moves)
        if found.way is not None:
            assert len(found.way) == expected
            assert motions.leaves(found.way, np.ones(4, dtype=bool)) == ""
            break
        assert not found.exact or expected is None


def test_what_is_beside_the_grid_proves_nothing() -> None:
    """A wall that is no union of cells: ways past the box around it are found, and none is not the last word."""
    piece, ledge = cells(range(1), range(1), range(1)), cells(range(-1, 2), range(-1, 2), range(-1, 0))
    wall = Assembly.from_meshes(motions_of(solid(cells(range(1, 2), range(1), range(1)))).meshes, boundary=[0]).meshes[
        0
    ]
    slope = wall.vertices * (1.0, 1.0, 1.0) + np.where(wall.vertices[:, 2:] > 0.05, (0.037, 0.0, 0.0), 0.0)
    leans = replace(wall, vertices=slope)
    meshes = [*motions_of(solid(piece), solid(ledge)).meshes, leans]
    motions, others = PartMotions(meshes, find_contacts(meshes), 1e-4), np.array([False, True, True])
    found = PathSearch(motions, (0,), others).run(1)
    assert found.way is not None
    assert motions.leaves(found.way, others) == ""
    lid = cells(range(-1, 2), range(-1, 2), range(1, 2)) | {(-1, 0, 0), (0, -1, 0), (0, 1, 0)}
    shut = [*meshes[:2], leans, *motions_of(solid(frozenset(lid))).meshes]
    closed = PathSearch(PartMotions(shut, find_contacts(shut), 1e-4), (0,), np.array([False, True, True, True])).run(3)
    assert closed.way is None
    assert not closed.exact


def test_grids_need_not_be_cubes_nor_begin_at_zero() -> None:
    piece, frame = tunnels(3)
    expected = fewest_moves(piece, frame, 7)
    assert expected is not None
    solids = [
        replace(one, vertices=one.vertices * (0.7, 1.3, 2.1) + (0.123, -4.5, 9.87))
        for one in map(solid, (piece, frame))
    ]
    motions, others = motions_of(*solids), np.array([False, True])
    assert motions.grid((0, 1)) is not None
    assert motions_of(*solids, turn=0.3).grid((0, 1)) is None
    assert PathSearch(motions, (0,), others).run(expected - 1).way is None
    way = PathSearch(motions, (0,), others).run(expected).way
    assert way is not None
    assert motions.leaves(way, others) == ""
