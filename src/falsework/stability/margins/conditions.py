"""Conditions of stability, friction and additional loads, and answers under them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.loads import Loads
from falsework.stability.strength import strength_of

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]


class OutOfTime(Exception):
    """End of the time for a search: it returns the bracket that it has."""


@dataclass(frozen=True, eq=False)
class Condition:
    """Friction, and wrenches on the parts in addition to the loads of the structure."""

    friction: float
    """Coefficient of friction of the structure; those of joints change in proportion."""
    extra: Array
    """N and Nm about the centres of mass, shape (parts, 6)."""

    def at_friction(self, friction: float) -> Condition:
        """Return the condition with another coefficient of friction."""
        return replace(self, friction=friction)

    def applied_to(self, assembly: Assembly) -> Assembly:
        """Return the structure under this condition, in the form that the certificate checker takes."""
        own = assembly.loads or Loads.from_arrays(assembly.part_count)
        loads = Loads.from_arrays(assembly.part_count, wrench=own.wrench + self.extra, acceleration=own.acceleration)
        return replace(assembly.at_friction(self.friction), loads=loads)


@dataclass(frozen=True, eq=False)
class Answer:
    """Stability of a state under a condition, with its proof."""

    condition: Condition
    stands: bool
    moves_away: bool = False
    """Whether parts were seen to move away, under `contact`."""
    coarse: bool = False
    """Whether loading from rest was skipped: if the state is not stable, there may still be a rest position."""
    forces: Array | None = None
    """Contact forces in N, shape (points, 3), under `equilibrium`."""
    displacement: Array | None = None
    """Shape (parts, 6), m and rad, under `contact`."""
    velocity: Array | None = None
    """Proof that the state is unstable, shape (parts, 6)."""
    reached: Array | None = None
    """Displacement at which iterations ended although parts neither rested nor moved away, shape (parts, 6)."""


def some_idle(assembly: Assembly, friction: float) -> bool:
    """Return whether contact points carry nothing with another friction, of which the kernels know nothing."""
    return bool(strength_of(assembly.at_friction(friction)).idle.any())
