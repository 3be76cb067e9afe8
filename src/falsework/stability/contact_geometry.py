"""Geometry with which certificates are evaluated: motions at contact points, and wrenches of forces there."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import MassProperties

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]


class ContactGeometry(NamedTuple):
    """What certificates are evaluated with that depends on neither states nor loads nor friction."""

    motion: csr_array
    """Map of the motion of the parts, `(linear, angular)` one after another, to that of part `b` relative to `a` at
    every contact point in its frame, shape (3 points, 6 parts)."""
    wrench: csr_array
    """Its transpose: map of forces on part `b` to wrenches on the parts."""
    part_a: NDArray[np.int32]
    """Shape (points,)."""
    part_b: NDArray[np.int32]
    inverse_inertia: NDArray[np.floating]
    """Shape (parts, 3, 3), 1 / (kg m2)."""
    gyration: Array
    """Largest radius of gyration of each part, shape (parts,), m."""

    def relative(self, motion: Array) -> Array:
        """Return the motion of part `b` relative to `a` at every contact point in its frame, shape (batch, points, 3).

        Args:
            motion: `(linear, angular)` about the centres of mass, shape (batch, parts, 6).
        """
        batch = len(motion)
        return np.ascontiguousarray((self.motion @ motion.reshape(batch, -1).T).T).reshape(batch, -1, 3)

    def wrenches(self, forces: Array) -> Array:
        """Return the wrenches on the parts of forces at every contact point, shape (batch, parts, 6).

        Args:
            forces: `(n, t1, t2)` in N on part `b`, shape (batch, points, 3).
        """
        batch = len(forces)
        return np.ascontiguousarray((self.wrench @ forces.reshape(batch, -1).T).T).reshape(batch, -1, 6)

    def points_on(self, parts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the contact points of some parts, ascending."""
        some = np.zeros(len(self.gyration), dtype=bool)
        some[parts] = True
        return np.flatnonzero(some[self.part_a] | some[self.part_b])

    def wrenches_on(self, parts: NDArray[np.int64], forces: Array) -> Array:
        """Return the wrenches on some parts of forces at every contact point, shapes (some, 6) and (points, 3)."""
        # By hand: taking rows of a sparse array takes ten times as long as the product itself.
        rows = (6 * parts[:, None] + np.arange(6)).ravel()
        first, wrench = self.wrench.indptr, np.zeros(len(rows))
        count = first[rows + 1] - first[rows]
        begin = np.cumsum(count) - count
        at = np.arange(count.sum()) + np.repeat(first[rows] - begin, count)
        touched = count > 0
        if touched.any():
            products = self.wrench.data[at] * forces.ravel()[self.wrench.indices[at]]
            wrench[touched] = np.add.reduceat(products, begin[touched])
        return wrench.reshape(-1, 6)

    def relative_at(self, points: NDArray[np.int64], motion: Array) -> Array:
        """Return the motion of part `b` relative to `a` at some contact points in their frames, shape (batch, some, 3).

        Args:
            points: shape (some,).
            motion: as of `relative`.
        """
        values = self.motion.data.reshape(-1, 3, 12)[points]  # six of either part
        ends = np.concatenate([motion[:, self.part_a[points]], motion[:, self.part_b[points]]], axis=2)
        return np.asarray((values @ ends.transpose(1, 2, 0)).transpose(2, 0, 1))

    def present(self, states: States) -> NDArray[np.bool_]:
        """Return the contact points with both parts present, shape (..., points)."""
        return (states[..., self.part_a] > 0) & (states[..., self.part_b] > 0)

    def acts(self, states: States, points: NDArray[np.int64] | slice = slice(None)) -> NDArray[np.bool_]:
        """Return the contact points with both parts present and at least one that can move. Shape (batch, points)."""
        one, other = states[:, self.part_a[points]], states[:, self.part_b[points]]
        return (one > 0) & (other > 0) & ((one == 1) | (other == 1))


@lru_cache(maxsize=4)
def geometry_of(contacts: Contacts, mass: MassProperties) -> ContactGeometry:
    """Return the geometry of a structure, the same under all loads and friction."""
    from scipy.sparse import csr_array

    owner, parts = contacts.contact_of_point, len(mass.mass)
    part_a, part_b = contacts.parts[owner, 0], contacts.parts[owner, 1]
    axes = contacts.point_frames
    entries, columns = [], []
    for part, sign in ((part_a, -1.0), (part_b, 1.0)):
        arm = contacts.points - mass.center[part]
        # Velocity `v + w x arm` along an axis `e` is `e . v + (arm x e) . w`.
        turned = np.cross(arm[:, None, :], axes)
        entries.append(sign * np.concatenate([axes, turned], axis=2))
        columns.append(np.broadcast_to(6 * part[:, None, None] + np.arange(6), turned.shape[:2] + (6,)))
    count = 3 * len(contacts.points)
    row_start = 12 * np.arange(count + 1)
    motion = csr_array(
        (np.concatenate(entries, axis=2).ravel(), np.concatenate(columns, axis=2).ravel(), row_start),
        shape=(count, 6 * parts),
    )
    return ContactGeometry(motion, csr_array(motion.T), part_a, part_b, np.linalg.inv(mass.inertia), mass.gyration)
