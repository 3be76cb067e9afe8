"""Places where a gripper can push on a part: faces, their inward normals, and the contacts that cover them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import INSTALLED, REMOVED, States
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.stability.margins.brackets import ACCURACY

Array = NDArray[np.float64]

_FLAT = np.cos(np.radians(15.0))
"""Cosine of the largest angle between the triangles of a face and its largest triangle."""
_COVERED = 0.5
"""Share of a face in contact above which a gripper has no room on it."""


@dataclass(frozen=True, eq=False)
class Pushes:
    """Unit forces on the faces of all parts that are not boundary, along their inward normals."""

    part: NDArray[np.int32]
    """Shape (pushes,)."""
    normal: Array
    """Direction of the force, into the part, shape (pushes, 3)."""
    point: Array
    """Point of application, the centre of the face, shape (pushes, 3), m."""
    wrench: Array
    """Force and moment about the centre of mass per newton, shape (pushes, 6)."""
    covered: Array
    """Share of the face that touches each other part, shape (pushes, parts)."""

    @classmethod
    def from_assembly(cls, assembly: Assembly) -> Pushes:
        """Collect the faces of a structure."""
        owner, normals, points, areas = [], [], [], []
        for part in np.flatnonzero(~assembly.boundary):
            for normal, point, area in _faces(assembly.meshes[part]):
                owner.append(int(part))
                normals.append(-normal)
                points.append(point)
                areas.append(area)
        part, normal, point = np.array(owner, np.int32), np.reshape(normals, (-1, 3)), np.reshape(points, (-1, 3))
        moment = np.cross(point - assembly.mass.center[part], normal)
        return cls(part, normal, point, np.hstack([normal, moment]), _cover(assembly, part, normal, np.array(areas)))

    def exposed(self, state: States) -> NDArray[np.intp]:
        """Return the pushes that are possible in a state: on installed parts, where no other part covers the face."""
        cover = self.covered @ (state != REMOVED)
        return np.flatnonzero((state[self.part] == INSTALLED) & (cover < _COVERED))

    def loads(self, rows: NDArray[np.intp], parts: int) -> Array:
        """Return the pushes as wrenches on all parts per newton, shape (rows, parts, 6)."""
        loads = np.zeros((len(rows), parts, 6))
        loads[np.arange(len(rows)), self.part[rows]] = self.wrench[rows]
        return loads


def _faces(mesh: TriangleMesh) -> list[tuple[Array, Array, float]]:
    """Return outward normal, centre and area of the faces of a part, largest first."""
    corners = mesh.triangles
    cross = triangle_normals(corners)
    twice = np.linalg.norm(cross, axis=1)
    normals, middles = cross / np.maximum(twice, 1e-300)[:, None], corners.mean(axis=1)
    left, found = twice > 0, []
    for seed in np.argsort(-twice, kind="stable"):
        if not left[seed]:
            continue
        members = left & (normals @ normals[seed] >= _FLAT)
        left &= ~members
        total = cross[members].sum(axis=0)
        middle = twice[members] @ middles[members] / twice[members].sum()
        found.append((total / np.linalg.norm(total), middle, float(np.linalg.norm(total)) / 2))
    found.sort(key=lambda face: -face[2])
    return [face for face in found if face[2] >= ACCURACY * found[0][2]]  # smaller faces are left out


def _cover(assembly: Assembly, part: NDArray[np.int32], inward: Array, areas: Array) -> Array:
    """Return the share of each face that touches each part, shape (faces, parts)."""
    contacts = assembly.contacts
    covered = np.zeros((len(part), assembly.part_count))
    for own, other, sign in ((0, 1, -1.0), (1, 0, 1.0)):
        # The normal of a contact points from part `a` to part `b`: outwards for the first, inwards for the second.
        for face in range(len(part)):
            touching = (contacts.parts[:, own] == part[face]) & (sign * contacts.normals @ inward[face] >= _FLAT)
            np.add.at(covered[face], contacts.parts[touching, other], contacts.areas[touching] / areas[face])
    return covered
