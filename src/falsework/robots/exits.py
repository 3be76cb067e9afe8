"""Ways out for robots: several a part, steep ones among them, where the clearance table keeps one that is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, States
from falsework.geometry.bits import unpack
from falsework.geometry.sweep import Sweeper

Array = NDArray[np.float64]

_TILTS = (15.0, 35.0, 60.0, 85.0)
"""Angles to the vertical of the ways that are tried besides straight up, degrees."""
_AROUND = 8
_DOWN = -1e-6


class Exits:
    """For every part a fan of directions, none downwards, and which parts block each.

    The clearance table answers whether a part can leave, for which one free way is as good as another. A robot has
    preferences: it cannot drag a part along the floor for long, nor pull where its arm does not reach.
    """

    def __init__(self, assembly: Assembly, turn: Array) -> None:
        """Nothing is swept yet.

        Args:
            assembly: the structure.
            turn: rotation from its frame to the world, shape (3, 3).
        """
        self._assembly, self._turn = assembly, turn
        self._table = assembly.clearance
        self._fan = _fan() @ turn  # into the frame of the structure
        self._sweeper: Sweeper | None = None
        self._known: dict[int, tuple[Array, NDArray[np.bool_]]] = {}

    def blockers(self, part: int) -> NDArray[np.bool_]:
        """Parts that block each way of a part, shape (ways, parts)."""
        return self._ways(part)[1]

    def free(self, part: int, state: States) -> Array:
        """Ways that nothing present blocks, in the world, steepest first, shape (n, 3)."""
        directions, blockers = self._ways(part)
        return directions[~(blockers & (state != REMOVED)).any(axis=1)]

    def _ways(self, part: int) -> tuple[Array, NDArray[np.bool_]]:
        if part not in self._known:
            if self._sweeper is None:
                _, overlap = self._assembly.contact_settings.lengths(self._assembly.meshes)
                self._sweeper = Sweeper(self._assembly.meshes, self._assembly.contacts, overlap)
            rows = slice(self._table.start[part], self._table.start[part + 1])
            known = unpack(self._table.blockers[rows])[:, : self._assembly.part_count].astype(bool)
            directions = np.concatenate([self._table.directions[rows], self._fan])
            blockers = np.concatenate([known, self._sweeper.blocked(part, self._fan)])
            world = directions @ self._turn.T
            rises = world[:, 2] > _DOWN
            world, blockers = world[rises], blockers[rises]
            order = np.argsort(-np.round(world[:, 2], 9), kind="stable")
            self._known[part] = (world[order], blockers[order])
        return self._known[part]


def _fan() -> Array:
    """Straight up, and rings of directions around it; unit vectors, shape (n, 3)."""
    found = [(0.0, 0.0, 1.0)]
    for tilt in np.radians(_TILTS):
        for turn in 2 * np.pi * np.arange(_AROUND) / _AROUND:
            found.append((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
    return np.array(found)
