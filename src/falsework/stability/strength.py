"""Strength of contact points: friction, tension and cohesion.

Part of the criterion, as stiffness is: solvers, certificate checker and judges read it from here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

FORCE_BOUND = 1e3
"""Default bound on the sum of all normal forces, in weights of the structure (the paper bounds forces too)."""


class Strength(NamedTuple):
    """Forces `(n, t)` that contact points bear: `n >= -pull` and `|t| <= friction (n + pull) + stick`.

    That is the cone of Mohr and Coulomb with cohesion `c = friction pull + stick`, cut off at the tension `pull`. It is
    the friction cone with its tip moved to `n = -pull`, widened by a disc of radius `stick`. A dry contact has neither.
    """

    friction: Array
    """Coefficient of friction, shape (points,)."""
    pull: Array
    """Largest tension in N, shape (points,)."""
    stick: Array
    """Largest tangential force in N under that tension, shape (points,)."""
    tears: NDArray[np.bool_]
    """Whether the point bears nothing at all where the law of `contact` would have it bear more tension, shape
    (points,); one that does not tear bears its tension on."""

    def of(self, points: NDArray[np.bool_]) -> Strength:
        """Return the strength of some of the points."""
        return Strength(self.friction[points], self.pull[points], self.stick[points], self.tears[points])


def strength_of(assembly: Assembly, gravity: float = 9.81) -> Strength:
    """Return what the contact points of a structure bear.

    Tension ends where the cone does, at cohesion over friction. A contact point bears no more tension, and by cohesion
    no more tangential force, than `FORCE_BOUND` weights of the structure divided among all contact points: what is
    stronger than any load would only spoil the bounds of certificates.
    """
    count = len(assembly.contacts.points)
    friction = np.full(count, float(assembly.friction))
    if assembly.joints is None:
        return Strength(friction, np.zeros(count), np.zeros(count), np.ones(count, bool))
    given = assembly.joints
    friction = np.where(np.isnan(given.friction), friction, given.friction)
    most = FORCE_BOUND * gravity * assembly.mass.mass[~assembly.boundary].sum() / max(count, 1)
    end = np.divide(given.cohesion, friction, out=np.full(count, np.nan), where=friction > 0)
    pull = np.minimum(np.fmin(given.tension, end), most)
    stick = given.cohesion - friction * pull
    # Where cohesion is not given, or the cone ends at the tension but for rounding, there is no disc.
    stick = np.where(stick > 1e-9 * given.cohesion, np.minimum(stick, most), 0.0)
    return Strength(friction, pull, stick, ~given.ductile)
