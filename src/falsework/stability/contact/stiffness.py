"""Contact stiffness of a structure, and how far a standing structure may move under it.

Both are part of the criterion, as friction is: solvers, certificate checker and judges read them from here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly

TANGENTIAL_RATIO = 0.7
"""Tangential over normal stiffness (Mindlin 1949: 0.67 to 1 for elastic bodies, by Poisson's ratio)."""
SETTLEMENT = 1e-6
"""Share of its size by which a typical part sinks into its joints under its own weight: 0.3 micrometres for a concrete
block of 0.3 m on a dry joint of some 20 GPa/m."""
MOVEMENT = 1e-3
"""Largest movement of a part of a standing structure, as a share of the structure's diagonal."""
_SUPPORTS = 8
"""Contact points that share the weight of a typical part."""
_LEAST_AREA = 1e-3
"""Least area that a contact point stands for, as a share of the mean."""


def normal_stiffness(assembly: Assembly, gravity: float = 9.81) -> NDArray[np.float64]:
    """Normal stiffness of every contact point in N/m, shape (points,).

    It is proportional to the area that the point stands for. The common scale follows from `SETTLEMENT`; it scales
    displacements and leaves forces as they are.
    """
    contacts = assembly.contacts
    count = np.diff(contacts.start)
    area = (contacts.areas / np.maximum(count, 1))[contacts.contact_of_point]
    if not len(area):
        return area
    mean = area.mean() if area.any() else 1.0
    area = np.maximum(area, _LEAST_AREA * mean)
    movable = ~assembly.boundary
    mass = assembly.mass.mass[movable].mean() if movable.any() else assembly.mass.mass.mean()
    return area / mean * (gravity * mass / _SUPPORTS) / (SETTLEMENT * part_size(assembly))


def part_size(assembly: Assembly) -> float:
    """Median over the parts of the longest side of the bounding box, m."""
    return float(np.median([np.ptp(mesh.vertices, axis=0).max() for mesh in assembly.meshes]))


def structure_size(assembly: Assembly) -> float:
    """Diagonal of the bounding box of the parts that are not boundary, m."""
    meshes = [mesh for mesh, fixed in zip(assembly.meshes, assembly.boundary, strict=True) if not fixed]
    vertices = np.concatenate([mesh.vertices for mesh in meshes or assembly.meshes])
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))
