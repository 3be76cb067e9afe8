"""Utilisation of friction and contact area at the parts of a state, from the contact forces of its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import INSTALLED, States
from falsework.stability.strength import strength_of

Array = NDArray[np.float64]


def nearness_to_limit(assembly: Assembly, state: States, forces: Array) -> Array:
    """Return the utilisation of each free part, from 0 to 1; NaN for the others. Shape (parts,).

    A contact in compression has two ratios: tangential resultant over its limit by friction and cohesion, and
    eccentricity of the normal resultant over the distance from the centre of the contact to its edge. In tension,
    tension over tensile strength replaces the second. A part has the larger of both means over its contacts, weighted
    by normal forces. This is an indicator without proof; margins are proven.

    Args:
        state: shape (parts,).
        forces: `(n, t1, t2)` in N, shape (points, 3).
    """
    contacts = assembly.contacts
    owner, count = contacts.contact_of_point, len(contacts)
    normal = np.bincount(owner, forces[:, 0], count)
    rubs = np.einsum("pi,pij->pj", forces[:, 1:], contacts.point_frames[:, 1:])  # points may have frames of their own
    tangent = np.linalg.norm([np.bincount(owner, column, count) for column in rubs.T], axis=0)
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
    """Return the eccentricity of the normal resultant in a convex polygon, as a share of the distance to its edge."""
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
