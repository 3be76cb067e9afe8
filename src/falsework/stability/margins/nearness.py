"""Utilization of friction and contact areas at the parts of a state, from the contact forces of its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import INSTALLED, States
from falsework.stability.strength import strength_of

Array = NDArray[np.float64]


def nearness_to_limit(assembly: Assembly, state: States, forces: Array) -> Array:
    """Return how near each free part is to its limit, from 0 to 1; NaN for the others. Shape (parts,).

    Of every contact that presses two shares are taken: of the friction and cohesion that its resultant uses, and of the
    way from the middle of the contact to its edge at which the resultant acts. Of one that pulls it is that of its
    tension. A part has the larger of the two means over its contacts, weighted by their normal forces. Nothing is
    proven by it; margins are.

    Args:
        assembly: the structure.
        state: shape (parts,).
        forces: `(n, t1, t2)` in N, shape (points, 3).
    """
    contacts = assembly.contacts
    owner, count = contacts.contact_of_point, len(contacts)
    normal = np.bincount(owner, forces[:, 0], count)
    tangent = np.hypot(np.bincount(owner, forces[:, 1], count), np.bincount(owner, forces[:, 2], count))
    strength = strength_of(assembly)
    grip = np.bincount(owner, strength.friction * (forces[:, 0] + strength.pull) + strength.stick, count)
    bears = np.abs(normal) > 1e-9 * max(float(np.abs(normal).max(initial=0.0)), 1e-300)
    slip, tip = np.zeros(count), np.zeros(count)
    slip[bears] = np.minimum(tangent[bears] / np.maximum(grip[bears], 1e-300), 1.0)
    pulled = bears & (normal < 0)
    tip[pulled] = np.minimum(-normal / np.maximum(np.bincount(owner, strength.pull, count), 1e-300), 1.0)[pulled]
    for contact in np.flatnonzero(bears & ~pulled):
        rows = slice(contacts.start[contact], contacts.start[contact + 1])
        tip[contact] = _eccentricity(contacts.points[rows] @ contacts.frames[contact, 1:].T, forces[rows, 0])
    nearness = np.full(assembly.part_count, np.nan)
    for part in np.flatnonzero(state == INSTALLED):
        mine = bears & (contacts.parts == part).any(axis=1)
        if mine.any():
            nearness[part] = max(np.average(share[mine], weights=np.abs(normal[mine])) for share in (slip, tip))
    return nearness


def _eccentricity(points: Array, normal: Array) -> float:
    """Return the share of the way from the middle of a convex polygon to its edge at which its forces act in total."""
    middle = points.mean(axis=0)
    at = normal @ points / normal.sum() - middle
    around = points[np.argsort(np.arctan2(*(points - middle).T[::-1]))] - middle
    edges = np.roll(around, -1, axis=0) - around
    outwards = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    reach = (outwards * around).sum(axis=1)
    real = reach > 1e-12 * max(float(np.abs(reach).max(initial=0.0)), 1e-300)
    if not real.any():
        return 0.0
    return float(np.clip((outwards[real] @ at / reach[real]).max(), 0.0, 1.0))
