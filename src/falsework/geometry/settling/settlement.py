"""Motion of parts into their clearance: poses while they settle, and the report of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Settlement:
    """Motion of parts from the poses of a model to those in which contacts carry them."""

    bound: float
    """Largest motion that was allowed to any point of a part, metres."""
    translation: Array
    """Of the centres of mass, shape (parts, 3), metres."""
    rotation: Array
    """Rotation vectors about the centres of mass, shape (parts, 3), radians."""
    motion: Array
    """Largest motion of a corner of the box around each part, shape (parts,), metres."""
    steps: int
    """Steps until all parts were at rest."""

    @property
    def stopped(self) -> NDArray[np.bool_]:
        """Whether contacts stopped each part before the bound did, shape (parts,)."""
        return self.motion < 0.99 * self.bound

    def line(self, names: Sequence[str]) -> str:
        """Return one line on the parts that moved, and the one that moved farthest."""
        moved, most = int((self.motion > 0).sum()), int(self.motion.argmax())
        if not moved:
            return "every part was at rest: none settled"
        count = "1 part" if moved == 1 else f"{moved} parts"
        within = format_quantity(self.bound, "length")
        far = format_quantity(float(self.motion[most]), "length")
        return f"{count} settled into the clearance, within {within}; {names[most]} moved farthest, by {far}"

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return plain JSON values in SI units, an entry for each part that moved."""
        moved = np.flatnonzero(self.motion > 0).tolist()
        return {
            "bound_m": self.bound,
            "steps": self.steps,
            "parts": [
                {
                    "part": part,
                    "name": names[part],
                    "translation_m": self.translation[part].tolist(),
                    "rotation_rad": self.rotation[part].tolist(),
                    "motion_m": float(self.motion[part]),
                    "stopped": bool(self.stopped[part]),
                }
                for part in moved
            ],
        }


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
