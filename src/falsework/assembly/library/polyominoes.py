"""Bottle of polyominoes: planar pieces that interlock."""

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
    solids = [
        surface("piece", piece, (square,) * 3, origin) for piece in random_pieces(cells, pieces, smallest=2, seed=seed)
    ]
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
