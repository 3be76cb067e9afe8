"""Departure: which parts are to leave, which may move aside for them, and which rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import ExitPath

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Parts = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Departure:
    """Parts that are to leave as one body, past others."""

    leaving: Parts
    """The parts that leave."""
    movable: Parts
    """These first, and others that may move aside."""
    rest: Mask
    """Parts that are there and do not move, shape (parts,)."""
    around: Array
    """Box around all parts in place, there or not, shape (2, 3), metres."""
    beside: Array
    """The same without those that leave."""
    carried: Callable[[Parts], bool] | None
    """Whether robots can carry some parts as one body; None: any."""
    stands: Callable[[ExitPath, bool], bool] | None
    """Whether everything stands along a way, and, if the parts are out, until others are back; None: it does."""
    most: float = np.inf
    """Poses after which no more moves are tried."""

    def leaves(self, parts: Parts) -> bool:
        """Return whether parts that move are those that leave."""
        return set(parts) == set(self.leaving)

    def can_carry(self, parts: Parts) -> bool:
        """Return whether robots can carry some parts as one body."""
        return self.carried is None or self.carried(parts)

    def allows(self, way: ExitPath, *, out: bool) -> bool:
        """Return whether everything stands along a way, and, if the parts are out, until others are back in place."""
        return self.stands is None or self.stands(way, out)
