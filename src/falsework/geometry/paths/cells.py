"""Search for ways out of parts that are made of cells of one grid, by exact comparisons of whole numbers.

Such parts, the pieces of most puzzles among them, touch and pass each other at shifts by whole cells alone. Two of them
overlap or not by their relative shift: one table for each pair of parts answers all swept tests (as BurrTools does).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import ExitPath, PathMove
from falsework.geometry.mesh.collision import inside
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Parts = tuple[int, ...]
State = tuple[int, ...]
"""Shift of each part that may move, as one number; see `_encoded`."""

_STATES = 200_000
"""States that are looked at, at most."""
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
    _hits: dict[tuple[int, int], frozenset[int] | None] = field(default_factory=dict)

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

    def hits(self, one: int, other: int) -> frozenset[int] | None:
        """Return the shifts of one part past another at which they overlap; None if these are too many to tell."""
        if (one, other) not in self._hits:
            a, b = self.cells(one)[0], self.cells(other)[0]
            few = len(a) * len(b) <= _MOST
            shifts = np.unique(_encoded(b[None] - a[:, None])).tolist() if few else None
            self._hits[one, other] = None if shifts is None else frozenset(shifts)
        return self._hits[one, other]


class CellSearch:
    """Search in breadth over shifts of some parts by cells; of sets that move, all that are pushed move along."""

    def __init__(self, grid: CellGrid, movable: Parts, rest: Parts, around: Array, beside: Array) -> None:
        """Take the parts that may move, the first of which leaves, and the others that are there.

        Args:
            grid: to which all parts that may move belong.
            movable: the parts that may move.
            rest: those that do not.
            around: box around all parts, there or not, shape (2, 3), metres.
            beside: the same without the part that leaves.
        """
        self._grid, self._movable, self._rest = grid, movable, rest
        count = range(len(movable))
        tables = [[grid.hits(one, other) if one != other else frozenset() for other in movable] for one in movable]
        walls = [[(grid.hits(one, other), other) for other in rest] for one in movable]
        self.known = not any(None in row for row in tables) and not any(
            hits is None for row in walls for hits, _ in row
        )
        """Whether the parts are not too many cells to compare."""
        self.fits = all(grid.cells(part)[1] for part in (*movable, *rest))
        """Whether all parts consist of cells; else some at rest count as the box around them."""
        self._hits = [[(tables[i][j] or frozenset(), j) for j in count if j != i] for i in count]
        self._walls = [[(hits or frozenset(), other) for hits, other in row] for row in walls]
        self._stop = [frozenset().union(*(hits for hits, _ in row)) for row in self._walls]
        own = [grid.cells(part)[0] for part in movable]
        self._boxes = [np.stack([cells.min(axis=0), cells.max(axis=0) + 1]).tolist() for cells in own]
        self._homes = grid.box(around).tolist(), grid.box(beside).tolist()
        self._codes = [int(_encoded(np.array(step))) for step in STEPS]
        self._places: dict[int, tuple[int, int, int]] = {}
        self.walls: set[int] = set()
        """Parts at rest that were in the way so far."""

    def run(
        self, moves: int, carried: Callable[[Parts], bool], stands: Callable[[ExitPath, bool], bool] | None
    ) -> tuple[ExitPath | None, bool]:
        """Search for a way out in up to some number of moves; also whether more would not help.

        Arguments as of `PathSearch`.
        """
        home = (0,) * len(self._movable)
        came: dict[State, tuple[State, int, int, int]] = {home: (home, 0, 0, 0)}
        front = [home]
        for number in range(moves):
            reached: list[State] = []
            for at in front:
                last = came[at]
                for step in range(6):
                    for some in self._begun(at, step):
                        if (some == last[1] and step // 2 == last[2] // 2) or not carried(self._named(some)):
                            continue
                        length, free = self._length(at, some, step), self._free(at, some, step)
                        if some == 1 and free >= length:
                            way = self._way(came, at, (some, step, length))
                            if stands is None or stands(way, True):
                                return way, False
                        for cells in range(1, min(free, length) + 1) if number + 1 < moves else ():
                            then = self._shifted(at, some, cells * self._codes[step])
                            if then in came:
                                continue
                            if stands is None or stands(self._way(came, at, (some, step, cells)), False):
                                came[then] = at, some, step, cells
                                reached.append(then)
                if len(came) > _STATES:
                    return None, False
            front = reached
            if not front:
                return None, number + 1 < moves
        return None, False

    def _begun(self, at: State, step: int) -> list[int]:
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
                self.walls.update(other for hits, other in self._walls[i] if here in hits)
        return closed_sets(pushed, blocked)

    def _free(self, at: State, some: int, step: int) -> int:
        """Return by how many cells a set that can begin to move goes until it hits another part."""
        code, cells = self._codes[step], 1
        inside_, outside = [i for i in range(len(at)) if some >> i & 1], ~some
        reach = 2 * max(high - low for low, high in zip(*self._homes[0], strict=True)) + 2
        while cells < reach:
            ahead = (cells + 1) * code
            for i in inside_:
                here = at[i] + ahead
                if any(outside >> j & 1 and here - at[j] in hits for hits, j in self._hits[i]):
                    return cells
                if here in self._stop[i]:
                    self.walls.update(other for hits, other in self._walls[i] if here in hits)
                    return cells
            cells += 1
        return cells

    def _length(self, at: State, some: int, step: int) -> int:
        """Return by how many cells a set moves until one of its parts is beside the box around all others."""
        axis, upwards = step // 2, step % 2 == 0
        low, high = self._homes[some == 1]
        ends = low[axis], high[axis]
        for i, code in enumerate(at):
            if code and not some >> i & 1:
                place = self._place(code)[axis]
                ends = min(ends[0], self._boxes[i][0][axis] + place), max(ends[1], self._boxes[i][1][axis] + place)
        lengths = []
        for i, code in enumerate(at):
            if some >> i & 1:
                near, far = (end[axis] + self._place(code)[axis] for end in self._boxes[i])
                lengths.append(ends[1] - near if upwards else far - ends[0])
        return max(min(lengths), 1)

    def _place(self, code: int) -> tuple[int, int, int]:
        if code not in self._places:
            self._places[code] = _decoded(code)
        return self._places[code]

    def _shifted(self, at: State, some: int, code: int) -> State:
        return tuple(place + code if some >> i & 1 else place for i, place in enumerate(at))

    def _named(self, some: int) -> Parts:
        return tuple(sorted(part for i, part in enumerate(self._movable) if some >> i & 1))

    def _way(self, came: dict[State, tuple[State, int, int, int]], at: State, last: tuple[int, int, int]) -> ExitPath:
        """Return the moves to a state, and one more."""
        return tuple(reversed([self._move(*last), *self._back(came, at)]))

    def _back(self, came: dict[State, tuple[State, int, int, int]], at: State) -> Iterator[PathMove]:
        while came[at][1]:
            at, some, step, cells = came[at]
            yield self._move(some, step, cells)

    def _move(self, some: int, step: int, cells: int) -> PathMove:
        x, y, z = STEPS[step]
        return PathMove(self._named(some), (float(x), float(y), float(z)), float(cells * self._grid.pitch[step // 2]))
