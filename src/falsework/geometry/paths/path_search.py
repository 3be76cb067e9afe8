"""Search for a way out of some parts in several moves, in which others that robots hold may move aside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from falsework.geometry.clearance.moves import ExitPath
from falsework.geometry.paths.cells import CellLayers
from falsework.geometry.paths.departure import Departure, Mask, Parts
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.pose_layers import PoseLayers
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
    cut: bool = False
    """Without a way, whether the search ended where as many poses were tried as it may."""


class _Layers(Protocol):
    """Poses of one kind, by the fewest moves that lead there."""

    @property
    def walls(self) -> Mask: ...
    @property
    def exact(self) -> bool: ...
    def reaches(self, number: int, departure: Departure) -> bool | None: ...
    def ways(self, number: int, departure: Departure) -> Iterator[ExitPath]: ...


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
        carried: Callable[[Parts], bool] | None = None,
        stands: Callable[[ExitPath, bool], bool] | None = None,
        most: float = np.inf,
    ) -> None:
        """Take a structure.

        Args:
            motions: swept tests of its parts.
            leaving: the parts that leave, together if there are several; alone one may also turn.
            rest: parts that are there and do not move, shape (parts,).
            aside: parts that are there and may move aside.
            carried: whether robots can carry some parts as one body; without it they can.
            stands: whether everything stands along a way, and, if the parts are out, until others are back in place;
                without it everything does.
            most: whole cells are shifted no further from so many poses on.
        """
        self._motions = motions
        boxes = motions.bounds_without(()), motions.bounds_without(leaving)
        self._departure = Departure(leaving, (*leaving, *aside), rest, *boxes, carried, stands, most)

    def run(self, moves: int, *, turns: bool = False) -> Found:
        """Search for a way out in up to some number of moves.

        Args:
            moves: that number.
            turns: whether a part that leaves alone may also turn, and screw; others that move aside do not.
        """
        departure = self._departure
        grid = None if turns else self._motions.grid(departure.movable)
        if grid is not None and grid.compares(departure.movable, departure.rest):
            layers = CellLayers.of(grid, departure, self._motions.bounds_without)
            found = self._search(layers, moves)
            if found.way is not None or layers.fits:
                return found
        return self._search(PoseLayers(RigidPoses(self._motions, departure, turns=turns)), moves)

    def _search(self, layers: _Layers, moves: int) -> Found:
        departure = self._departure
        for number in range(moves):
            reaches = layers.reaches(number, departure)
            if not reaches:  # more moves do not lead farther, or are not tried
                return Found(None, layers.walls, layers.exact and reaches is not None, reaches is None)
            for way in layers.ways(number, departure):
                if departure.allows(way, out=True):
                    return Found(way, layers.walls, False)
        return Found(None, layers.walls, False)
