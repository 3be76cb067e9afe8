"""Strength of contact points: friction, tension and cohesion.

It belongs to the criterion, like stiffness: solvers, certificate checker and judges read it from here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

FORCE_BOUND = 1e3
"""Default bound on the sum of all normal forces, in weights of the structure (the paper bounds forces too)."""
TEARS = 1.0 + 1e-6
"""A contact point breaks at this multiple of its tensile strength; the excess over 1 covers rounding of the solvers."""


class Strength(NamedTuple):
    """Admissible forces `(n, t)` of contact points: `n >= -pull` and `|t| <= friction (n + pull) + stick`.

    This is the Mohr-Coulomb cone with cohesion `c = friction pull + stick` and a tension cut-off at `pull`: the
    friction cone with its apex moved to `n = -pull`, widened by a disc of radius `stick`. A dry contact has neither.
    """

    friction: Array
    """Coefficient of friction, shape (points,)."""
    pull: Array
    """Largest tension in N, shape (points,)."""
    stick: Array
    """Largest tangential force in N under that tension, shape (points,)."""
    tears: NDArray[np.bool_]
    """Whether the point breaks, and bears nothing at all, where the law of `contact` would exceed its tension, shape
    (points,); one that does not is ductile and keeps its tension."""

    def of(self, points: NDArray[np.bool_] | NDArray[np.integer]) -> Strength:
        """Return the strength of selected points."""
        return Strength(self.friction[points], self.pull[points], self.stick[points], self.tears[points])


def strength_of(assembly: Assembly, gravity: float = 9.81, reserve: float = 1.0) -> Strength:
    """Return the strength of the contact points of a structure, its friction divided by a reserve.

    Tension is limited by the apex of the cone, cohesion over friction. The tension of a contact point, and its
    tangential force by cohesion, are limited to `FORCE_BOUND` weights of the structure shared by all contact points: a
    strength beyond any load would only weaken the bounds of certificates.
    """
    count = len(assembly.contacts.points)
    friction = np.full(count, float(assembly.friction))
    if assembly.joints is None:
        return Strength(friction / reserve, np.zeros(count), np.zeros(count), np.ones(count, bool))
    given = assembly.joints
    friction = np.where(np.isnan(given.friction), friction, given.friction)
    most = FORCE_BOUND * gravity * assembly.mass.mass[~assembly.boundary].sum() / max(count, 1)
    end = np.divide(given.cohesion, friction, out=np.full(count, np.nan), where=friction > 0)
    pull = np.minimum(np.fmin(given.tension, end), most)
    stick = given.cohesion - friction * pull
    # Where cohesion is not given, or the cone ends at the tension up to rounding, there is no disc.
    stick = np.where(stick > 1e-9 * given.cohesion, np.minimum(stick, most), 0.0)
    return Strength(friction / reserve, pull, stick, ~given.ductile)
