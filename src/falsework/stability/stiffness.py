"""Contact stiffness of a structure, and the displacement limit of a stable structure.

Both belong to the criterion, like friction: solvers, certificate checker and independent judges read them from here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly

TANGENTIAL_RATIO = 0.7
"""Ratio of tangential to normal stiffness (Mindlin 1949: 0.67 to 1 for elastic bodies, by Poisson's ratio)."""
SETTLEMENT = 1e-6
"""Share of its height by which a prismatic block settles into the joint below it under its own weight. For concrete
this is a joint stiffness of 24 GPa/m."""
MOVEMENT = 1e-3
"""Largest movement of a part of a stable structure (`movement_of`), as a share of the structure's diagonal ..."""
SETTLEMENTS = 100.0
"""... or, where that is more, as a multiple of the largest compression of a contact point. What small bearings settle
is no sign of collapse. Displacements are inversely proportional to stiffness; this ratio does not depend on it."""
LEAST_AREA = 1e-3
"""Least tributary area of a contact point, as a share of the mean."""


def normal_stiffness(assembly: Assembly, gravity: float = 9.81) -> NDArray[np.float64]:
    """Return the normal stiffness of every contact point in N/m, shape (points,).

    It is the tributary area of the point times a stiffness per area: the mean specific weight of the parts over
    `SETTLEMENT`. So it does not change when parts are subdivided, and it scales displacements but not forces.
    """
    contacts = assembly.contacts
    count = np.diff(contacts.start)
    area = (contacts.areas / np.maximum(count, 1))[contacts.contact_of_point]
    if not len(area):
        return area
    area = np.maximum(area, LEAST_AREA * (area.mean() if area.any() else 1.0))
    immovable = assembly.immovable
    movable = ~immovable if not immovable.all() else immovable
    mass, density = assembly.mass.mass[movable], assembly.density[movable]
    return area * (gravity * mass.sum() / (mass / density).sum() / SETTLEMENT)


def spring_stiffness(assembly: Assembly, gravity: float, ratio: float) -> NDArray[np.float64]:
    """Return the stiffness of every contact point along `(n, t1, t2)` in N/m, shape (points, 3).

    Args:
        ratio: of tangential to normal stiffness.
    """
    normal = normal_stiffness(assembly, gravity)
    return np.stack([normal, ratio * normal, ratio * normal], axis=1)


def movement_limit(size: float, compression: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest movement of a part of stable states, m, shape (states,).

    Args:
        size: diagonal of the structure, m.
        compression: largest compression of a contact point in each state, m, shape (states,).
    """
    return np.maximum(MOVEMENT * size, SETTLEMENTS * compression)


def reach_of(assembly: Assembly) -> NDArray[np.float64]:
    """Return how far the farthest corner of each part is from its centre of mass, m, shape (parts,)."""
    pairs = zip(assembly.meshes, assembly.mass.center, strict=True)
    return np.array([np.linalg.norm(mesh.vertices - center, axis=1).max() for mesh, center in pairs])


def movement_of(displacement: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the movement of parts, which `movement_limit` limits, m, shape (..., parts).

    It is the largest displacement of the centre along an axis, or of the farthest corner by the rotation about one,
    whichever is more. No point of the part is displaced by more than twice the square root of three times that.

    Args:
        displacement: `(translation, rotation)` about the centres of mass, m and rad, shape (..., parts, 6).
        reach: as `reach_of` returns it.
    """
    shift, turn = np.abs(displacement[..., :3]).max(axis=-1), np.abs(displacement[..., 3:]).max(axis=-1)
    return np.maximum(shift, reach * turn)


def structure_size(assembly: Assembly) -> float:
    """Return the diagonal of the bounding box of the parts that are not boundary, m."""
    meshes = [mesh for mesh, fixed in zip(assembly.meshes, assembly.immovable, strict=True) if not fixed]
    vertices = np.concatenate([mesh.vertices for mesh in meshes or assembly.meshes])
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))
