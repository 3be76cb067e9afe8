"""Poses of parts that are made of cells of one grid, by exact comparisons of whole numbers.

Such parts, the pieces of most puzzles among them, touch and pass each other at shifts by whole cells alone. Two of them
overlap or not by their relative shift: one table for each pair of parts answers all swept tests (as BurrTools does).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import PathMove
from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.geometry.paths.departure import Departure, Parts

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Shifts = tuple[int, ...]
"""Shift of each part that may move, as one number; see `_encoded`."""
Begun = tuple[int, int]
"""Set of parts, as bits, and the step in which they can begin to move."""

_STATES = 200_000
"""Shifts from which moves are tried, at most."""
_FINER = 4
"""Parts into which the smallest distance of two faces is divided at most, to find a grid."""
_MOST = 4_000_000
"""Pairs of cells of two parts that are compared, and of cells and faces, at most."""
_BASE = 1024
"""Shifts are below half of that, in cells."""
STEPS = tuple(tuple(sign * (axis == k) for k in range(3)) for axis in range(3) for sign in (1, -1))


def _encoded(shift: Index) -> Index:
    """Return shifts, shape (..., 3), as numbers that are added and subtracted as the shifts are."""
    return shift @ np.array([_BASE**2, _BASE, 1])


@cache
def _decoded(code: int) -> tuple[int, int, int]:
    found = []
    for _ in range(3):
        low = (code + _BASE // 2) % _BASE - _BASE // 2
        code, found = (code - low) // _BASE, [low, *found]
    return found[0], found[1], found[2]


def closed_sets(pushed: list[int], blocked: int) -> list[int]:
    """Return the sets that can move as one body, the smaller ones first; a set is a number with a bit for each part.

    Args:
        pushed: for each part itself and those that it pushes.
        blocked: parts that something at rest stops.
    """
    pushed = list(pushed)
    for middle in range(len(pushed)):  # who pushes another moves with it
        for part, some in enumerate(pushed):
            if some >> middle & 1:
                pushed[part] |= pushed[middle]
    found: set[int] = set()
    for some in pushed:
        if not some & blocked:
            found |= {some} | {some | other for other in found}
    return sorted(found, key=lambda some: (some.bit_count(), some))


@dataclass(frozen=True, eq=False)
class CellGrid:
    """Grid along the axes of the world, the cells of parts in it, and which shifts make two of them overlap."""

    meshes: Sequence[TriangleMesh]
    origin: Array
    """Corner of a cell, shape (3,), metres."""
    pitch: Array
    """Edges of a cell, shape (3,), metres."""
    tolerance: float
    """Distance up to which places are one, metres."""
    _cells: dict[int, tuple[Index, bool]] = field(default_factory=dict)
    _hits: dict[tuple[int, int], frozenset[int]] = field(default_factory=dict)

    @staticmethod
    def from_meshes(meshes: Sequence[TriangleMesh], parts: Parts, tolerance: float) -> CellGrid | None:
        """Return the coarsest grid to which all faces of some parts belong; None if there is none."""
        origin, pitch = np.zeros(3), np.zeros(3)
        corners = np.concatenate([meshes[part].triangles for part in parts])
        normals = np.abs(triangle_normals(corners))
        if (np.sort(normals, axis=1)[:, 1] > 1e-6 * normals.max(axis=1)).any():
            return None
        for axis in range(3):
            values = np.unique(corners[:, :, axis])
            lines = values[np.append(True, np.diff(values) > tolerance)]
            least = np.diff(lines).min()
            for finer in range(1, _FINER + 1):
                count = np.round((lines[-1] - lines[0]) * finer / least)
                edge = (lines[-1] - lines[0]) / count
                if np.abs((lines - lines[0]) / edge - np.round((lines - lines[0]) / edge)).max() * edge < tolerance:
                    break
            else:
                return None
            origin[axis], pitch[axis] = lines[0] % edge, edge
        return CellGrid(meshes, origin, pitch, tolerance)

    @property
    def name(self) -> tuple[int, ...]:
        """Grids of one name are one."""
        away = np.where(self.pitch - self.origin < self.tolerance, self.origin - self.pitch, self.origin)
        return tuple(np.round(np.concatenate([away, self.pitch]) / (4 * self.tolerance)).astype(int).tolist())

    def box(self, box: Array) -> Index:
        """Return the cells around a box, shape (2, 3), the upper end excluded."""
        places = (box - self.origin) / self.pitch
        slack = self.tolerance / self.pitch
        return np.stack([np.floor(places[0] + slack), np.ceil(places[1] - slack)]).astype(np.int64)

    def cells(self, part: int) -> tuple[Index, bool]:
        """Return the cells of a part, shape (cells, 3), and whether it fills them; else they are those of its box."""
        if part not in self._cells:
            mesh = self.meshes[part]
            low, high = self.box(mesh.bounds)
            every = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
            places = (mesh.vertices - self.origin) / self.pitch
            fits = bool((np.abs(places - np.round(places)) * self.pitch < 2 * self.tolerance).all())
            normals = np.sort(np.abs(triangle_normals(mesh.triangles)), axis=1)
            fits &= bool((normals[:, 1] <= 1e-6 * normals[:, 2]).all()) and len(every) * len(mesh.faces) <= _MOST
            if fits:
                every = every[inside(self.origin + (every + 0.5) * self.pitch, mesh.triangles)]
            self._cells[part] = every, fits
        return self._cells[part]

    def hits(self, one: int, other: int) -> frozenset[int]:
        """Return the shifts of one part past another at which they overlap."""
        if (one, other) not in self._hits:
            a, b = self.cells(one)[0], self.cells(other)[0]
            self._hits[one, other] = frozenset(np.unique(_encoded(b[None] - a[:, None])).tolist())
        return self._hits[one, other]

    def compares(self, movable: Parts, rest: Mask) -> bool:
        """Return whether parts that may move are not too many cells to compare with each other and those at rest."""
        others = (*movable, *np.flatnonzero(rest).tolist())
        pairs = ((self.cells(one)[0], self.cells(other)[0]) for one in movable for other in others if one != other)
        return all(len(own) * len(theirs) <= _MOST for own, theirs in pairs)


class CellShifts:
    """Shifts of some parts by cells; of sets that move, all that are pushed move along."""

    most = _STATES

    def __init__(self, grid: CellGrid, departure: Departure) -> None:
        """Take the grid to which all parts that may move belong, with `CellGrid.compares`, and those that leave."""
        movable, rest = departure.movable, departure.rest
        self._grid, self._movable, self._carried = grid, movable, departure.carried
        self.home: Shifts = (0,) * len(movable)
        self.exact, self.walls = True, np.zeros_like(rest)
        walls = np.flatnonzero(rest).tolist()
        self.fits = all(grid.cells(part)[1] for part in (*movable, *walls))
        """Whether all parts consist of cells; else some at rest count as the box around them."""
        self._hits = [
            [(grid.hits(one, other), j) for j, other in enumerate(movable) if other != one] for one in movable
        ]
        self._walls = [[(grid.hits(one, other), other) for other in walls] for one in movable]
        self._stop = [frozenset().union(*(hits for hits, _ in row)) for row in self._walls]
        own = [grid.cells(part)[0] for part in movable]
        self._boxes = [np.stack([cells.min(axis=0), cells.max(axis=0) + 1]).tolist() for cells in own]
        self._homes = [grid.box(box).tolist() for box in (departure.around, departure.beside)]
        self._leaving = (1 << len(departure.leaving)) - 1
        self._codes = [int(_encoded(np.array(step))) for step in STEPS]
        self._moves: dict[tuple[int, int, int], PathMove] = {}

    def key(self, at: Shifts) -> Shifts:
        """Return a name of shifts."""
        return at

    def begun(self, at: Shifts, last: PathMove | None) -> Iterator[Begun]:
        """See `RigidPoses`."""
        for step in range(6):
            for some in self._begun(at, step):
                named = self._move(some, step, 1).parts
                again = last is not None and named == last.parts and last.direction[step // 2] != 0.0
                if not again and self._carried(named):
                    yield some, step

    def out(self, at: Shifts, begun: Begun) -> PathMove | None:
        """See `RigidPoses`."""
        some, step = begun
        if some != self._leaving:
            return None
        length = self._length(at, some, step)
        return self._move(some, step, length) if self._free(at, some, step, length) == length else None

    def ends(self, at: Shifts, begun: Begun) -> Iterator[tuple[Shifts, PathMove, bool]]:
        """See `RigidPoses`."""
        some, step = begun
        free, code = self._free(at, some, step, self._length(at, some, step)), self._codes[step]
        for cells in range(1, free + 1):
            then = tuple(place + cells * code if some >> i & 1 else place for i, place in enumerate(at))
            yield then, self._move(some, step, cells), cells == free

    def turned(self, at: Shifts, last: PathMove | None) -> Iterator[tuple[Shifts, PathMove, bool]]:
        """Yield nothing: cells turn in place at most."""
        yield from ()

    def _begun(self, at: Shifts, step: int) -> list[int]:
        """Return the sets of parts that can begin to move, as bits, the smaller ones first."""
        code, every = self._codes[step], range(len(at))
        pushed, blocked = [0] * len(at), 0
        for i in every:
            here = at[i] + code
            pushed[i] = 1 << i
            for hits, j in self._hits[i]:
                if here - at[j] in hits:
                    pushed[i] |= 1 << j
            if here in self._stop[i]:
                blocked |= 1 << i
                self._hit(i, here)
        return closed_sets(pushed, blocked)

    def _hit(self, i: int, here: int) -> None:
        self.walls[[other for hits, other in self._walls[i] if here in hits]] = True

    def _free(self, at: Shifts, some: int, step: int, most: int) -> int:
        """Return by how many cells, up to some number, a set that can begin to move goes until it hits another part."""
        code = self._codes[step]
        inside_, outside = [i for i in range(len(at)) if some >> i & 1], ~some
        for cells in range(2, most + 1):
            for i in inside_:
                here = at[i] + cells * code
                if any(outside >> j & 1 and here - at[j] in hits for hits, j in self._hits[i]):
                    return cells - 1
                if here in self._stop[i]:
                    self._hit(i, here)
                    return cells - 1
        return most

    def _length(self, at: Shifts, some: int, step: int) -> int:
        """Return by how many cells a set moves until a part, or all that leave, are beside the box around others."""
        axis, upwards = step // 2, step % 2 == 0
        leaves = some == self._leaving
        low, high = self._homes[leaves]
        ends = low[axis], high[axis]
        for i, code in enumerate(at):
            if code and not some >> i & 1:
                place = _decoded(code)[axis]
                ends = min(ends[0], self._boxes[i][0][axis] + place), max(ends[1], self._boxes[i][1][axis] + place)
        lengths = []
        for i, code in enumerate(at):
            if some >> i & 1:
                near, far = (end[axis] + _decoded(code)[axis] for end in self._boxes[i])
                lengths.append(ends[1] - near if upwards else far - ends[0])
        return max(max(lengths) if leaves else min(lengths), 1)

    def _move(self, some: int, step: int, cells: int) -> PathMove:
        if (some, step, cells) not in self._moves:
            parts = tuple(sorted(part for i, part in enumerate(self._movable) if some >> i & 1))
            x, y, z = STEPS[step]
            distance = float(cells * self._grid.pitch[step // 2])
            self._moves[some, step, cells] = PathMove(parts, (float(x), float(y), float(z)), distance)
        return self._moves[some, step, cells]
