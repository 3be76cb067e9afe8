"""Loads on a structure in addition to its weight: forces on parts, and a pseudo-static earthquake."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.assembly_model import Earthquake, LoadEntry
from falsework.assembly.part_numbers import part_id
from falsework.errors import AssemblyError
from falsework.geometry.arrays import read_only
from falsework.utils.models import plain, read_model

Array = NDArray[np.float64]

GRAVITY = 9.81
"""Acceleration of which loads are shares where a file has them in m/s2."""


@dataclass(frozen=True, eq=False)
class Loads:
    """Static loads of a structure; one on a part acts in the states in which the part is installed."""

    wrench: Array
    """Force and moment about the centre of mass of each part, N and Nm, shape (parts, 6), read-only."""
    acceleration: Array
    """Acceleration of every part in addition to gravity, in shares of gravity, shape (3,), read-only."""

    @staticmethod
    def from_arrays(parts: int, *, wrench: ArrayLike | None = None, acceleration: ArrayLike = (0.0, 0.0, 0.0)) -> Loads:
        """Check arrays and make loads of them.

        Args:
            wrench: N and Nm about the centres of mass, shape (parts, 6).
            acceleration: in shares of gravity, shape (3,).

        Raises:
            AssemblyError: wrong shapes, or numbers that are not finite.
        """
        arrays = []
        given = np.zeros((parts, 6)) if wrench is None else wrench
        for name, value, shape in (("loads", given, (parts, 6)), ("the acceleration", acceleration, (3,))):
            array = np.array(value, dtype=np.float64)
            if array.shape != shape or not np.isfinite(array).all():
                raise AssemblyError(f"{name} must be finite numbers of shape {shape}, but have shape {array.shape}")
            arrays.append(array)
        return Loads(*read_only(*arrays))

    @staticmethod
    def from_entries(entries: Any, earthquake: Any, names: Sequence[str], center: Array) -> Loads | None:
        """Read loads as `assembly.json` and the command line give them.

        Args:
            entries: objects with `part` (id or name), `force` (N), and perhaps `at` (m) and `moment` (Nm); or None.
            earthquake: horizontal acceleration in shares of gravity: along x, or along x and y; or None.
            center: centres of mass, shape (parts, 3), m.

        Returns:
            Loads, or None if there are none.

        Raises:
            AssemblyError: a load on a part that does not exist, or invalid numbers.
        """
        wrench = np.zeros((len(names), 6))
        read = read_model(list[LoadEntry], plain(entries or []), "", AssemblyError, "loads", "; give a force in N")
        for entry in read:
            part = part_id(entry.part, names, "a load acts on part")
            if entry.force is None and entry.moment is None:
                raise AssemblyError(
                    f"the load on part {names[part]} has neither a force nor a moment; give one in N or Nm"
                )
            force, moment = (np.array(value or (0.0, 0.0, 0.0)) for value in (entry.force, entry.moment))
            if entry.at is not None:
                moment = moment + np.cross(entry.at - center[part], force)
            wrench[part] += np.concatenate([force, moment])
        acceleration = np.zeros(3)
        if earthquake is not None:
            given = plain(earthquake)
            given = given if isinstance(given, list) else [given]
            values: list[float] = read_model(Earthquake, given, "", AssemblyError, "earthquake")  # type: ignore[arg-type]
            acceleration[: len(values)] = values
        if not (wrench.any() or acceleration.any()):
            return None
        return Loads.from_arrays(len(names), wrench=wrench, acceleration=acceleration)

    def describe(self) -> dict[str, Any]:
        """Return the entries of `assembly.json` that `read` makes these loads of.

        Raises:
            AssemblyError: a vertical acceleration, which `assembly.json` cannot express.
        """
        if self.acceleration[2]:
            raise AssemblyError("a vertical acceleration cannot be written to assembly.json; use horizontal ones")
        loads = [
            {"part": part, "force": self.wrench[part, :3].tolist(), "moment": self.wrench[part, 3:].tolist()}
            for part in np.flatnonzero(self.wrench.any(axis=1)).tolist()
        ]
        return {"loads": loads, "earthquake": self.acceleration[:2].tolist()}

    def applied(self, mass: Array, gravity: float) -> Array:
        """Return all wrenches on the parts, weight included, N and Nm about the centres of mass, shape (parts, 6).

        Args:
            mass: shape (parts,), kg.
            gravity: m/s2.
        """
        wrench = self.wrench.copy()
        wrench[:, :3] += gravity * mass[:, None] * (self.acceleration - [0.0, 0.0, 1.0])
        return wrench
