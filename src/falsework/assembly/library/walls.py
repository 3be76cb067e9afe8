"""Wall in running bond."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from falsework.assembly.library.blocks import Blocks, box, gather, ground
from falsework.assembly.library.catalogue import Range, structure


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
