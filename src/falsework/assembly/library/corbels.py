"""Corbelled arch: two stairs of level blocks that meet at the crown."""

from __future__ import annotations

from typing import Annotated

from falsework.assembly.library.blocks import Blocks, box, gather, ground
from falsework.assembly.library.catalogue import Range, structure
from falsework.errors import InputError


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
