"""Proof that a rest position is an unstable equilibrium, evaluated without any code of the solvers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.criterion import StabilityCriterion
from falsework.stability.second_order.springs import Springs, closing_points, springs_of_displacement
from falsework.stability.strength import strength_of

Array = NDArray[np.float64]

NEUTRAL = 1e-3
"""Growth of a motion, as `growth_of_motion` measures it, up to which an equilibrium counts as neutral, not unstable."""
_ALONG = 0.01
"""Largest deviation of the unbalanced forces from the direction of a motion that they make grow, as a share of them."""


def growth_of_motion(
    assembly: Assembly,
    states: States,
    displacement: Array,
    motion: Array,
    claim: StabilityCriterion,
    springs: Springs | None = None,
) -> Array:
    """Return how fast a small motion from rest grows: positive where it proves that the equilibrium is unstable.

    After the motion contact forces have changed, by the law of springs and friction and because their points, and
    without friction their normals too, turn with the parts (docs/decisions/contact-law.md). Where the unbalanced forces
    accelerate every part along the motion, it grows exponentially.

    Args:
        states: shape (batch, parts).
        displacement: of the parts at rest, shape (batch, parts, 6).
        motion: `(linear, angular)` about the centres of mass, of any size, shape (batch, parts, 6).
        claim: cone, gravity and stiffness ratio.
        springs: contact points of the states, where their history is known; `displacement` is not used then.

    Returns:
        Accelerations over those of parts that move along `motion` with gravity over their largest radius of gyration as
        acceleration, shape (batch,): 0.43 for a cube on its edge. Zero where they are not along the motion.
    """
    free = (states == 1)[:, :, None]
    if springs is None:
        springs = springs_of_displacement(assembly, states, np.where(free, displacement, 0.0), claim)
    motion = np.where(free, motion, 0.0)
    geometry, mass, contacts = geometry_of(assembly.contacts, assembly.mass), assembly.mass, assembly.contacts
    axes = contacts.point_frames
    relative = geometry.relative(motion)
    normal = np.where(springs.closed, relative[..., 0], 0.0)
    normal += np.where(closing_points(assembly, springs, motion, relative), relative[..., 0], 0.0)
    tangent = relative[..., 1:]
    along = (springs.pull * tangent).sum(axis=2, keepdims=True)
    friction = strength_of(assembly, claim.gravity, claim.reserve).friction[:, None]
    stuck = -springs.tangential[..., None] * tangent
    dragged = springs.across[..., None] * (stuck + (springs.tangential[..., None] * along) * springs.pull)
    dragged -= (springs.normal * normal)[..., None] * friction * springs.pull
    change = np.empty_like(relative)
    change[..., 0] = -springs.normal * normal
    change[..., 1:] = np.where(springs.closed[..., None], np.where(springs.slips & (along <= 0.0), dragged, stuck), 0.0)
    force, shift = np.einsum("bpi,pij->bpj", springs.forces, axes), np.einsum("bpi,pij->bpj", relative, axes)
    press = np.where(springs.closed & (friction[:, 0] == 0.0), springs.forces[..., 0], 0.0)[..., None] * axes[:, 0]
    turned, leaning = geometry.wrenches(change), []
    for part, sign in ((geometry.part_a, -1.0), (geometry.part_b, 1.0)):
        turn, arm = motion[:, part, 3:], contacts.points - mass.center[part]
        moment = sign * np.cross(np.cross(turn, arm), force)
        turned[..., 3:] += _sum_by_part(moment, part, states.shape[1])
        lean = np.einsum("bpj,pij->bpi", np.cross(turn, press), axes)
        leans = geometry.wrenches(lean)
        leans[..., 3:] -= _sum_by_part(np.cross(shift, press), part, states.shape[1])
        leaning.append(leans)
    growth = np.zeros(len(states))
    for leans in leaning:
        wrench = np.where(free, turned + leans, 0.0)
        own = np.concatenate(
            [mass.mass[:, None] * motion[..., :3], np.einsum("pij,bpj->bpi", mass.inertia, motion[..., 3:])], 2
        )
        own *= (claim.gravity / geometry.gyration)[:, None]
        size = (motion * own).sum(axis=(1, 2))
        found = np.divide((motion * wrench).sum(axis=(1, 2)), size, out=np.zeros_like(size), where=size > 0.0)
        left = wrench - found[:, None, None] * own
        lengths = np.repeat(np.stack([np.ones_like(geometry.gyration), geometry.gyration], axis=1), 3, axis=1)
        error, scale = np.abs(left / lengths).max(axis=(1, 2)), np.abs(own / lengths).max(axis=(1, 2))
        growth = np.maximum(growth, np.where(error <= _ALONG * found * scale, found, 0.0))
    return growth


def _sum_by_part(values: Array, part: NDArray[np.int32], parts: int) -> Array:
    """Return the sums over the contact points of each part, shapes (batch, points, 3) and (batch, parts, 3)."""
    total = np.zeros((len(values), parts, 3))
    for row, value in enumerate(values):
        np.add.at(total[row], part, value)
    return total
