"""Clearance of parts that leave in several moves, where they have no straight way out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.clearance.first_motions import can_begin_to_move
from falsework.geometry.clearance.motions import PartMotions
from falsework.geometry.clearance.moves import Way
from falsework.geometry.clearance.table import ClearanceTable
from falsework.geometry.clearance.way_search import WaySearch
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.bits import Words, pack

Mask = NDArray[np.bool_]

MOST = 100
"""Moves of a way out at most."""


class WaysOut:
    """Ways out of single parts in up to some number of moves; each is searched for when first asked for, and kept.

    A part that has a straight way out takes that (`ClearanceTable`). Ways are kept with what blocks them, and searches
    without a result with parts that suffice for that: past these and more there is no way either.
    """

    def __init__(
        self,
        meshes: Sequence[TriangleMesh],
        contacts: Contacts,
        straight: ClearanceTable,
        motions: PartMotions,
        immovable: Mask,
        moves: int,
    ) -> None:
        """Take a structure.

        Args:
            meshes: closed meshes that face outwards.
            contacts: their contacts.
            straight: clearance of parts that leave in straight lines.
            motions: swept tests of the parts.
            immovable: parts that never leave, shape (parts,).
            moves: moves of a way out at most.

        Raises:
            InputError: fewer than two moves, or more than a hundred.
        """
        if not (isinstance(moves, int | np.integer) and 1 < moves <= MOST):
            raise InputError(f"{moves} is not a number of moves of a way out; give 1 (straight ways only) to {MOST}")
        self._meshes, self._contacts, self._straight, self._motions = meshes, contacts, straight, motions
        self._immovable, self.moves = immovable, int(moves)
        self._ways: dict[int, list[tuple[Way, Words]]] = {}
        self._closed: dict[int, list[tuple[Words, bool]]] = {}

    def __reduce__(self) -> tuple[type[WaysOut], tuple[Any, ...]]:
        """Pickle what it is made of; what was found is found again."""
        given = self._meshes, self._contacts, self._straight, self._motions, self._immovable, self.moves
        return WaysOut, given

    def can_leave(self, states: NDArray[np.uint8]) -> Mask:
        """Return whether each part has a way out past the parts that are present; as `ClearanceTable.can_leave`."""
        found = self._straight.can_leave(states)
        for row, part in np.argwhere(~found & ~self._immovable).tolist():
            found[row, part] = self._search(part, states[row] > 0) is not None
        return found

    def way_out(self, state: NDArray[np.uint8], part: int) -> Way | None:
        """Return the moves in which a part leaves a state, shape (parts,); none of them where it leaves straight.

        Returns:
            None if no way was found.
        """
        if self._straight.can_leave(np.asarray(state)[None])[0, part]:
            return ()
        return self._search(part, np.asarray(state) > 0)

    def doubt(self, parts: Mask) -> str:
        """Explain why some of the parts, shape (parts,), may have ways that were not found; empty if none can."""
        unsure = [
            part for part in np.flatnonzero(parts).tolist() if not all(exact for _, exact in self._closed.get(part, ()))
        ]
        if not unsure:
            return ""
        return (
            f"for {len(unsure)} parts, {self._meshes[unsure[0]].name} the first, ways out of up to {self.moves} straight "
            "moves were sought along the faces and edges of parts, and none was found; others may be free"
        )

    def _search(self, part: int, present: Mask) -> Way | None:
        others = present.copy()
        others[part] = False
        words = pack(others[None])[0]
        for way, blockers in self._ways.get(part, ()):
            if not (blockers & words).any():
                return way
        for closed, _ in self._closed.get(part, ()):
            if not (closed & ~words).any():
                return None
        if not can_begin_to_move(self._contacts, (part,), others | (np.arange(len(others)) == part)):
            touching = others & self._touched(part)
            self._closed.setdefault(part, []).append((pack(touching[None])[0], True))
            return None
        found = WaySearch(self._motions, part, others).run(self.moves)
        if found.way is None:
            self._closed.setdefault(part, []).append((pack(found.walls[None])[0], found.exact))
            return None
        self._ways.setdefault(part, []).append((found.way, pack(self._blockers(found.way, part)[None])[0]))
        return found.way

    def _touched(self, part: int) -> Mask:
        """Return the parts that touch a part, shape (parts,)."""
        pairs, found = self._contacts.parts, np.zeros(len(self._meshes), dtype=bool)
        found[pairs[(pairs == part).any(axis=1)]] = True
        return found

    def _blockers(self, way: Way, part: int) -> Mask:
        """Return the parts that would block a way, shape (parts,)."""
        found, pose = np.zeros(len(self._meshes), dtype=bool), np.eye(4)
        others = np.arange(len(found)) != part
        for move in way:
            found |= self._motions.blockers(move, others, {part: pose})
            pose = move.displacement() @ pose
        return found
