"""Rule on several parts in one step: which sets leave together, and by which parts one robot can carry them."""

from __future__ import annotations

from copy import copy

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States
from falsework.errors import AssemblyError, InputError
from falsework.geometry.clearance.locked import LARGEST, PartSet
from falsework.search.problem.oracle import Oracle
from falsework.search.together.carried_group import holds_together
from falsework.stability.settings import StabilitySettings


class InterlockedSets:
    """Rule that parts of a structure leave together where they lock each other; see `SetClearance`."""

    def __init__(self, assembly: Assembly, largest: int) -> None:
        """Take a structure.

        Args:
            assembly: the structure.
            largest: parts of a step at most.

        Raises:
            InputError: fewer than two parts, or more than can move.
        """
        most = min(int((~assembly.immovable).sum()), LARGEST)
        if not (isinstance(largest, int | np.integer) and 1 < largest <= most):
            raise InputError(
                f"{largest} is not a number of parts of {assembly.name} that can move at once; give 1 (one at a time) "
                f"to {max(most, 1)}"
            )
        self.largest, self._assembly, self.each_held, self.by_one = int(largest), assembly, True, True
        self._carriers: dict[tuple[PartSet, StabilitySettings], tuple[int, ...]] = {}

    @property
    def carried(self) -> InterlockedSets:
        """The same rule for sets that one robot carries."""
        new = copy(self)
        new.each_held = False
        return new

    @property
    def held(self) -> InterlockedSets:
        """The same rule for sets of which a robot of its own holds each part."""
        new = copy(self)
        new.by_one = False
        return new

    def sets(self, movable: Mask) -> tuple[PartSet, ...]:
        """Return the sets of parts that may leave together from some state."""
        return self._assembly.clearance_of_sets.sets(movable, self.largest)

    def leave_together(self, parts: PartSet, states: States, *, apart: bool) -> Mask:
        """Return whether a set leaves together from states; see `SetClearance.leave_together`."""
        return self._assembly.clearance_of_sets.leave_together(parts, states, apart=apart)

    def carriers(self, parts: PartSet, oracle: Oracle) -> tuple[int, ...]:
        """Return the parts by which one robot can carry a set, under the settings of an oracle.

        None if no contacts connect the set, or the oracle has no settings.
        """
        settings = oracle.settings
        if settings is None or not self.by_one:
            return ()
        if (parts, settings) not in self._carriers:
            try:
                found = tuple(part for part in parts if holds_together(self._assembly, parts, part, settings))
            except AssemblyError:
                found = ()
            self._carriers[parts, settings] = found
        return self._carriers[parts, settings]

    def can_begin_to_move(self, parts: PartSet, state: States) -> bool:
        """Return whether all of some parts can begin to move in a state, by shifting and turning."""
        return self._assembly.clearance_of_sets.can_begin_to_move(parts, state)

    def name(self, parts: PartSet) -> str:
        """Return the names of some parts."""
        return " with ".join(self._assembly.names[part] for part in parts)

    def caveat(self, sets: tuple[PartSet, ...]) -> str:
        """Explain why the absence of a plan would not be proven; empty if it would be."""
        return self._assembly.clearance_of_sets.caveat(sets)
