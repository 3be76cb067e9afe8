"""Clearance of parts, as tasks know it: which of them have a way out, and which."""

from __future__ import annotations

from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import ExitPath

Mask = NDArray[np.bool_]
States = NDArray[np.uint8]


class Clearance(Protocol):
    """Clearance of parts: which of them have a way out.

    A class that inherits from it has to define `can_leave` and `caveat` alone: by default ways are straight.
    """

    moves: int = 1
    """Moves of a way out at most; 1 for straight ways."""
    turns: bool = False
    """Whether a part that leaves may turn."""
    waiting: bool = False
    """Whether parts may wait half way out, standing without a robot."""

    def judged_by(self, oracle: Any, robots: int) -> Self:
        """Return the same clearance, where parts move aside only if an oracle says that the rest stands.

        Args:
            robots: parts that may be held, or carried, at a time.
        """
        return self

    def prepare(self) -> None:
        """Compute now what all answers need, if that takes long."""
        return

    most: float = np.inf
    """Poses that a search for a way in several moves tries."""

    @property
    def were_cut(self) -> bool:
        """Whether longer searches might lead to ways that were not found."""
        return False

    def within(self, poses: float) -> Self:
        """Return the same clearance, whose searches try so many poses each."""
        return self

    def can_leave(self, states: States, wanted: Mask | None = None) -> Mask:
        """Return whether each part has a way out that no other part of a state blocks, shape (batch, parts).

        Args:
            states: 0 removed, 1 installed, 2 held, shape (batch, parts); whether the part itself is there does not
                matter.
            wanted: parts that are asked for, all by default, shape (batch, parts); of others nothing is said.
        """
        ...

    def exit_path(self, state: States, leaving: tuple[int, ...]) -> ExitPath | None:
        """Return the moves in which parts leave a state together; None if they do not.

        Args:
            state: shape (parts,), with the parts in it.
            leaving: a part, for which there are no moves where it leaves straight; or several, each held by a robot
                or all carried by that of one, where they leave in several moves.
        """
        return () if len(leaving) == 1 and self.can_leave(np.asarray(state)[None])[0, leaving[0]] else None

    def caveat(self, parts: Mask) -> str:
        """Explain why some of the parts, shape (parts,), may have ways that were not found; empty if none can."""
        ...
