"""Triangle meshes of parts: load, repair, mass properties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Closed surface of one rigid part, in metres."""

    name: str
    vertices: NDArray[np.float64]
    """Shape (vertices, 3), metres, read-only."""
    faces: NDArray[np.int32]
    """Shape (faces, 3), counter-clockwise seen from outside, read-only."""


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass and where it sits, for all parts of a structure."""

    mass: NDArray[np.float64]
    """Shape (parts,), kg."""
    center: NDArray[np.float64]
    """Centres of mass, shape (parts, 3), metres."""
    inertia: NDArray[np.float64]
    """About the centre of mass in world axes, shape (parts, 3, 3), kg m2."""
    volume: NDArray[np.float64]
    """Shape (parts,), m3."""
