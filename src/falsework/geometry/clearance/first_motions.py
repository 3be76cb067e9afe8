"""First motions: which parts can begin to move past others, by shifting and turning, however they go on.

What cannot begin to move has no way out of any shape. What can, may still have no straight one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.locked import PartSet
from falsework.geometry.clearance.relative_motions import feasible_velocities
from falsework.geometry.contact.interfaces import Contacts

Array = NDArray[np.float64]

_FASTER = 100.0
"""Largest ratio of the speed of another part to that of a part that counts as moving."""


def can_begin_to_move(contacts: Contacts, parts: PartSet, present: NDArray[np.bool_]) -> bool:
    """Return whether all parts of a set can begin to move at the same time while the others rest.

    To first order: no contact point is pushed into. Each part of the set moves on its own.

    Args:
        contacts: of the structure.
        parts: the set.
        present: parts that are there, shape (parts,).
    """
    pairs = contacts.parts[contacts.contact_of_point]
    rows = np.flatnonzero(np.isin(pairs, parts).any(axis=1) & present[pairs].all(axis=1))
    points, normals = contacts.points[rows], contacts.point_frames[rows, 0]
    # About the middle of the contacts, in multiples of their extent: shifts and turns then have like sizes.
    middle = points.mean(axis=0) if len(rows) else np.zeros(3)
    extent = max(float(np.abs(points - middle).max(initial=0.0)), 1e-12)
    twist = np.concatenate([normals, np.cross(points - middle, normals) / extent], axis=1)
    into = np.zeros((len(rows), len(parts), 6))
    for place, part in enumerate(parts):
        into[:, place] = np.where((pairs[rows, 0] == part)[:, None], twist, 0.0)
        into[:, place] -= np.where((pairs[rows, 1] == part)[:, None], twist, 0.0)
    flat, bounded = into.reshape(len(rows), 6 * len(parts)), np.eye(6 * len(parts)) / _FASTER
    return all(
        any(
            feasible_velocities(flat, 0.0, sign * axis, bounded) is not None
            for axis in np.eye(6 * len(parts))[6 * place : 6 * place + 6]
            for sign in (1.0, -1.0)
        )
        for place in range(len(parts))
    )
