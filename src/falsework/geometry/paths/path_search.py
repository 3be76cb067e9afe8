"""Search for a way out of some parts in several moves, in which others that robots hold may move aside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from falsework.geometry.clearance.moves import ExitPath, PathMove
from falsework.geometry.paths.cells import CellShifts
from falsework.geometry.paths.departure import Departure, Mask, Parts
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.rigid_poses import RigidPoses


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search for a way out."""

    way: ExitPath | None
    """Moves that take the parts out, the fewest that were found; None if none did."""
    walls: Mask
    """Without a way, parts at rest that suffice to close every one that was tried, shape (parts,)."""
    exact: bool
    """Without a way, whether it is proven that no straight moves, however many, take the parts out past these."""


class _Poses(Protocol):
    """Poses of one kind, see `RigidPoses`; what they are, and what `begun` yields, only they know."""

    home: Any
    most: int
    exact: bool
    walls: Mask

    def key(self, at: Any) -> Any: ...
    def begun(self, at: Any, last: PathMove | None) -> Iterator[Any]: ...
    def out(self, at: Any, begun: Any) -> PathMove | None: ...
    def ends(self, at: Any, begun: Any) -> Iterator[tuple[Any, PathMove, bool]]: ...
    def turned(self, at: Any, last: PathMove | None) -> Iterator[tuple[Any, PathMove, bool]]: ...


@dataclass(frozen=True, eq=False)
class _Node:
    """Pose that moves lead to."""

    at: Any
    move: PathMove | None = None
    before: _Node | None = None
    touches: bool = True
    """Whether the last move was as long as it can be, so that the part that moved touches another."""

    def way(self, last: PathMove | None = None) -> ExitPath:
        """Return the moves from home, and one more."""
        moves = [] if last is None else [last]
        node: _Node | None = self
        while node is not None and node.move is not None:
            moves.append(node.move)
            node = node.before
        return tuple(reversed(moves))


class PathSearch:
    """Search in breadth over poses: by whole cells where parts consist of them, else where they touch or are level.

    The parts are out as one body beside the box around all others, there or not, as they are in place. Only they
    leave; parts that move aside go back as they came, which is free since the way there was.
    """

    def __init__(
        self,
        motions: PartMotions,
        leaving: Parts,
        rest: Mask,
        aside: Parts = (),
        *,
        carried: Callable[[Parts], bool] = lambda parts: True,
        stands: Callable[[ExitPath, bool], bool] | None = None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Take a structure.

        Args:
            motions: swept tests of its parts.
            leaving: the parts that leave, together if there are several; alone one may also turn.
            rest: parts that are there and do not move, shape (parts,).
            aside: parts that are there and may move aside.
            carried: whether robots can carry some parts as one body.
            stands: whether everything stands along a way, and, if the parts are out, until others are back in place;
                without it everything does.
            check: called from time to time; what it raises ends the search.
        """
        self._motions, self._check = motions, check
        self._stands = stands or (lambda way, out: True)
        every = np.ones(len(rest), dtype=bool)
        boxes = motions.bounds(every), motions.bounds(~np.isin(np.arange(len(rest)), leaving))
        self._departure = Departure(leaving, (*leaving, *aside), rest, *boxes, carried)

    def run(self, moves: int, *, turns: bool = False) -> Found:
        """Search for a way out in up to some number of moves.

        Args:
            moves: that number.
            turns: whether a part that leaves alone may also turn, and screw; others that move aside do not.
        """
        departure = self._departure
        grid = None if turns else self._motions.grid(departure.movable)
        if grid is not None and grid.compares(departure.movable, departure.rest):
            shifts = CellShifts(grid, departure)
            found = self._search(shifts, moves)
            if found.way is not None or shifts.fits:
                return found
        return self._search(RigidPoses(self._motions, departure, turns=turns), moves)

    def _search(self, poses: _Poses, moves: int) -> Found:
        """Search over poses of one kind; what `begun` yields their other methods take."""
        front, tried, seen = [_Node(poses.home)], 0, {poses.key(poses.home)}
        for number in range(moves):
            if tried + len(front) > poses.most:
                front, poses.exact = front[: poses.most - tried], False
            tried += len(front)
            # Straight ways out first: they take the least time, and turns serve to open them.
            starts = []
            for node in front:
                self._check()
                starts.append(list(poses.begun(node.at, node.move)))
                for begun in starts[-1]:
                    out = poses.out(node.at, begun)
                    if out is not None and self._stands(node.way(out), True):
                        return Found(node.way(out), poses.walls, False)
            reached: list[_Node] = []
            for node, beginnings in zip(front, starts, strict=True):
                self._check()
                following = []
                for at, move, out in poses.turned(node.at, node.move) if node.touches else ():
                    if out and self._stands(node.way(move), True):
                        return Found(node.way(move), poses.walls, False)
                    following.append((at, move, True))
                if number + 1 == moves:
                    continue
                for begun in beginnings:
                    following.extend(poses.ends(node.at, begun))
                for at, move, touches in following:
                    key = poses.key(at)
                    if key not in seen and self._stands(node.way(move), False):
                        seen.add(key)
                        reached.append(_Node(at, move, node, touches))
            front = reached
            if not front:  # more moves would not lead farther
                return Found(None, poses.walls, poses.exact and number + 1 < moves)
        return Found(None, poses.walls, False)
