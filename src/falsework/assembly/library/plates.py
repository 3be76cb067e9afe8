"""House of slotted plates, which can be disassembled, and a shelf whose parts interlock."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated

import numpy as np

from falsework.assembly.library.blocks import Blocks, Solid, box, gather, ground, prism
from falsework.assembly.library.catalogue import Range, structure
from falsework.assembly.library.voxels import Cell, surface
from falsework.errors import InputError

Interval = tuple[float, float]


@structure("house")
def house(
    storeys: Annotated[int, Range(1, 20, "storeys, the top one with gables")] = 2,
    length: Annotated[float, Range(0.05, 100, "distance between the side walls", "m")] = 0.6,
    width: Annotated[float, Range(0.05, 100, "distance between front and back", "m")] = 0.4,
    height: Annotated[float, Range(0.02, 10, "height of a storey", "m")] = 0.25,
    thickness: Annotated[float, Range(0.001, 1, "thickness of a plate", "m")] = 0.04,
    pitch: Annotated[float, Range(1, 25, "slope of the roof; friction alone keeps it", "degrees")] = 20.0,
) -> Blocks:
    """House of plates that cross each other in slots and can be disassembled along free directions.

    Front and back have slots that are open above, the side walls slots that are open below: a side wall leaves
    upwards only, and front and back are free only when both side walls have left. A floor, and at the top two
    roof plates, cover all four. Every plate is stable by itself on the parts below it.
    """
    overhang = 1.5 * thickness
    if min(length, width) < 3 * thickness or height < 2 * thickness:
        raise InputError(f"walls of {thickness:g} m leave no room inside; make them thinner")
    solids: list[Solid] = []
    outer, across = length / 2 + overhang, width / 2 + overhang
    slope = math.tan(math.radians(pitch))
    for storey in range(storeys):
        base, top = storey * (height + thickness), storey * (height + thickness) + height
        last = storey == storeys - 1
        for side in (-1, 1):
            solids.append(_cross_wall(side * width / 2, (base, top), length, outer, thickness, slope if last else 0.0))
        for side in (-1, 1):
            solids.append(_side_wall(side * length / 2, (base, top), width, across, thickness))
        if not last:
            solids.append(box("floor", (-outer, -across, top), (outer, across, top + thickness)))
    eaves = storeys * (height + thickness) - thickness
    ridge = eaves + slope * outer
    for side in (-1, 1):
        corners = [(0.0, ridge), (outer, eaves), (outer, eaves + thickness), (0.0, ridge + thickness)]
        base_ring = [(side * x, -across, z) for x, z in corners]
        solids.append(prism("roof", base_ring, (0.0, 2 * across, 0.0)))
    solids.append(ground((-outer, -across), (outer, across), margin=thickness, depth=thickness))
    return gather(solids)


def _cross_wall(y: float, heights: Interval, length: float, outer: float, thickness: float, slope: float) -> Solid:
    """Return the front or back wall: slots open above at the side walls; a gable under a sloped roof."""
    base, top = heights
    inner_edge, outer_edge = length / 2 - thickness / 2, length / 2 + thickness / 2
    middle = (base + top) / 2

    def roof(x: float) -> float:
        return top + slope * (outer - abs(x))

    # Columns between breaks along x: each is a quadrilateral whose top may slope.
    breaks = [-outer, -outer_edge, -inner_edge, 0.0, inner_edge, outer_edge, outer]
    columns = []
    for left, right in pairwise(breaks):
        slot = inner_edge < abs(left + right) / 2 < outer_edge
        columns.append((left, right, *((middle, middle) if slot else (roof(left), roof(right)))))
    return _columns("wall", columns, base, middle, (y - thickness / 2, y + thickness / 2))


def _side_wall(x: float, heights: Interval, width: float, across: float, thickness: float) -> Solid:
    """Return a side wall: slots open below where front and back cross."""
    base, top = heights
    middle = (base + top) / 2
    near, far = width / 2 - thickness / 2, width / 2 + thickness / 2
    lines_y = [-across, -far, -near, near, far, across]
    cells = [(0, y, z) for y in range(5) for z in range(2) if not (y in (1, 3) and z == 0)]
    lines_x = [x - thickness / 2, x + thickness / 2]
    return _on_grid("side", cells, (lines_x, lines_y, [base, middle, top]))


def _columns(
    kind: str, columns: Sequence[tuple[float, float, float, float]], base: float, middle: float, depth: Interval
) -> Solid:
    """Return the plate in the xz-plane out of columns side by side, each from `base` to a top that may slope.

    Args:
        columns: left x, right x, height on the left, height on the right; neighbours share an x.
        base: height of the lower edge.
        middle: height at which every column is cut, so that neighbours of different height share corners.
        depth: extent along y.
    """
    corners: dict[tuple[float, float, float], int] = {}
    rings: list[tuple[int, ...]] = []

    def face(*points: tuple[float, float, float]) -> None:
        distinct = [point for k, point in enumerate(points) if point != points[k - 1]]
        if len(distinct) > 2:
            rings.append(tuple(corners.setdefault(point, len(corners)) for point in distinct))

    near, far = depth
    for left, right, high_left, high_right in columns:
        for low, left_top, right_top in ((base, middle, middle), (middle, high_left, high_right)):
            face((left, near, low), (right, near, low), (right, near, right_top), (left, near, left_top))
            face((left, far, left_top), (right, far, right_top), (right, far, low), (left, far, low))
        face((left, near, base), (left, far, base), (right, far, base), (right, near, base))
        face(
            (left, near, high_left),
            (right, near, high_right),
            (right, far, high_right),
            (left, far, high_left),
        )
    # Upright faces between neighbours, where one rises above the other, and at both ends.
    ends = [(columns[0][0], base, columns[0][2]), (columns[-1][1], base, columns[-1][3])]
    for x, low, high, outwards in ((*ends[0], -1), (*ends[1], 1)):
        for lower, upper in ((low, middle), (middle, high)):
            _upright(face, x, lower, upper, depth, outwards)
    for one, two in pairwise(columns):
        if one[3] != two[2]:
            _upright(face, one[1], min(one[3], two[2]), max(one[3], two[2]), depth, 1 if one[3] > two[2] else -1)
    return Solid(kind, np.array(list(corners)), tuple(rings))


def _upright(face, x: float, low: float, high: float, depth: Interval, outwards: int) -> None:
    near, far = depth
    points = [(x, near, low), (x, far, low), (x, far, high), (x, near, high)]
    face(*(points if outwards > 0 else points[::-1]))


@structure("shelf")
def shelf(
    shelves: Annotated[int, Range(0, 20, "loose shelves below the top")] = 3,
    width: Annotated[float, Range(0.05, 100, "clear width between the uprights", "m")] = 0.5,
    depth: Annotated[float, Range(0.09, 100, "depth of an upright", "m")] = 0.36,
    gap: Annotated[float, Range(0.01, 10, "clear height between shelves", "m")] = 0.15,
    thickness: Annotated[float, Range(0.003, 1, "thickness of a shelf", "m")] = 0.03,
) -> Blocks:
    """Shelf whose last four parts interlock: it cannot be disassembled one part at a time.

    The loose shelves slide out to the front. The top is two boards that are joined by tongue and groove and hang with
    T-shaped tenons in slots of both uprights, which are open above. The slots stop the boards along x and y, the groove
    stops each board from going up without the other, and the tenons stop the uprights in all directions. Both boards
    together lift off: there is a plan with two parts at once, and the exhaustive search proves that there is none with
    one at a time where a part must have a straight exit.
    """
    # Cells: along x the head of a tenon, its neck, the inside, neck, head; along y nine; along z see `levels`.
    lines_x = np.cumsum([-width / 2 - 2 * thickness, thickness, thickness, width, thickness, thickness])
    lines_y = np.linspace(-depth / 2, depth / 2, 10)
    levels = [gap, thickness] * shelves + [gap] + [thickness / 3] * 3
    lines_z = np.concatenate([[0.0], np.cumsum(levels)])
    low = len(levels) - 3  # lowest of the three layers of the top
    grooves = [2 * k + 1 for k in range(shelves)]

    front = _top_board(range(4), low)
    front += [(2, 4, low + 1)]
    back = _top_board(range(5, 9), low)
    back += [(2, 4, low), (2, 4, low + 2)]
    tenons = {cell for cell in (*front, *back) if cell[0] != 2}
    boards = [[(x, y, z) for x in (1, 2, 3) for y in range(8 if x != 2 else 9)] for z in grooves]
    taken = tenons.union(*map(set, boards)) if boards else tenons
    grid = (lines_x, lines_y, lines_z)
    solids = [
        _on_grid("upright", [c for x in pair for c in _column_cells(x, len(levels)) if c not in taken], grid)
        for pair in ((0, 1), (3, 4))
    ]
    solids += [_on_grid("board", cells, grid) for cells in boards]
    solids += [_on_grid("top", cells, grid) for cells in (front, back)]
    half = width / 2 + 2 * thickness
    solids.append(ground((-half, -depth / 2), (half, depth / 2), margin=thickness, depth=thickness))
    return gather(solids)


def _top_board(rows: range, low: int) -> list[Cell]:
    """Return one board of the top: its body between the uprights, and at either end a tenon with neck and head."""
    middle = rows[1] + (1 if rows[0] == 0 else 0)
    cells = []
    for z in range(low, low + 3):
        cells += [(2, y, z) for y in rows]
        for neck, head in ((1, 0), (3, 4)):
            cells += [(neck, middle, z), *((head, middle + side, z) for side in (-1, 0, 1))]
    return cells


def _column_cells(x: int, levels: int) -> list[Cell]:
    return [(x, y, z) for y in range(9) for z in range(levels)]


def _on_grid(kind: str, cells: Iterable[Cell], lines: Sequence[Sequence[float] | np.ndarray]) -> Solid:
    """Return the surface of a piece made of cells between grid lines along x, y and z."""
    solid = surface(kind, frozenset(cells), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    index = np.rint(solid.vertices).astype(int)
    vertices = np.stack([np.asarray(lines[axis])[index[:, axis]] for axis in range(3)], axis=1)
    return replace(solid, vertices=vertices)
