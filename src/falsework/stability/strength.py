"""Strength of contact points: friction, tension and cohesion.

It belongs to the criterion, like stiffness: solvers, certificate checker and judges read it from here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.joints import Joints
from falsework.assembly.model import Assembly
from falsework.geometry.contact.contacts import Contacts
from falsework.stability.criterion import StabilityBounds

Array = NDArray[np.float64]

SMOOTH = 1e-3
"""Coefficient of friction below which cones are too narrow for forces to be kept inside them, and below which the
search for the least friction tries none: chosen, not measured."""
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
    idle: NDArray[np.bool_]
    """Whether no force but zero is admissible, since the surfaces are inclined by more than friction allows, shape
    (points,)."""

    def take(self, points: NDArray[np.bool_] | NDArray[np.integer]) -> Strength:
        """Return the strength of selected points."""
        friction, pull, stick, tears, idle = self
        return Strength(friction[points], pull[points], stick[points], tears[points], idle[points])

    def at(self, torn: NDArray[np.bool_], age: NDArray[np.int32], joints: Joints | None) -> Strength:
        """Return the strength where points have torn, or joints not yet set at their age in steps, shape (points,)."""
        if joints is None or not joints.setting:
            return self.reached(torn, np.zeros(0))
        return self.reached(torn, joints.set_share(age[None])[0])

    def reached(self, torn: NDArray[np.bool_], set_share: Array) -> Strength:
        """Return the strength where points have torn, or reached a share of theirs, shape (points,), or (0,) if all."""
        share = np.where(torn, 0.0, set_share if len(set_share) else 1.0)
        return self._replace(pull=share * self.pull, stick=share * self.stick)


def strength_of(assembly: Assembly, gravity: float = 9.81, reserve: float = 1.0) -> Strength:
    """Return the strength of the contact points of a structure, its friction divided by a reserve.

    Tension is limited by the apex of the cone, cohesion over friction. The tension of a contact point, and its
    tangential force by cohesion, are limited to the default force bound shared by all contact points: a strength beyond
    any load would only weaken the bounds of certificates.

    Where the surfaces at a point are inclined to its normal (`Contacts.lean`), a force has to be one that both of them
    bear, whichever is the true one: see `_within_both`.
    """
    count = len(assembly.contacts.points)
    friction = np.full(count, float(assembly.friction))
    if assembly.joints is None:
        none = np.zeros(count)
        return _within_both(Strength(friction / reserve, none, none, none == 0, none > 0), assembly.contacts)
    given = assembly.joints
    friction = np.where(np.isnan(given.friction), friction, given.friction)
    most = StabilityBounds.force_bound * gravity * assembly.mass.mass[~assembly.immovable].sum() / max(count, 1)
    end = np.divide(given.cohesion, friction, out=np.full(count, np.nan), where=friction > 0)
    pull = np.minimum(np.fmin(given.tension, end), most)
    stick = given.cohesion - friction * pull
    # Where cohesion is not given, or the cone ends at the tension up to rounding, there is no disc.
    stick = np.where(stick > 1e-9 * given.cohesion, np.minimum(stick, most), 0.0)
    whole = Strength(friction / reserve, pull, stick, ~given.ductile, np.zeros(count, bool))
    return _within_both(whole, assembly.contacts)


def _within_both(strength: Strength, contacts: Contacts) -> Strength:
    """Return the strength about normals to which the surfaces are inclined, admissible about theirs on either side.

    A cone about the normal lies in one about a normal inclined by `lean` if its angle is smaller by `lean`. Its apex
    and its disc, at the tensile strength, are drawn in by a common factor until the disc lies there as well. With less
    friction than the tangent of `lean` the cones of the two surfaces have nothing in common, and the point is idle;
    solvers know it as one without friction, and their proofs are checked without its forces.
    """
    if contacts.lean is None:
        return strength
    lean, mu = contacts.lean, strength.friction
    slope, idle = np.tan(lean), contacts.idle(mu)
    sine, cosine = np.sin(lean), np.cos(lean)
    friction = np.maximum((mu - slope) / (1 + mu * slope), 0.0)
    pull, stick = strength.pull, strength.stick
    # Extremes of the disc `n = -pull, |t| = stick` about the other normal: tension, and what cohesion has to hold.
    tension = pull * cosine + stick * sine
    shear = stick * (1 + mu * sine) + pull * (sine + mu * cosine)
    share = np.minimum(
        np.divide(pull, tension, out=np.ones_like(pull), where=tension > 0),
        np.divide(mu * pull + stick, shear, out=np.ones_like(pull), where=shear > 0),
    )
    share = np.where(idle, 0.0, np.where(lean > 0, np.minimum(share, 1.0), 1.0))
    return Strength(friction, share * pull, share * stick, strength.tears, idle)
