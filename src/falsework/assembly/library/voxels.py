"""Random connected pieces of a region of unit cubes, and their surface meshes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set

import numpy as np

from falsework.assembly.library.blocks import Solid
from falsework.errors import InputError

Cell = tuple[int, int, int]
Piece = frozenset[Cell]

STEPS: tuple[Cell, ...] = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_ACROSS = tuple((a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if abs(a) + abs(b) + abs(c) == 2)
_SMALLEST = 2
"""Cubes that each piece has at least."""
_ATTEMPTS = 200
"""Random divisions that are tried before the request is refused."""


def random_pieces(region: Iterable[Cell], pieces: int, *, seed: int) -> tuple[Piece, ...]:
    """Cut a region of cubes at random into connected pieces of similar size that come apart one by one.

    Pieces grow from random cells, always the smallest that still can, and none touches itself along an edge
    only, where its surface would not be a manifold. A draw is thrown away if a piece stays too small or if the
    pieces are locked: some order must exist in which each one leaves straight along an axis, none downwards.

    Args:
        seed: of the random numbers; the same seed gives the same pieces.

    Returns:
        Pieces, lowest first.
    """
    cells = sorted(region)
    if pieces * _SMALLEST <= len(cells):
        random = np.random.default_rng(seed)
        for _ in range(_ATTEMPTS):
            drawn = grow_pieces(cells, pieces, random)
            if drawn is not None and min(map(len, drawn)) >= _SMALLEST and _comes_apart(drawn):
                return tuple(sorted(drawn, key=_height))
    raise InputError(
        f"found no {pieces} pieces of at least {_SMALLEST} cubes in {len(cells)} cubes; "
        "give fewer pieces or another seed"
    )


def grow_pieces(cells: Sequence[Cell], pieces: int, random: np.random.Generator) -> list[Piece] | None:
    """Grow pieces from random cells until the region is full; None if no piece can take what is left.

    The smallest piece goes first, of equal ones that with the least room left. It takes a random cell beside
    it that does not pinch it.
    """
    seeds = [cells[index] for index in random.choice(len(cells), size=pieces, replace=False)]
    grown = [{cell} for cell in seeds]
    left = set(cells).difference(seeds)
    room = [left.intersection(neighbours(cell)) for cell in seeds]
    while left:
        for turn in sorted(range(pieces), key=lambda k: (len(grown[k]), len(room[k]))):
            near = [cell for cell in sorted(room[turn]) if not pinches(cell, grown[turn])]
            if near:
                cell = near[random.integers(len(near))]
                grown[turn].add(cell)
                left.discard(cell)
                for free in room:
                    free.discard(cell)
                room[turn].update(left.intersection(neighbours(cell)))
                break
        else:
            return None
    return [frozenset(piece) for piece in grown]


def neighbours(cell: Cell) -> list[Cell]:
    """Return the six cells that share a face with a cell."""
    x, y, z = cell
    return [(x + dx, y + dy, z + dz) for dx, dy, dz in STEPS]


def _height(piece: Piece) -> tuple[float, list[Cell]]:
    return sum(cell[2] for cell in piece) / len(piece), sorted(piece)


def pinches(cell: Cell, piece: Set[Cell]) -> bool:
    """Return whether a cube meets another of a piece along an edge with no cube of the piece beside both."""
    x, y, z = cell
    for across in _ACROSS:
        if (x + across[0], y + across[1], z + across[2]) in piece:
            first, second = (axis for axis in range(3) if across[axis])
            beside = [list(cell), list(cell)]
            beside[0][first] += across[first]
            beside[1][second] += across[second]
            if not any(tuple(side) in piece for side in beside):
                return True
    return False


def _comes_apart(pieces: Sequence[Piece]) -> bool:
    """Return whether pieces can leave one after the other straight along an axis, never downwards.

    A piece that can leave can still leave when others have gone, so taking any that can is no loss.
    """
    left = list(pieces)
    while left:
        free = next((piece for piece in left if _can_leave(piece, left)), None)
        if free is None:
            return False
        left.remove(free)
    return True


def _can_leave(piece: Piece, present: Sequence[Piece]) -> bool:
    others = np.array([cell for other in present if other is not piece for cell in other]).reshape(-1, 3)
    for axis, sign in ((2, 1), (0, 1), (0, -1), (1, 1), (1, -1)):
        across = [k for k in range(3) if k != axis]
        for cell in piece:
            line = (others[:, across] == [cell[k] for k in across]).all(axis=1)
            if (sign * (others[line, axis] - cell[axis]) > 0).any():
                break
        else:
            return True
    return False


def surface(kind: str, piece: Piece, size: Sequence[float], origin: Sequence[float]) -> Solid:
    """Return the boundary of a piece: one square a cube face that no other cube of the piece covers.

    Args:
        size: edges of a cube along x, y, z, shape (3,), metres.
        origin: where cube (0, 0, 0) starts, shape (3,), metres.
    """
    corners: dict[Cell, int] = {}
    rings = []
    for cell in sorted(piece):
        for step, near in zip(STEPS, neighbours(cell), strict=True):
            if near not in piece:
                rings.append(tuple(corners.setdefault(corner, len(corners)) for corner in _square(cell, step)))
    vertices = np.array(list(corners), dtype=float) * np.asarray(size) + np.asarray(origin)
    return Solid(kind, vertices, tuple(rings))


def _square(cell: Cell, step: Cell) -> list[Cell]:
    """Return corners of the face of a cube that looks along `step`, counter-clockwise from outside."""
    axis = next(k for k in range(3) if step[k])
    u, v = (axis + 1) % 3, (axis + 2) % 3  # u, v and the axis are right-handed
    start = list(cell)
    start[axis] += step[axis] > 0
    ring = []
    for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
        corner = list(start)
        corner[u] += du
        corner[v] += dv
        ring.append((corner[0], corner[1], corner[2]))
    return ring if step[axis] > 0 else ring[::-1]
