"""Level blocks on each other: a wall, a corbelled arch, and a stack that overhangs an edge."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from falsework.assembly.library.blocks import Blocks, box, gather, ground
from falsework.assembly.library.catalogue import Range, structure
from falsework.errors import InputError


@structure("wall")
def wall(
    bricks: Annotated[int, Range(1, 500, "bricks in a course")] = 5,
    courses: Annotated[int, Range(1, 500, "courses")] = 6,
    length: Annotated[float, Range(0.001, 10, "length of a brick", "m")] = 0.24,
    height: Annotated[float, Range(0.001, 10, "height of a brick", "m")] = 0.08,
    depth: Annotated[float, Range(0.001, 10, "width of a brick", "m")] = 0.12,
) -> Blocks:
    """Straight wall in running bond, laid dry.

    Every second course starts and ends with half a brick, so the ends are straight.
    """
    total = bricks * length
    solids = []
    for course in range(courses):
        joints = [k * length for k in range(bricks + 1)]
        if course % 2:
            joints = [0.0, *(joint + length / 2 for joint in joints[:-1]), total]
        for start, end in pairwise(joints):
            low = (start - total / 2, -depth / 2, course * height)
            solids.append(box("brick", low, (end - total / 2, depth / 2, (course + 1) * height)))
    solids.append(ground((-total / 2, -depth / 2), (total / 2, depth / 2), margin=height, depth=height))
    return gather(solids)


@structure("corbel")
def corbel(
    courses: Annotated[int, Range(2, 500, "courses of two blocks each")] = 6,
    span: Annotated[float, Range(0.001, 100, "clear width on the ground", "m")] = 1.0,
    length: Annotated[float, Range(0.001, 100, "length of a block along the span", "m")] = 0.7,
    height: Annotated[float, Range(0.001, 10, "height of a block", "m")] = 0.15,
    depth: Annotated[float, Range(0.001, 100, "width across the span", "m")] = 0.4,
) -> Blocks:
    """Corbelled arch of level blocks whose courses step inwards until they meet.

    Every course reaches `step = span / (2 (courses - 1))` beyond the one below. Half of the arch is stable by itself if
    and only if `step <= length / courses`: `k` blocks on top of another have their centre of mass `(k + 1) step / 2`
    beyond its middle, and must not pass its edge at `length / 2`.
    """
    step = span / (2 * (courses - 1))
    if step >= length:
        raise InputError(f"blocks of {length:g} m cannot rest on each other in steps of {step:g} m; add courses")
    solids = []
    for course in range(courses):
        inner = step * (courses - 1 - course)
        low, high = course * height, (course + 1) * height
        solids.append(box("block", (-inner - length, -depth / 2, low), (-inner, depth / 2, high)))
        solids.append(box("block", (inner, -depth / 2, low), (inner + length, depth / 2, high)))
    outer = span / 2 + length
    solids.append(ground((-outer, -depth / 2), (outer, depth / 2), margin=height, depth=height))
    return gather(solids)


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
