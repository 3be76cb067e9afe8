"""Rule that several parts leave in one step, as tasks know it."""

from __future__ import annotations

from typing import Protocol

from falsework.assembly.state import Mask, States
from falsework.geometry.clearance.locked import PartSet
from falsework.search.problem.oracle import Oracle


class Together(Protocol):
    """Rule that up to some number of parts may be removed, or inserted, in one step."""

    largest: int
    """Parts of a step at most."""
    each_held: bool
    """Whether several robots may move a set, each with a part of its own."""
    by_one: bool
    """Whether one robot may carry a set."""

    @property
    def carried(self) -> Together:
        """The same rule for sets that one robot carries."""
        ...

    @property
    def held(self) -> Together:
        """The same rule for sets of which a robot of its own holds each part."""
        ...

    def sets(self, movable: Mask) -> tuple[PartSet, ...]:
        """Return the sets of two parts and more, among parts of shape (parts,), that may leave together somewhere."""
        ...

    def leave_together(self, parts: PartSet, states: States, *, apart: bool) -> Mask:
        """Return whether a set, present or not, leaves together from states, shape (batch,).

        Args:
            parts: the set.
            states: shape (batch, parts).
            apart: whether its parts may move along different directions.
        """
        ...

    def carriers(self, parts: PartSet, oracle: Oracle) -> tuple[int, ...]:
        """Return the parts by which one robot can carry a set."""
        ...

    def can_begin_to_move(self, parts: PartSet, state: States) -> bool:
        """Return whether all of some parts can begin to move in a state, by shifting and turning."""
        ...

    def name(self, parts: PartSet) -> str:
        """Return the names of some parts."""
        ...

    def caveat(self, sets: tuple[PartSet, ...]) -> str:
        """Explain why the absence of a plan would not be proven; empty if it would be."""
        ...
