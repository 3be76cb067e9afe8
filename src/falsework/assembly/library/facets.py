"""Shell of flat-faced blocks from the tangent planes of a concave surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.library.blocks import Solid
from falsework.errors import InputError

Array = NDArray[np.float64]
Cell = list[tuple[tuple[int, int, int], int]]
"""Outline of a cell: nodes, each with the neighbour across the edge that starts there, counter-clockwise from
above. A node is named by the three planes that meet in it; edges of the plan count as -1, -2, ..."""

HalfPlane = tuple[float, float, float]
"""Half plane `a x + b y <= c` as `(a, b, c)`."""


def cut_cells(planes: Array, edges: Array, near: Sequence[Sequence[int]]) -> list[Cell]:
    """Cut the lower envelope of planes over a convex plan into cells, one a plane.

    Args:
        planes: rows `(nx, ny, nz, c)` of `n . x = c` with unit normals that look up, shape (cells, 4).
        edges: vertical planes around the plan, rows like `planes` with normals that look out, shape (edges, 4).
        near: for each plane the others that may bound its cell.

    Returns:
        Outlines on the envelope; neighbouring cells name the nodes that they share alike.
    """
    cells = []
    for cell, others in enumerate(near):
        nx, ny, nz, c = planes[cell]
        reach = 4.0 * float(np.abs(edges[:, 3]).max())
        outline = [(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)]
        labels = [-99] * 4
        walls = [(other, *(planes[other] - planes[cell]).tolist()) for other in others]
        walls += [(-1 - k, *edge.tolist()) for k, edge in enumerate(edges)]
        for label, ax, ay, az, b in walls:
            # On the cell's plane z is linear in x and y, and so a wall is a half plane.
            half_plane = (ax - az * nx / nz, ay - az * ny / nz, b - az * c / nz)
            outline, labels = _clip(outline, labels, half_plane, label)
        if len(outline) < 3:
            raise InputError("a block has no volume left; make the vault flatter or use fewer parts")
        nodes = [_node(cell, labels[k - 1], labels[k]) for k in range(len(labels))]
        cells.append(list(zip(nodes, labels, strict=True)))
    return cells


def _clip(
    outline: list[tuple[float, float]], labels: list[int], half_plane: HalfPlane, label: int
) -> tuple[list[tuple[float, float]], list[int]]:
    """Cut a convex polygon by a half plane; `labels[k]` is of the edge from corner `k` to the next."""
    a, b, c = half_plane
    values = [a * x + b * y - c for x, y in outline]
    if max(values, default=0.0) <= 0.0:
        return outline, labels
    corners: list[tuple[float, float]] = []
    names: list[int] = []
    for k, (x, y) in enumerate(outline):
        after = (k + 1) % len(outline)
        here, there = values[k], values[after]
        if here <= 0.0:
            corners.append((x, y))
            names.append(labels[k])
        if (here <= 0.0) != (there <= 0.0):
            share = here / (here - there)
            corners.append((x + share * (outline[after][0] - x), y + share * (outline[after][1] - y)))
            names.append(label if here <= 0.0 else labels[k])
    return corners, names


def shell_solids(
    planes: Array, edges: Array, groups: Sequence[tuple[str, Sequence[Cell], bool]], thickness: float
) -> list[Solid]:
    """Return solids of cells between the planes shifted by half a thickness down and up.

    The three planes of a node, shifted by the same distance, meet on one line, which lies in all joints that
    meet there. So neighbours share their corners exactly and every joint is flat.

    Args:
        groups: kind, cells and whether it is fixed, one a solid; the cells of a solid are joined.
        thickness: metres.
    """
    names = sorted({node for _, cells, _ in groups for cell in cells for node, _ in cell})
    index = {node: k for k, node in enumerate(names)}
    meeting = np.array([[planes[k] if k >= 0 else edges[-1 - k] for k in node] for node in names])
    shift = np.array([[float(k >= 0) for k in node] for node in names]) * thickness / 2
    levels = [
        np.linalg.solve(meeting[:, :, :3], (meeting[:, :, 3] + sign * shift)[:, :, None])[:, :, 0] for sign in (-1, 1)
    ]
    vertices: Array = np.concatenate(levels).astype(np.float64, copy=False)
    solids = []
    for kind, cells, fixed in groups:
        rings = _outlines(cells, index, len(names))
        for number, ring in enumerate(rings[: 2 * len(cells)]):
            if not _convex(vertices[list(ring)], upward=number >= len(cells)):
                raise InputError(
                    f"thickness {thickness:g} m is too much for blocks this small or this curved; make it thinner"
                )
        used = sorted({corner for ring in rings for corner in ring})
        place = {corner: k for k, corner in enumerate(used)}
        solids.append(Solid(kind, vertices[used], tuple(tuple(place[k] for k in ring) for ring in rings), fixed))
    return solids


def _outlines(cells: Sequence[Cell], index: dict, count: int) -> list[tuple[int, ...]]:
    """Return faces of joined cells: lower and upper faces first, then the joints that no two of them share."""
    lower = [[index[node] for node, _ in cell] for cell in cells]
    rings = [tuple(reversed(corners)) for corners in lower]
    rings += [tuple(k + count for k in corners) for corners in lower]
    sides = {(a, b) for corners in lower for a, b in zip(corners, corners[1:] + corners[:1], strict=True)}
    rings += [(a, b, b + count, a + count) for a, b in sorted(sides) if (b, a) not in sides]
    return rings


def _convex(corners: Array, *, upward: bool) -> bool:
    """Return whether a face is convex and looks the right way; else the joints around it cross before they reach it."""
    along = np.roll(corners, -1, axis=0) - corners
    turn = np.cross(along, np.roll(along, -1, axis=0))
    normal = turn.sum(axis=0)
    return bool((turn @ normal > 0.0).all()) and (normal[2] > 0.0) == upward


def _node(one: int, two: int, three: int) -> tuple[int, int, int]:
    low, middle, high = sorted((one, two, three))
    return low, middle, high
