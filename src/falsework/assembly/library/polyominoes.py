"""Pieces of squares and cubes that interlock, cut at random: a bottle of polyominoes and a cube of polycubes."""

from __future__ import annotations

from typing import Annotated

from falsework.assembly.library.blocks import Blocks, gather, ground
from falsework.assembly.library.catalogue import Range, structure
from falsework.assembly.library.voxels import Cell, random_pieces, surface


@structure("bottle")
def bottle(
    pieces: Annotated[int, Range(2, 120, "polyominoes")] = 11,
    width: Annotated[int, Range(3, 24, "squares across the body")] = 6,
    height: Annotated[int, Range(4, 48, "squares from foot to mouth")] = 10,
    square: Annotated[float, Range(0.001, 10, "edge of a square", "m")] = 0.25,
    seed: Annotated[int, Range(0, 2**31 - 1, "seed of the random cut")] = 0,
) -> Blocks:
    """Upright bottle cut at random into interlocking polyominoes, one square deep.

    It is stable for every seed: the outline never widens upwards, so every square can pass its column's
    weight straight down, and pieces glued from squares in equilibrium are in equilibrium.
    """
    cells = bottle_outline(width, height)
    origin = (-width * square / 2, -square / 2, 0.0)
    solids = [surface("piece", piece, (square,) * 3, origin) for piece in random_pieces(cells, pieces, seed=seed)]
    half = width * square / 2
    solids.append(ground((-half, -square / 2), (half, square / 2), margin=square / 2, depth=square / 2))
    return gather(solids)


def bottle_outline(width: int, height: int) -> list[Cell]:
    """Return squares of the bottle as cubes `(x, 0, z)`: a body, shoulders that step in, and a neck."""
    neck = max(width - 2 * (width // 3), 1)
    body = max(height - height // 4 - (width - neck) // 2, 1)
    cells = []
    for z in range(height):
        inset = min(max(z - body + 1, 0), (width - neck) // 2)
        cells += [(x, 0, z) for x in range(inset, width - inset)]
    return cells


@structure("polycube")
def polycube(
    pieces: Annotated[int, Range(2, 72, "polycubes")] = 14,
    size: Annotated[int, Range(2, 6, "cubes along an edge of the whole")] = 4,
    edge: Annotated[float, Range(0.001, 10, "edge of a cube", "m")] = 0.1,
    seed: Annotated[int, Range(0, 2**31 - 1, "seed of the random cut")] = 0,
) -> Blocks:
    """Cube cut at random into interlocking polycubes that come apart one by one.

    It is stable for every seed, for the reason given for the bottle: columns of cubes carry themselves.
    """
    cells = [(x, y, z) for x in range(size) for y in range(size) for z in range(size)]
    half = size * edge / 2
    solids = [
        surface("piece", piece, (edge,) * 3, (-half, -half, 0.0)) for piece in random_pieces(cells, pieces, seed=seed)
    ]
    solids.append(ground((-half, -half), (half, half), margin=edge / 2, depth=edge / 2))
    return gather(solids)
