"""Search for a way out of one part in several moves, in which others that robots hold may move aside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import ExitPath, PathMove, apply
from falsework.geometry.paths.cells import CellSearch
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.straight_moves import Parts, StraightMoves
from falsework.geometry.paths.turning_moves import TurningMoves

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_POSES = 2000
"""Poses from which moves are tried, at most."""
_HOME = np.eye(4)


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search for a way out."""

    way: ExitPath | None
    """Moves that take the part out, the fewest that were found; None if none did."""
    walls: Mask
    """Without a way, parts at rest that suffice to close every one that was tried, shape (parts,)."""
    exact: bool
    """Without a way, whether it is proven that no straight moves, however many, take the part out past these."""


@dataclass(frozen=True, eq=False)
class _Node:
    """Poses that moves lead to."""

    poses: dict[int, Array]
    way: ExitPath
    touches: bool = True
    """Whether the last move was as long as it can be, so that the part that moved touches another."""

    def then(self, move: PathMove, *, touches: bool = True) -> _Node:
        """Return the poses after one move more."""
        matrix, poses = move.displacement(), dict(self.poses)
        for part in move.parts:
            poses[part] = matrix @ poses.get(part, _HOME)
        return _Node(poses, (*self.way, move), touches)


class PathSearch:
    """Search in breadth over the poses at which parts touch others, or are level with them.

    The part is out beside the box around all others, there or not, as they are in place. Only it leaves; parts that
    move aside go back as they came, which is free since the way there was.
    """

    def __init__(
        self,
        motions: PartMotions,
        part: int,
        rest: Mask,
        aside: Parts = (),
        *,
        carried: Callable[[Parts], bool] = lambda parts: True,
        stands: Callable[[ExitPath, bool], bool] | None = None,
    ) -> None:
        """Take a structure.

        Args:
            motions: swept tests of its parts.
            part: the part that leaves.
            rest: parts that are there and do not move, shape (parts,).
            aside: parts that are there and may move aside.
            carried: whether robots can carry some parts as one body.
            stands: whether everything stands along a way, and, if the part is out, until others are back in place;
                without it everything does.
        """
        self._carried, self._judge = carried, stands
        self._motions, self._part, self._movable, self._rest = motions, part, (part, *aside), rest
        every = np.ones(len(rest), dtype=bool)
        self._homes = motions.bounds(every), motions.bounds(np.arange(len(rest)) != part)
        self._straight = StraightMoves(motions, self._movable, rest)
        there = rest.copy()
        there[list(self._movable)] = True
        self._turning = TurningMoves(motions, part, there)
        self._corners = {one: _four_corners(motions.box(one)) for one in self._movable}

    def run(self, moves: int, *, turns: bool = False) -> Found:
        """Search for a way out in up to some number of moves.

        Args:
            moves: that number.
            turns: whether the part may also turn, and screw; others that move aside do not.
        """
        by_cells = None if turns else self._by_cells(moves)
        if by_cells is not None:
            return by_cells
        straight = self._straight
        front, tried = [_Node({}, ())], 0
        seen = {self._key(front[0])}
        for number in range(moves):
            if tried + len(front) > _POSES:
                front, straight.exact = front[: _POSES - tried], False
            tried += len(front)
            # Straight ways out first: they take the least time, and turns serve to open them.
            begun = [list(self._begun(node)) for node in front]
            for node, beginnings in zip(front, begun, strict=True):
                for direction, parts in beginnings:
                    if parts == (self._part,):
                        move = straight.move(parts, direction, self._length(node, parts, direction))
                        if straight.free(move, node.poses) and self._stands((*node.way, move), True):
                            return Found((*node.way, move), straight.walls, False)
            reached: list[_Node] = []
            for node, beginnings in zip(front, begun, strict=True):
                following = [node.then(move) for move in self._turns(node)] if turns and node.touches else []
                for then in following:
                    if self._is_out(then) and self._stands(then.way, True):
                        return Found(then.way, straight.walls, False)
                if number + 1 == moves:
                    continue
                for direction, parts in beginnings:
                    most = self._length(node, parts, direction)
                    distances = straight.distances(parts, node.poses, direction, most)
                    for distance in distances:
                        move = straight.move(parts, direction, distance)
                        following.append(node.then(move, touches=distance == distances[-1]))
                for then in following:
                    if self._key(then) not in seen and self._stands(then.way, False):
                        seen.add(self._key(then))
                        reached.append(then)
            front = reached
            if not front:  # more moves would not lead farther
                return Found(None, straight.walls, straight.exact and not turns and number + 1 < moves)
        return Found(None, straight.walls, False)

    def _by_cells(self, moves: int) -> Found | None:
        """Search by whole cells; None where parts are not made of cells of one grid, which leaves the answer open."""
        grid = self._motions.grid(self._movable)
        if grid is None:
            return None
        rest = tuple(np.flatnonzero(self._rest).tolist())
        search = CellSearch(grid, self._movable, rest, *self._homes)
        if not search.known:
            return None
        way, exact = search.run(moves, self._carried, self._judge)
        if way is None and not search.fits:
            return None
        walls = np.zeros_like(self._rest)
        walls[list(search.walls)] = True
        return Found(way, walls, exact)

    def _stands(self, way: ExitPath, out: bool) -> bool:
        return self._judge is None or self._judge(way, out)

    def _key(self, node: _Node) -> bytes:
        """Return a name of poses: where they take the corners of the parts."""
        corners = [apply(node.poses.get(part, _HOME), self._corners[part]) for part in self._movable]
        return np.round(np.array(corners) / (2 * self._motions.tolerance)).astype(np.int64).tobytes()

    def _turns(self, node: _Node) -> Iterator[PathMove]:
        """Yield the free turns of the part; not about the axis of the last move once more."""
        last = node.way[-1] if node.way else None
        for move in self._turning.moves(node.poses, self._box_around(node, (self._part,))):
            if last is None or not (last.turns and abs(np.array(last.direction) @ move.direction) > 1.0 - 1e-9):
                yield move
        self._straight.walls |= self._turning.walls

    def _is_out(self, node: _Node) -> bool:
        """Return whether the part is beside the box around the others."""
        low, high = self._box_around(node, (self._part,))
        box = self._motions.box(self._part, node.poses.get(self._part, _HOME))
        return bool(((box[0] >= high) | (box[1] <= low)).any())

    def _begun(self, node: _Node) -> Iterator[tuple[Array, Parts]]:
        """Yield what can begin to move and where; parts that moved last do not go on, or back, along the same line."""
        last = node.way[-1] if node.way else None
        for direction in self._straight.directions(node.poses):
            again = last is not None and not last.turns and abs(direction @ np.array(last.direction)) > 1.0 - 1e-9
            for parts in self._straight.beginnings(node.poses, direction):
                if (last is None or not (again and parts == last.parts)) and self._carried(parts):
                    yield direction, parts

    def _length(self, node: _Node, parts: Parts, direction: Array) -> float:
        """Return how far parts move until one of them is beside the box around all, m."""
        low, high = self._box_around(node, parts)
        sloped, lengths = np.abs(direction) > 1e-6, []
        for part in parts:
            box = self._motions.box(part, node.poses.get(part, _HOME))
            gap = np.where(direction > 0, high - box[0], box[1] - low)
            lengths.append(float((gap[sloped] / np.abs(direction[sloped])).min()))
        return max(min(lengths), self._straight.first)

    def _box_around(self, node: _Node, parts: Parts) -> Array:
        """Return the box around all parts but the one that leaves where only that moves, shape (2, 3), m.

        It holds parts in place, there or not, and those that are aside where they are.
        """
        low, high = self._homes[parts == (self._part,)]
        for part, pose in node.poses.items():
            if part not in parts:
                box = self._motions.box(part, pose)
                low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
        return np.stack([low, high])


def _four_corners(box: Array) -> Array:
    """Return four corners of a box that do not lie in one plane, shape (4, 3)."""
    return np.concatenate([box[:1], np.where(np.eye(3, dtype=bool), box[1], box[0])])
