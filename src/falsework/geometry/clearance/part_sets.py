"""Clearance of several parts at once: sets of parts that lock each other, and the ways on which they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.directions import exit_directions
from falsework.geometry.clearance.exhaustive_directions import all_exits
from falsework.geometry.clearance.locked import LockedSets, PartSet
from falsework.geometry.clearance.relative_motions import RelativeMotions, can_begin_to_move
from falsework.geometry.clearance.sweep import Sweeper
from falsework.geometry.clearance.table import StraightWays
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.bits import Words, pack

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_DIRECTIONS = 1000
"""Directions sampled for each set before the proof that no other is better."""


@dataclass(frozen=True, eq=False)
class _SetExits:
    """Exit directions of a set, with what blocks them."""

    directions: Array
    """Unit vectors, shape (exits, 3)."""
    blockers: Words
    """Parts that block each, shape (exits, words)."""
    exact: bool
    """Whether every direction was proved to be no better than one of them."""
    smaller: Words
    """Blockers of the exits of fewer of these parts, past the others of them, shape (exits, words)."""
    own: Words
    """The parts of the set, shape (words,)."""


class SetClearance:
    """Ways out of sets of parts; computed when first asked for, and kept.

    A set *leaves together* from a state if a straight way out is free, and no fewer of its parts have one past the
    rest. So a set moves only where its parts lock each other, and every structure that comes apart by straight moves of
    up to so many parts at once comes apart by sets that leave together. The parts move as one body, or where each is
    held, along different directions, each in a straight line.
    """

    def __init__(
        self, meshes: Sequence[TriangleMesh], contacts: Contacts, singles: StraightWays, tolerance: float
    ) -> None:
        """Take a structure.

        Args:
            meshes: closed meshes that face outwards.
            singles: clearance of single parts.
            tolerance: overlap of touching parts that modelling may leave, metres.
        """
        self._meshes, self._contacts, self.singles, self._tolerance = meshes, contacts, singles, tolerance
        self._sets: dict[tuple[int, bytes], tuple[PartSet, ...]] = {}
        self._exits: dict[PartSet, _SetExits] = {}

    def __reduce__(self) -> tuple[type[SetClearance], tuple[Any, ...]]:
        """Pickle what it is made of; what was found is found again."""
        return SetClearance, (self._meshes, self._contacts, self.singles, self._tolerance)

    def sets(self, movable: Mask, largest: int) -> tuple[PartSet, ...]:
        """Return the sets of two parts and more that may leave together from some state.

        Args:
            movable: parts that can be among them, shape (parts,).
            largest: parts of a set at most.

        Raises:
            InputError: so many sets that they cannot be examined.
        """
        key = largest, movable.tobytes()
        if key not in self._sets:
            self._sets[key] = self._planes.find(np.flatnonzero(movable), largest)
        return self._sets[key]

    def leave_together(self, parts: PartSet, states: NDArray[np.uint8], *, apart: bool = False) -> Mask:
        """Return whether a set leaves together from states.

        Args:
            parts: the set; its parts may be absent from the states.
            states: shape (batch, parts).
            apart: whether its parts may also move along different directions.

        Returns:
            Shape (batch,).
        """
        if parts not in self._exits and not self._planes.may_lock(parts):
            return np.zeros(len(states), dtype=bool)
        exits = self._exits_of(parts)
        present = pack(states > 0) & ~exits.own
        fewer = _any_free(exits.smaller, present)
        leaves = _any_free(exits.blockers, present) & ~fewer
        # Each of its parts must have a way out past all but the set.
        alone = np.all([_any_free(self._blockers(part), present) for part in parts], axis=0)
        for row in np.flatnonzero(alone & ~leaves & ~fewer) if apart else ():
            there = states[row] > 0
            there[list(parts)] = True
            smaller = any(self.apart.motion(some, there) is not None for some in self._fewer(parts))
            leaves[row] = not smaller and self.apart.motion(parts, there) is not None
        return leaves

    def exit_motion(self, parts: PartSet, state: NDArray[np.uint8]) -> Array | None:
        """Return the first of `exit_motions`; None without one."""
        return next(iter(self.exit_motions(parts, state)), None)

    def exit_motions(self, parts: PartSet, state: NDArray[np.uint8]) -> list[Array]:
        """Return velocities at which the parts of a set leave a state, shape (parts,); none if it cannot.

        Returns:
            Each of shape (parts of the set, 3), the fastest at 1: one direction for all, or where none is free, one for
            each.
        """
        exits = self._exits_of(parts)
        present = pack(np.asarray(state)[None] > 0) & ~exits.own
        free = np.flatnonzero(~(exits.blockers & present).any(axis=1))
        if len(free):
            return [np.repeat(exits.directions[row : row + 1], len(parts), axis=0) for row in free.tolist()]
        motion = self.apart.motion(parts, np.asarray(state) > 0)
        return [] if motion is None else [motion.velocities.copy()]

    def can_begin_to_move(self, parts: PartSet, state: NDArray[np.uint8]) -> bool:
        """Return whether all of some parts can begin to move in a state, shape (parts,)."""
        return can_begin_to_move(self._contacts, parts, np.asarray(state) > 0)

    def caveat(self, sets: Sequence[PartSet]) -> str:
        """Explain why some sets that were asked about may have unlisted exits; empty if all are exact."""
        unsure = [parts for parts in sets if parts in self._exits and not self._exits[parts].exact]
        diverging = [parts for parts in sets if parts in self.apart.unsure]
        if diverging and not unsure:
            names = " and ".join(self._meshes[part].name for part in diverging[0])
            return (
                f"{len(diverging)} sets of parts, {names} the first, can begin to move along different directions, and "
                "no free way was found along those tried; others may be free"
            )
        if not unsure:
            return ""
        names = " and ".join(self._meshes[part].name for part in unsure[0])
        return (
            f"for {len(unsure)} sets of parts, {names} the first, ways out were sought along {_DIRECTIONS} directions, "
            "and none was found that other parts do not block; another direction may be free"
        )

    @cached_property
    def _sweeper(self) -> Sweeper:
        return Sweeper(self._meshes, self._contacts, self._tolerance)

    @cached_property
    def apart(self) -> RelativeMotions:
        """Motions of two sets along different directions."""
        return RelativeMotions(self._contacts, self._sweeper, len(self._meshes))

    def _blockers(self, part: int) -> Words:
        """Return what blocks each way of a part alone, shape (exits, words)."""
        table = self.singles.table
        return table.blockers[table.start[part] : table.start[part + 1]]

    def _fewer(self, parts: PartSet) -> list[PartSet]:
        """Return the sets of two and more, but not all, of some parts that may leave together."""
        some = (few for count in range(2, len(parts)) for few in combinations(parts, count))
        return [few for few in some if self._planes.may_lock(few)]

    @cached_property
    def _planes(self) -> LockedSets:
        normals = LockedSets.directions(self._contacts.normals)
        return LockedSets(*self._sweeper.spans(normals), normals)

    def _exits_of(self, parts: PartSet) -> _SetExits:
        if parts in self._exits:
            return self._exits[parts]
        flags = np.zeros((1, len(self._meshes)), dtype=bool)
        flags[0, list(parts)] = True
        own = pack(flags)[0]
        sweeper = self._sweeper
        sampled = sweeper.least_blocked(parts, exit_directions(self._contacts, parts, _DIRECTIONS))
        found, exact = all_exits(sweeper, parts, sampled)
        smaller = [self._blockers(part) for part in parts]
        smaller += [self._exits_of(some).blockers for some in self._fewer(parts)]
        rows = np.concatenate(smaller)
        past = rows[~(rows & own).any(axis=1)]
        self._exits[parts] = _SetExits(found.directions, pack(found.blockers), exact, past, own)
        return self._exits[parts]


def _any_free(blockers: Words, present: Words) -> Mask:
    """Return whether a way is blocked by no present part, shape (batch,)."""
    blocked = np.any(blockers[None] & present[:, None], axis=2)
    return ~np.all(blocked, axis=1)
