"""Poses of parts while they settle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh
from falsework.geometry.settling.settlement import Settlement

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Poses:
    """Poses of the parts that move, and the corners of their boxes, which bound the motion of all points."""

    def __init__(self, free: Index, center: Array, corners: Array) -> None:
        self.free, self.start, self._corners = free, center, corners
        self.center = center.copy()
        self.turn = Rotation.identity(len(center))
        self.last = np.zeros(len(center))

    @staticmethod
    def from_meshes(meshes: Sequence[TriangleMesh], fixed: NDArray[np.bool_], mass: MassProperties) -> Poses:
        """Take the poses of a model."""
        ends = np.array([[[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]], dtype=bool)
        bounds = np.array([mesh.bounds for mesh in meshes])
        return Poses(np.flatnonzero(~fixed), mass.center, np.where(ends, bounds[:, 1:], bounds[:, :1]))

    @property
    def arms(self) -> Array:
        """Corners of the boxes from the centres of mass, shape (parts, 8, 3), metres."""
        arms = self._corners - self.start[:, None]
        return np.einsum("pij,pkj->pki", self.turn.as_matrix(), arms)

    @property
    def strayed(self) -> Array:
        """Motion of the corners so far, shape (parts, 8, 3), metres."""
        return self.center[:, None] + self.arms - self._corners

    def move(self, motion: Array) -> float:
        """Apply translations and rotation vectors, shape (parts, 6), and return the largest motion of a corner."""
        before = self.center[:, None] + self.arms
        self.center = self.center + motion[:, :3]
        self.turn = Rotation.from_rotvec(motion[:, 3:]) * self.turn
        self.last = np.linalg.norm(self.center[:, None] + self.arms - before, axis=2).max(axis=1)
        return float(self.last.max(initial=0.0))

    def meshes(self, meshes: Sequence[TriangleMesh]) -> tuple[TriangleMesh, ...]:
        """Return the parts in their present poses."""
        moved, turn = list(meshes), self.turn.as_matrix()
        for part in self.free.tolist():
            points = (meshes[part].vertices - self.start[part]) @ turn[part].T + self.center[part]
            moved[part] = TriangleMesh.from_arrays(meshes[part].name, points, meshes[part].faces)
        return tuple(moved)

    def settlement(self, bound: float, steps: int, least: float) -> Settlement:
        """Return the motion from the start; of parts that moved by less than `least`, none."""
        motion = np.linalg.norm(self.strayed, axis=2).max(axis=1)
        motion[motion < least] = 0.0
        still = motion[:, None] > 0
        translation, rotation = self.center - self.start, self.turn.as_rotvec()
        return Settlement(bound, np.where(still, translation, 0.0), np.where(still, rotation, 0.0), motion, steps)
