"""Stack of blocks that overhangs an edge."""

from __future__ import annotations

from typing import Annotated

from falsework.assembly.library.blocks import Blocks, box, gather
from falsework.assembly.library.catalogue import Range, structure


@structure("stack")
def stack(
    blocks: Annotated[int, Range(1, 200, "blocks")] = 6,
    overhang: Annotated[float, Range(0, 1.9, "share of the harmonic overhang, 1 is the limit")] = 0.95,
    length: Annotated[float, Range(0.001, 100, "length of a block", "m")] = 0.6,
    height: Annotated[float, Range(0.001, 10, "height of a block", "m")] = 0.12,
    depth: Annotated[float, Range(0.001, 100, "width of a block", "m")] = 0.3,
) -> Blocks:
    """Stack of equal blocks that reaches over the edge of a table by a harmonic sum.

    The block that is `k`-th from the top reaches `overhang * length / (2 k)` beyond what it lies on, so that
    the whole reaches `overhang * length / 2 * (1 + 1/2 + ... + 1/blocks)`. It is stable if and only if
    `overhang <= 1`: then the centre of mass of the blocks above every edge is not beyond it.
    """
    front = 0.0
    solids = []
    for level in range(blocks):
        front += overhang * length / (2 * (blocks - level))
        solids.append(
            box(
                "block",
                (front - length, -depth / 2, level * height),
                (front, depth / 2, (level + 1) * height),
            )
        )
    solids.append(
        box("table", (-length - height, -depth / 2 - height, -height), (0.0, depth / 2 + height, 0.0), fixed=True)
    )
    return gather(solids)
