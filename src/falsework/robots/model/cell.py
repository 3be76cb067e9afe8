"""Immutable robot cell: robots with bases and grippers, obstacles, storage and drop-off places."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Pieces, pose

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gripper:
    """Tool on the flange. Frames: z points out of the flange; the tool frame is where a part is touched.

    A suction gripper touches a face with its cup, z of the tool frame into the face. A parallel jaw closes along x of
    the tool frame; the part is between its jaws at the origin of the tool frame.
    """

    name: str
    kind: Literal["suction", "jaw"]
    pieces: Pieces
    """Convex pieces in the frame of the flange, metres."""
    tool: Array
    """Pose of the tool frame in the frame of the flange, shape (4, 4)."""
    payload: float
    """Heaviest part that it holds, kg."""
    mass: float = 0.0
    """Its own mass, kg; counts against the payload of the arm."""
    cup: float = 0.0
    """Suction: radius of the cup, metres; a face must be at least as large."""
    opening: float = 0.0
    """Jaw: widest opening between the jaws, metres."""
    depth: float = 0.0
    """Jaw: length of the jaws along z that is in touch with the part, metres."""


@dataclass(frozen=True, eq=False)
class CellRobot:
    """Robot of a cell: arm, base, gripper, home configuration and drop-off places."""

    name: str
    model: RobotModel
    base: Array
    """Pose of the base link in the world, shape (4, 4)."""
    gripper: Gripper
    home: Array
    """Configuration to rest in, shape (joints,)."""
    places: Array
    """Tool frames in the world where a carried part is handed over, shape (places, 4, 4): drop-off when a structure is
    taken apart, pick-up when it is assembled. Which way up the part arrives is free; z points into the part."""

    @property
    def payload(self) -> float:
        """Heaviest part that arm and gripper together can carry, kg."""
        arm = np.inf if self.model.payload is None else self.model.payload - self.gripper.mass
        return float(min(arm, self.gripper.payload))


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Fixed obstacle of the cell: convex pieces in the world frame."""

    name: str
    pieces: Pieces


@dataclass(frozen=True)
class Placement:
    """Pose, scale and density of a structure in the cell."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the origin of the structure's own frame goes, metres."""
    yaw: float = 0.0
    """Turn about z, rad."""
    scale: float = 1.0
    """Size of the real thing by the size of its meshes."""
    density: float | None = None
    """Density of what it is built of in the cell, kg/m3; None: that of the structure."""

    @property
    def pose(self) -> Array:
        """Pose of the structure's frame in the world, without the scale. Shape (4, 4)."""
        return pose(self.position, self.yaw)


@dataclass(frozen=True)
class Margins:
    """Distances that motions keep, metres."""

    free: float = 0.005
    """Between everything during free moves."""
    line: float = 0.001
    """During straight approaches and withdrawals; pairs that a contact rule names may touch."""
    approach: float = 0.10
    """Length of a straight approach or withdrawal."""


@dataclass(frozen=True, eq=False)
class Cell:
    """Robots and static surroundings of a plan."""

    name: str
    robots: tuple[CellRobot, ...]
    obstacles: tuple[Obstacle, ...] = ()
    floor: float | None = 0.0
    """Height of the floor, metres; None: there is none."""
    placement: Placement = field(default_factory=Placement)
    margins: Margins = field(default_factory=Margins)
    speed: float = 1.0
    """Share of the robots' limits of velocity that motions may use; acceleration by its square."""

    @property
    def robot_count(self) -> int:
        """Number of robots."""
        return len(self.robots)

    @property
    def homes(self) -> tuple[Array, ...]:
        """Home configuration of every robot."""
        return tuple(robot.home for robot in self.robots)


def cell_identity(cell: Cell) -> str:
    """Return the digest of everything in a cell that motions depend on; hexadecimal SHA-256.

    Names of files and where a description came from do not count, nor meshes that only the check looks at.
    """
    digest = hashlib.sha256(b"falsework.cell/1")
    _feed(digest, cell)
    return digest.hexdigest()


def _feed(digest, value: Any) -> None:
    if is_dataclass(value):
        for entry in fields(value):
            if entry.name not in ("source", "path", "meshes"):
                digest.update(entry.name.encode())
                _feed(digest, getattr(value, entry.name))
    elif isinstance(value, np.ndarray):
        # Rounded, so that a cell that went through a file keeps its digest.
        digest.update((np.round(value.astype(np.float64), 9) + 0.0).astype("<f8").tobytes())
    elif isinstance(value, (tuple, list)):
        digest.update(np.int64(len(value)).tobytes())
        for entry in value:
            _feed(digest, entry)
    elif isinstance(value, (set, frozenset)):
        _feed(digest, sorted(value))
    else:
        digest.update(repr(value).encode())
