"""Exit directions for robots: several per part, steep ones included, that the clearance table leaves free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, States
from falsework.geometry.clearance.sweep import Sweeper, includes_one
from falsework.geometry.clearance.table import ClearanceTable
from falsework.utils.arrays import Array
from falsework.utils.bits import pack, unpack

_TILT_DEGREES = (20.0, 50.0, 85.0)
"""Angles to the vertical of the directions that are tried besides straight up, degrees."""
_HEADINGS = 6
"""Headings of the tilted directions, evenly around the vertical."""
_LOWEST_SLOPE = -1e-6
"""Least upward component of a direction: level ones count in spite of rounding."""
_SAME_WAY = 1 - 1e-6
"""Cosine above which two directions count as the same."""


class ExitDirections:
    """Fan of exit directions for every part, none downwards, with the parts that block each.

    The clearance table decides whether a part can leave at all, for which any free direction will do. A robot has
    preferences: it cannot drag a part along the floor for long, nor pull beyond the reach of its arm.
    """

    def __init__(
        self,
        assembly: Assembly,
        turn: Array,
        present: NDArray[np.bool_] | None = None,
        leaving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Compute the blocking parts of every part and direction.

        Args:
            assembly: the structure.
            turn: rotation from its frame to the world, shape (3, 3).
            present, leaving: parts that are ever in place, and that ever leave, all by default: others need no fan.
        """
        known = assembly.clearance
        _, overlap = assembly.contact_settings.lengths(assembly.meshes)
        sweeper = Sweeper(assembly.meshes, assembly.contacts, overlap)
        fan = _fan() @ turn  # into the frame of the structure
        self._ways: list[tuple[Array, NDArray[np.bool_]]] = []
        exact = known.exact.copy()
        fanned = ~assembly.boundary
        for only in (present, leaving):
            fanned = fanned if only is None else fanned & only
        for part in range(assembly.part_count):
            rows = slice(known.start[part], known.start[part + 1])
            directions = known.directions[rows]
            blockers = unpack(known.blockers[rows])[:, : assembly.part_count].astype(bool)
            if fanned[part]:
                directions = np.concatenate([directions, fan])
                blockers = np.concatenate([blockers, sweeper.blocked(part, fan, present)])
            world = directions @ turn.T
            rises = world[:, 2] > _LOWEST_SLOPE
            # Downward directions are missed only where something that never leaves does not block them anyway.
            missed = blockers[~rises & ~blockers[:, assembly.boundary].any(axis=1)]
            world, blockers = world[rises], blockers[rises]
            exact[part] &= all(includes_one(row, blockers) for row in missed)
            order = np.argsort(-np.round(world[:, 2], 9), kind="stable")
            self._ways.append((world[order], blockers[order]))
        counts = [len(world) for world, _ in self._ways]
        self.table = ClearanceTable(
            np.concatenate([world for world, _ in self._ways]) @ turn,
            pack(np.concatenate([blockers for _, blockers in self._ways])),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
            exact,
            known.sampled,
        )
        """The same as a clearance table, for the rules of a task: a part that can only leave downwards cannot leave."""

    def blockers(self, part: int) -> NDArray[np.bool_]:
        """Return the parts that block each exit direction of a part, shape (directions, parts)."""
        return self._ways[part][1]

    def free(self, part: int, state: States) -> Array:
        """Return the exit directions that no present part blocks, in the world, steepest first, shape (n, 3)."""
        directions, blockers = self._ways[part]
        return directions[~(blockers & (state != REMOVED)).any(axis=1)]

    def allows(self, part: int, state: States, way: Array) -> bool:
        """Return whether a direction, a unit vector of shape (3,), is one in which no present part blocks a part."""
        free = self.free(part, state)
        return bool(len(free) and (free @ way).max() >= _SAME_WAY)


def _fan() -> Array:
    """Return straight up, and rings of directions around it; unit vectors, shape (n, 3)."""
    found = [(0.0, 0.0, 1.0)]
    for tilt in np.radians(_TILT_DEGREES):
        for turn in 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS:
            found.append((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
    return np.array(found)
