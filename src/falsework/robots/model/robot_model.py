"""Immutable model of a robot arm: joints, limits, and the convex pieces of its links."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.model.shapes import Array, Pieces
from falsework.utils.quantity import format_number

ACCELERATION_TIME = 0.5
"""Time in which a joint reaches full speed if its description gives no acceleration limit, s."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Chain of joints, each of which moves one link; link 0 is the base and does not move.

    Frames: `origins[j]` is the pose of the frame of link `j + 1`, at joint value zero, in the frame of link `j`; joint
    `j` rotates about (or slides along) `axes[j]` in the frame of link `j + 1`.
    """

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    """Base link first; one more than joints."""
    origins: Array
    """Shape (joints, 4, 4)."""
    axes: Array
    """Unit vectors, shape (joints, 3)."""
    prismatic: NDArray[np.bool_]
    """Shape (joints,)."""
    lower: Array
    """Position limits, rad or m, shape (joints,)."""
    upper: Array
    velocity: Array
    """Speed limits, rad/s or m/s, shape (joints,)."""
    acceleration: Array
    """Acceleration limits, rad/s2 or m/s2, shape (joints,)."""
    pieces: tuple[Pieces, ...]
    """Convex pieces of every link in its own frame, metres; base first."""
    ignored: frozenset[tuple[int, int]]
    """Pairs of links `(a, b)`, a < b, that are never checked against each other."""
    flange: Array
    """Pose of the frame that a gripper is mounted on (`tool0`, z outwards) in the frame of the last link."""
    home: Array
    """Home configuration, shape (joints,)."""
    payload: float | None = None
    """Payload at the flange, gripper included, kg; None: unknown."""
    meshes: tuple[tuple[TriangleMesh, ...], ...] | None = None
    """Collision meshes of every link from the robot description, in the frame of the link, for checks that do not
    use `pieces`; None: there are only the pieces."""
    source: str = field(default="built-in")
    """Source of the description: `built-in` or the path of a URDF file."""
    assumed: tuple[str, ...] = ()
    """Joints whose acceleration limit no file states."""
    srdf: str = ""
    """Path of the SRDF that was read with it; empty without one."""
    group_states: tuple[tuple[str, Array], ...] = ()
    """Named configurations from the SRDF, each of shape (joints,)."""

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.lower)

    @property
    def units(self) -> Array:
        """Factors from degrees and metres, in which people give joint values, to rad and metres, shape (joints,)."""
        return np.where(self.prismatic, 1.0, np.pi / 180)

    @cached_property
    def reach(self) -> float:
        """Bound on the distance of the flange from the origin of the first joint axis, metres."""
        steps = np.linalg.norm(self.origins[1:, :3, 3], axis=1).sum() + np.linalg.norm(self.flange[:3, 3])
        slides = np.maximum(np.abs(self.lower), np.abs(self.upper))[self.prismatic].sum()
        return float(steps + slides)

    def within_limits(self, configurations: Array, tolerance: float = 1e-9) -> NDArray[np.bool_]:
        """Return whether configurations keep the position limits. Shape (..., joints) to (...)."""
        inside = (configurations >= self.lower - tolerance) & (configurations <= self.upper + tolerance)
        return np.asarray(inside.all(axis=-1))

    def first_outside(self, configuration: Array, tolerance: float = 1e-9) -> int | None:
        """Return the first joint that is beyond its position limits; None if all keep them."""
        beyond = (configuration < self.lower - tolerance) | (configuration > self.upper + tolerance)
        return int(np.argmax(beyond)) if beyond.any() else None

    def check_configuration(self, values: object, what: str = "configuration") -> Array:
        """Return one user-supplied configuration as an array of shape (joints,).

        Raises:
            InputError: wrong length, not numbers, or outside the limits; the message names the joint.
        """
        try:
            found = np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{what} is {values!r}; give {self.joints} joint values in rad") from None
        if found.shape != (self.joints,):
            raise InputError(f"{what} has shape {found.shape}; {self.name} needs {self.joints} joint values")
        if not np.isfinite(found).all():
            raise InputError(f"{what} holds a value that is not finite; give {self.joints} joint values in rad")
        if (joint := self.first_outside(found)) is not None:
            raise InputError(
                f"{what}: {self.joint_names[joint]} is {format_number(found[joint], 4)}, outside its limits "
                f"{format_number(self.lower[joint], 4)} to {format_number(self.upper[joint], 4)}"
            )
        return found
