"""The assembly: parts, contacts, boundary, density and friction, frozen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.contact import Contacts
from falsework.geometry.mesh import MassProperties, TriangleMesh


@dataclass(frozen=True, eq=False)
class Assembly:
    """Rigid parts and the contacts between them; everything that depends on the structure alone."""

    name: str
    meshes: tuple[TriangleMesh, ...]
    boundary: NDArray[np.bool_]
    """Shape (parts,): fixed for ever."""
    density: NDArray[np.float64]
    """Shape (parts,), kg/m3."""
    friction: float
    """Coefficient of friction of every contact."""
    contacts: Contacts
    mass: MassProperties

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.meshes)
