"""Motion of parts into their clearance: poses while they settle, and the report of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.utils.quantity import counted, format_quantity

Array = NDArray[np.float64]


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
        within = format_quantity(self.bound, "length")
        far = format_quantity(float(self.motion[most]), "length")
        settled = f"{counted(moved, 'part')} settled into the clearance, within {within}"
        return f"{settled}; {names[most]} moved farthest, by {far}"

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
