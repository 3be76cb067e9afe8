"""Thin double-curved vault on four corners, of hexagonal blocks with flat faces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.library.blocks import Blocks, Solid, gather
from falsework.assembly.library.catalogue import Range, structure
from falsework.assembly.library.facets import cut_cells, shell_solids
from falsework.assembly.library.funicular import find_form
from falsework.errors import InputError

Array = NDArray[np.float64]

SLENDERNESS = 0.75
"""Width of a block over its length, both in plan. Bed joints slope by half of it, which must stay well below
the coefficient of friction: neighbours that press from both sides would squeeze a block out otherwise."""

END_SHIFT = 0.15
"""Distance, in widths, by which the centres of the first and last cells of the short courses move outwards: these cells
reach to the free edge and are half a width wider."""


@structure("vault")
def vault(
    parts: Annotated[int, Range(30, 10_000, "parts wanted, springers included")] = 60,
    span: Annotated[float, Range(0.05, 200, "edge of the square plan", "m")] = 4.0,
    rise: Annotated[float, Range(0.005, 100, "crown above the corners, middle surface", "m")] = 1.0,
    thickness: Annotated[float, Range(0.0005, 50, "distance between the outer faces of a block", "m")] = 0.12,
    support: Annotated[float, Range(0.001, 80, "how far springers reach along an edge, centres of cells", "m")] = 0.7,
) -> Blocks:
    """Thin double-curved vault on four corner springers, of staggered hexagonal blocks.

    The middle surface is the funicular form of its own weight at equal horizontal thrust in all directions
    (`Funicular`). Blocks are cut out of the shell by the tangent planes at a staggered grid of points:
    point `x` belongs to block `i` if `d_i(x)`, its signed distance from plane `i`, is the largest of all and
    at most half of `thickness` either way. So blocks are convex, joints are flat and halve the angle between
    two faces, which makes them perpendicular to the middle surface, and every block can leave outwards.

    The number of parts is that of the nearest well-proportioned grid of courses, at most 8 % off `parts`. Cells
    whose centres lie within `support` of a corner along both edges are one springer.

    It stands with a quarter of the usual friction to spare, and under `equilibrium` two robots can build it at every
    size: row by row round the free edges, one robot holding the tip of the row, then the next ring inwards. Under
    `contact` a free edge may slide before it is closed, at some sizes in every order that was tried with two robots;
    four have closed it first, up to 510 parts.
    """
    if rise > span / 2:
        raise InputError(f"rise {rise:g} m is more than half of span {span:g} m; make the vault flatter")
    if support > 0.4 * span:
        raise InputError(f"support {support:g} m is more than 0.4 of span {span:g} m; nothing would be left to build")
    grid = nearest_grid(parts, support / span)
    sites = grid.sites * span
    planes = find_form(span / math.sqrt(2.0), rise).tangent_planes(sites)
    half = span / 2
    edges = np.array([(1.0, 0, 0, half), (-1.0, 0, 0, half), (0, 1.0, 0, half), (0, -1.0, 0, half)])
    cells = cut_cells(planes, edges, grid.near)
    corner = grid.corners(support / span)
    groups = [("block", [cell], False) for cell, of in zip(cells, corner, strict=True) if of < 0]
    groups += [("springer", [cell for cell, of in zip(cells, corner, strict=True) if of == k], True) for k in range(4)]
    return gather(_on_the_ground(shell_solids(planes, edges, groups, thickness)))


@dataclass(frozen=True)
class Grid:
    """Courses of cells over the unit square about the origin; every second course is one cell shorter."""

    courses: int
    """Odd, so that the plan is symmetric."""
    length: int
    """Cells in the first course."""

    @property
    def sites(self) -> Array:
        """Points at which the tangent planes touch, course by course, shape (cells, 2)."""
        long = (np.arange(self.length) + 0.5) / self.length - 0.5
        short = np.arange(1, self.length) / self.length - 0.5
        short[[0, -1]] += np.array([-END_SHIFT, END_SHIFT]) / self.length
        x = [short if course % 2 else long for course in range(self.courses)]
        y = (np.arange(self.courses) + 0.5) / self.courses - 0.5
        return np.column_stack([np.concatenate(x), np.repeat(y, [len(row) for row in x])])

    @property
    def near(self) -> list[list[int]]:
        """Cells whose planes can bound each cell: its own course and the two beside it."""
        sites = self.sites
        reach = np.array([1.8 / self.length, 1.2 / self.courses])
        close = [np.flatnonzero((np.abs(sites - site) < reach).all(axis=1)).tolist() for site in sites]
        return [[other for other in others if other != cell] for cell, others in enumerate(close)]

    def corners(self, support: float) -> NDArray[np.int64]:
        """Return the corner (0 to 3) whose springer each cell belongs to, -1 for none; the corner cells always do.

        Args:
            support: reach along an edge, as a share of the span.
        """
        sites = self.sites
        reach = np.maximum(support, np.array([0.6 / self.length, 0.6 / self.courses]))
        number = (sites[:, 0] > 0) + 2 * (sites[:, 1] > 0)
        return np.where((np.abs(sites) > 0.5 - reach).all(axis=1), number, -1)

    def part_count(self, support: float) -> int:
        """Return blocks and four springers."""
        return int((self.corners(support) < 0).sum()) + 4


def nearest_grid(parts: int, support: float) -> Grid:
    """Return the grid whose number of parts is near `parts` and whose cells are near `SLENDERNESS`.

    Args:
        support: reach of a springer along an edge, as a share of the span.
    """
    guess = math.sqrt(parts * SLENDERNESS)
    choice = [
        Grid(courses, length)
        for courses in range(int(0.8 * guess) // 2 * 2 + 1, int(1.4 * guess) + 3, 2)
        for length in range(int(0.75 * courses / SLENDERNESS), int(1.25 * courses / SLENDERNESS) + 2)
    ]

    def cost(grid: Grid) -> float:
        miss = abs(grid.part_count(support) / parts - 1.0)
        return 10.0 * miss + abs(math.log(grid.courses / grid.length / SLENDERNESS))

    return min(choice, key=cost)


def _on_the_ground(solids: list[Solid]) -> list[Solid]:
    lowest = min(solid.vertices[:, 2].min() for solid in solids)
    drop = np.array([0.0, 0.0, lowest])
    return [Solid(solid.kind, solid.vertices - drop, solid.rings, solid.fixed) for solid in solids]
