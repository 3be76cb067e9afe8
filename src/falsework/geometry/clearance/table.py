"""Clearance table: exit directions of every part and the parts that block them, computed once per structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.clearance.directions import exit_directions
from falsework.geometry.clearance.exhaustive_directions import all_exits
from falsework.geometry.clearance.protocol import Clearance
from falsework.geometry.clearance.sweep import Exits, Sweeper
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.bits import pack
from falsework.utils.kernels import njit

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ClearanceTable(Clearance):
    """Exit directions of every part, each with the set of parts that block it.

    A direction whose blockers include all blockers of another direction of the same part is omitted, because
    whenever it is free the other is free too. The remaining few therefore answer whether a part can leave like all
    sampled directions, and for a part that is `exact` like all directions. Exact refers to the parts as modelled: a
    contact blocks every direction more than three degrees into it, and other parts block each other where they
    overlap by more than the tolerance.
    """

    directions: Array
    """Exit directions, unit vectors, shape (exits, 3)."""
    blockers: NDArray[np.uint64]
    """Parts that block each direction, one bit per part, lowest bit first, shape (exits, words)."""
    start: NDArray[np.int32]
    """Part `i` has the directions `start[i]:start[i + 1]`, shape (parts + 1,)."""
    exact: NDArray[np.bool_]
    """Parts for which every direction was proved to be no better than a listed one, shape (parts,)."""
    sampled: int
    """Directions that were tried for each of the other parts."""

    def can_leave(self, states: NDArray[np.uint8], wanted: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Return whether each part has a straight exit past the parts that are present.

        Args:
            states: 0 removed, 1 installed, 2 held, shape (batch, parts).
            wanted: parts that are asked for; all are answered.

        Returns:
            Shape (batch, parts); whether the part itself is present does not matter.

        Raises:
            InputError: states of another number of parts.
        """
        return self._first_exits(states) >= 0

    def exit_direction(self, state: NDArray[np.uint8], part: int) -> Array | None:
        """Return a unit vector along which the part leaves in a straight line, or None. `state` has shape (parts,)."""
        row_of_exit = self._first_exits(np.asarray(state)[None])[0, part]
        return None if row_of_exit < 0 else self.directions[row_of_exit].copy()

    def caveat(self, parts: NDArray[np.bool_]) -> str:
        """Explain why some of the parts, shape (parts,), may have unlisted exit directions; empty if all are exact."""
        unsure = np.flatnonzero(parts & ~self.exact)
        if not len(unsure):
            return ""
        return (
            f"for {len(unsure)} parts, {unsure[0]} the first, ways out were sought along {self.sampled} directions, "
            "and none was found that other parts do not block; another direction may be free"
        )

    def _first_exits(self, states: NDArray[np.uint8]) -> NDArray[np.int32]:
        parts = len(self.start) - 1
        if states.ndim != 2 or states.shape[1] != parts:
            raise InputError(f"states have shape {states.shape}; expected (batch, {parts}), one value a part")
        found = np.empty(states.shape, dtype=np.int32)
        _first_exits(pack(states > 0), self.blockers, self.start, found)
        return found


class StraightWays(Clearance):
    """Straight ways out by a clearance table, which is computed when it is needed first, in seconds to minutes.

    After an interruption it is continued with the part at which it ended.
    """

    def __init__(
        self, meshes: Sequence[TriangleMesh], contacts: Contacts, directions: int = 1000, *, tolerance: float
    ) -> None:
        """Take a structure.

        Args:
            meshes: closed meshes that face outwards.
            contacts: their contacts; a contact blocks all directions into it, without a sweep.
            directions: number of directions to sample for each part before the proof.
            tolerance: overlap of touching parts that modelling may leave, metres.

        Raises:
            InputError: fewer than one direction.
        """
        if directions < 1:
            raise InputError(f"{directions} directions lead nowhere; give at least 1")
        self._meshes, self._contacts, self._sampled, self._tolerance = meshes, contacts, directions, tolerance
        self._found: list[tuple[Exits, bool]] = []

    @cached_property
    def table(self) -> ClearanceTable:
        """The table: every part is swept along straight lines to infinity, and the parts that block it are recorded.

        The first directions are those of `exit_directions`. More follow until all others are proved to be no
        better than a known one (`all_exits`); a part for which that fails is not `exact`. For the sweep of a pair,
        parts are shrunk by a little more than the tolerance, so that touching parts can slide along each other.
        """
        sweeper = Sweeper(self._meshes, self._contacts, self._tolerance)
        for part in range(len(self._found), len(self._meshes)):
            sampled = sweeper.least_blocked(part, exit_directions(self._contacts, part, self._sampled))
            self._found.append(all_exits(sweeper, part, sampled))
        exits = [found for found, _ in self._found]
        arrays = (
            np.concatenate([found.directions for found in exits]),
            np.concatenate([pack(found.blockers) for found in exits]),
            np.concatenate([[0], np.cumsum([len(found.directions) for found in exits])]).astype(np.int32),
            np.array([exact for _, exact in self._found]),
        )
        for array in arrays:
            array.setflags(write=False)
        return ClearanceTable(*arrays, sampled=self._sampled)

    def prepare(self) -> None:
        """See `Clearance.prepare`."""
        _ = self.table

    def can_leave(self, states: NDArray[np.uint8], wanted: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """See `ClearanceTable.can_leave`."""
        return self.table.can_leave(states, wanted)

    def caveat(self, parts: NDArray[np.bool_]) -> str:
        """See `ClearanceTable.caveat`."""
        return self.table.caveat(parts)


@njit(cache=True)
def _first_exits(
    present: NDArray[np.uint64], blockers: NDArray[np.uint64], start: NDArray[np.int32], found: NDArray[np.int32]
) -> None:  # pragma: no cover - compiled
    """Write the first way of each part that no present part blocks, or -1, to `found`, shape (batch, parts)."""
    batch, words = present.shape
    parts = len(start) - 1
    for row in range(batch):
        for part in range(parts):
            found[row, part] = -1
            for row_of_exit in range(start[part], start[part + 1]):
                free = True
                for word in range(words):
                    if blockers[row_of_exit, word] & present[row, word]:
                        free = False
                        break
                if free:
                    found[row, part] = row_of_exit
                    break
