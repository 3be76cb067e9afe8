"""Poses of parts that are made of cells of one grid, by exact comparisons of whole numbers.

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
from falsework.geometry.paths.cell_moves import BASE, expand
from falsework.geometry.paths.departure import Departure, Parts
from falsework.utils.interruption import check_interruption

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Walls = tuple[Parts, bytes]
"""Parts that may move, and which others rest."""

_STATES = 200_000
"""Shifts from which moves are tried, at most."""
_FINER = 4
"""Parts into which the smallest distance of two faces is divided at most, to find a grid."""
_MOST = 4_000_000
"""Pairs of cells of two parts that are compared, and of cells and faces, at most."""
_PARTS = 60
"""Parts that may move, at most: sets of them are bits of a number."""
_BATCH = 128
"""Shifts from which moves are computed at a time."""
STEPS = tuple(tuple(sign * (axis == k) for k in range(3)) for axis in range(3) for sign in (1, -1))


def _encoded(shift: Index) -> Index:
    """Return shifts, shape (..., 3), as numbers that are added and subtracted as the shifts are."""
    return shift @ np.array([BASE**2, BASE, 1])


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
    _hits: dict[tuple[int, int], Index] = field(default_factory=dict)
    layers: dict[Walls, CellLayers] = field(default_factory=dict)
    """What was found from where all parts are in place, each carried alone, whichever of them leaves."""

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

    def hits(self, one: int, other: int) -> Index:
        """Return the shifts of one part past another at which they overlap, ascending."""
        if (one, other) not in self._hits:
            a, b = self.cells(one)[0], self.cells(other)[0]
            self._hits[one, other] = np.unique(_encoded(b[None] - a[:, None]))
        return self._hits[one, other]

    def compares(self, movable: Parts, rest: Mask) -> bool:
        """Return whether parts that may move are not too many cells to compare with each other and those at rest."""
        others = (*movable, *np.flatnonzero(rest).tolist())
        pairs = ((self.cells(one)[0], self.cells(other)[0]) for one in movable for other in others if one != other)
        return len(movable) <= _PARTS and all(len(own) * len(theirs) <= _MOST for own, theirs in pairs)


@dataclass(frozen=True, eq=False)
class _Layer:
    """Shifts that as many moves lead to, and no fewer."""

    at: Index
    """As numbers, see `_encoded`; shape (shifts, parts)."""
    move: Index
    """Shift of the layer before, set of parts as bits, step and cells of the last move; shape (shifts, 4)."""
    outs: Index
    """Moves by which a set is out: shift, step, set, cells; shape (moves, 4)."""


class CellLayers:
    """Shifts of some parts by cells, by the fewest moves that lead there; sets that move take along all that they push.

    Where each part is carried alone, what is reached does not depend on which of them leaves.
    """

    @staticmethod
    def of(grid: CellGrid, departure: Departure, boxes: Callable[[Parts], Array]) -> CellLayers:
        """Return those of a departure, with what was found for other parts that leave if that is the same.

        Args:
            grid: all parts that may move belong to it, and `compares`.
            departure: which parts leave.
            boxes: returns the box around all parts in place but some, shape (2, 3), metres.
        """
        if len(departure.leaving) > 1 or departure.carried is not None or departure.stands is not None:
            return CellLayers(grid, departure, boxes)
        name = tuple(sorted(departure.movable)), departure.rest.tobytes()
        if name not in grid.layers:
            grid.layers[name] = CellLayers(grid, departure, boxes)
        return grid.layers[name]

    def __init__(self, grid: CellGrid, departure: Departure, boxes: Callable[[Parts], Array]) -> None:
        several = len(departure.leaving) > 1
        self._grid, self._movable = grid, departure.movable if several else tuple(sorted(departure.movable))
        self._targets = [departure.leaving] if several else [(part,) for part in self._movable]
        self._whole, rest = several, np.flatnonzero(departure.rest).tolist()
        self._rest, self._mask = rest, departure.rest
        self.fits = all(grid.cells(part)[1] for part in (*self._movable, *rest))
        """Whether all parts consist of cells; else some at rest count as the box around them."""
        self.exact = True
        """Whether all moves that matter were tried so far."""
        count, nothing, tables = len(self._movable), np.zeros(0, dtype=np.int64), list[Index]()
        for one in self._movable:
            tables += [nothing if other == one else grid.hits(one, other) for other in self._movable]
            tables.append(np.unique(np.concatenate([nothing, *(grid.hits(one, other) for other in rest)])))
        self._hits = np.concatenate(tables)
        self._start = np.concatenate([[0], np.cumsum([len(table) for table in tables])]).astype(np.int64)
        self._touched = np.zeros(len(self._hits), dtype=np.uint8)
        own = [grid.cells(part)[0] for part in self._movable]
        self._boxes = np.array([[cells.min(axis=0), cells.max(axis=0) + 1] for cells in own], dtype=np.int64)
        self._home = np.array([grid.box(boxes(())), *(grid.box(boxes(some)) for some in self._targets)], dtype=np.int64)
        self._sets = np.array([self._bits(some) for some in self._targets], dtype=np.int64)
        self._steps = _encoded(np.array(STEPS, dtype=np.int64))
        self._layers, self.tried, self._ended = list[_Layer](), 0, False
        self._seen = {np.zeros(count, dtype=np.int64).tobytes()}

    def _bits(self, some: Parts) -> int:
        return sum(1 << self._movable.index(part) for part in some)

    @property
    def walls(self) -> Mask:
        """Parts at rest that moves have hit so far, shape (parts,)."""
        found = np.zeros_like(self._mask)
        count = len(self._movable)
        for row, part in enumerate(self._movable):
            place = slice(*self._start[row * (count + 1) + count : row * (count + 1) + count + 2])
            hit = self._hits[place][self._touched[place] > 0]
            for other in self._rest if len(hit) else ():
                found[other] |= bool(np.isin(hit, self._grid.hits(part, other)).any())
        return found

    def reaches(self, number: int, departure: Departure) -> bool | None:
        """Return whether some number of moves leads to shifts that fewer do not lead to; None where it is not tried.

        That is where as many shifts as a departure wants were tried before.
        """
        while len(self._layers) <= number and not self._ended:
            if self.tried >= departure.most:
                return None
            self._grow(departure)
        return len(self._layers) > number

    def ways(self, number: int, departure: Departure) -> Iterator[ExitPath]:
        """Yield ways on which the parts are out after a number of moves, that is reached, and one more."""
        outs = self._layers[number].outs
        for move in outs[outs[:, 2] == self._bits(departure.leaving)]:
            yield self._followed(number, move)

    def _grow(self, departure: Departure) -> None:
        """Add a layer: the shifts that one more move leads to, and the moves by which sets are out from there."""
        count = len(self._movable)
        at, moved, fresh = np.zeros((1, count), dtype=np.int64), np.array([[0, 0, -1, 0]]), set[bytes]()
        if self._layers:
            front, last = self._layers[-1], len(self._layers) - 1
            onward = self._moves(front.at, front.move, departure, out=False)
            after, reached = front.at[onward[:, 0]] + self._shift(onward), list[int]()
            for row, key in enumerate(after.view(f"V{8 * count}").ravel().tolist() if len(after) else ()):
                if key in self._seen or key in fresh:
                    continue
                if departure.stands is None or departure.stands(self._followed(last, onward[row]), False):
                    fresh.add(key)
                    reached.append(row)
            at, moved = after[reached], onward[reached][:, [0, 2, 1, 3]]
        room = _STATES - self.tried
        exact, at, moved = len(at) <= room, at[:room], moved[:room]
        layer = _Layer(at, moved, self._moves(at, moved, departure, out=True))
        self._seen |= fresh
        self.tried += len(at)
        self.exact &= exact
        self._ended = not len(at)
        self._layers += [layer] * (not self._ended)

    def _followed(self, number: int, move: Index) -> ExitPath:
        """Return the moves that lead to a shift of a layer, and one more from there, as in `_Layer.outs`."""
        node, step, some, cells = move.tolist()
        return (*self._way(number, node), self._move(some, step, cells))

    def _moves(self, at: Index, moved: Index, departure: Departure, *, out: bool) -> Index:
        """Return the moves from shifts by which sets are out, or to other shifts, in the order in which to try them."""
        found = [np.zeros((0, 4), dtype=np.int64)]
        for first in range(0, len(at), _BATCH):
            check_interruption(large=True)
            rows = slice(first, first + _BATCH)
            some = self._ordered(self._expanded(at[rows], moved[rows], out=out), departure)
            some[:, 0] += first
            found.append(some)
        return np.concatenate(found)

    def _shift(self, moves: Index) -> Index:
        """Return how moves displace each part, as numbers, shape (moves, parts)."""
        inside_ = moves[:, 2, None] >> np.arange(len(self._movable)) & 1
        return inside_ * (self._steps[moves[:, 1]] * moves[:, 3])[:, None]

    def _expanded(self, at: Index, moved: Index, *, out: bool) -> Index:
        last = np.stack([moved[:, 1], np.where(moved[:, 2] < 0, -1, moved[:, 2] // 2)], axis=1)
        room, counts = 64 * len(at), np.zeros(2, dtype=np.int64)
        while True:
            rows = np.zeros((room, 4), dtype=np.int64)
            expand(
                np.ascontiguousarray(at), last, self._steps, self._hits, self._start, self._touched, self._boxes,
                self._home, self._sets, self._whole, out, rows, counts,
            )  # fmt: skip
            if counts[0] <= room:
                break
            room = int(counts[0])
        self.exact &= bool(counts[1] == 0)
        return rows[: counts[0]]

    def _ordered(self, moves: Index, departure: Departure) -> Index:
        """Return those moves that robots can make, by shift, step, number of parts, set and cells."""
        sets, places = np.unique(moves[:, 2], return_inverse=True)
        able = np.array([departure.can_carry(self._move(some, 0, 1).parts) for some in sets.tolist()], dtype=bool)
        size = np.array([some.bit_count() for some in sets.tolist()], dtype=np.int64)
        keys = moves[:, 3], moves[:, 2], size[places], moves[:, 1], moves[:, 0]
        order = np.lexsort(keys)
        return moves[order[able[places][order]]]

    def _way(self, number: int, node: int) -> ExitPath:
        """Return the moves that lead to a shift of a layer."""
        moves = []
        for layer in reversed(self._layers[1 : number + 1]):
            before, some, step, cells = layer.move[node].tolist()
            moves.append(self._move(some, step, cells))
            node = before
        return tuple(reversed(moves))

    def _move(self, some: int, step: int, cells: int) -> PathMove:
        parts = tuple(sorted(part for i, part in enumerate(self._movable) if some >> i & 1))
        x, y, z = STEPS[step]
        return PathMove(parts, (float(x), float(y), float(z)), float(cells * self._grid.pitch[step // 2]))
