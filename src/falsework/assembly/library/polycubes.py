"""Cube of interlocking polycubes."""

from __future__ import annotations

from typing import Annotated

from falsework.assembly.library.blocks import Blocks, gather, ground
from falsework.assembly.library.catalogue import Range, structure
from falsework.assembly.library.voxels import random_pieces, surface


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
        surface("piece", piece, (edge,) * 3, (-half, -half, 0.0))
        for piece in random_pieces(cells, pieces, smallest=2, seed=seed)
    ]
    solids.append(ground((-half, -half), (half, half), margin=edge / 2, depth=edge / 2))
    return gather(solids)
