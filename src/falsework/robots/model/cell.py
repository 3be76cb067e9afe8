"""Immutable robot cell: robots with bases and grippers, obstacles, storage and drop-off poses."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array, Pieces, pose
from falsework.utils.models import FileModel

GRIP_DISTANCE = 0.005
"""Largest distance of a cup, or of closed jaws, from a part that is held, metres."""
GRIP_DEPTH = 0.001
"""Largest depth of a tool frame below the surface that it touches, metres."""
FLAT_DEGREES = 12.0
"""Largest angle between the triangles of a face that a gripper takes for flat, degrees; the lip of a cup compensates
for it."""
GRIP_TILT = FLAT_DEGREES + 3.0
"""Largest angle between a gripper and the face that it grips, degrees: a face that counts as flat may be curved."""
LONGEST_APPROACH = 2.0
"""Largest length of a line on which a gripper may touch a part, in approach margins of the cell."""
LONGEST_WITHDRAWAL = 5.0
"""Largest length of the lines on which a part leaves its place or reaches it, in approach margins of the cell."""

_MAKERS = {
    "ABB": re.compile(r"(abb[\W_]|(abb[\W_]?)?(irb|crb)[\W_]?\d)", re.IGNORECASE),
    "Universal Robots": re.compile(r"(universal[\W_]?robots?|ur(\d+(e|cb\d?)?)?)($|[\W_])", re.IGNORECASE),
}
"""Makers of arms by beginnings of names of models: built-in arms, and robot names of URDF files."""


@dataclass(frozen=True, eq=False)
class Gripper:
    """Tool on the flange. Frames: z points out of the flange; the origin of the tool frame touches the part.

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
    """Payload of the gripper, kg."""
    mass: float = 0.0
    """Mass of the gripper, kg; counts against the payload of the arm."""
    cup: float = 0.0
    """Suction: radius of the cup, metres; a face must be at least as large."""
    opening: float = 0.0
    """Jaw: largest opening, metres."""
    depth: float = 0.0
    """Jaw: contact length of the jaws along z, metres."""
    force: float = np.inf
    """Largest force on a part that it holds in place, in any direction, N."""
    moment: float = np.inf
    """Largest moment about the origin of the tool frame, about any axis, Nm."""
    center_of_mass: Array | None = None
    """In the frame of the flange, metres, shape (3,); None: unknown."""
    inertia: Array | None = None
    """About the centre of mass, along the axes of the flange, kg m2, shape (3, 3); None: unknown."""

    @property
    def grip_distance(self) -> float:
        """Largest distance of its bodies from a part that it holds, metres: those of jaws are where they are open."""
        return GRIP_DISTANCE + self.opening / 2

    @property
    def press_depth(self) -> float:
        """How far its bodies may reach into a part that it touches, metres: a lip yields where a face is tilted."""
        return GRIP_DEPTH + self.cup * float(np.tan(np.radians(GRIP_TILT)))

    @property
    def has_limits(self) -> bool:
        """Whether the force or moment that it bears is known."""
        return bool(np.isfinite(self.force) or np.isfinite(self.moment))


@dataclass(frozen=True)
class Signals:
    """Settings of a robot's controller that programs refer to."""

    grip: str | None = None
    """Digital output that closes the gripper; None: that of the language of the program."""
    closed: bool = True
    """Level of this output at which the gripper is closed."""
    seconds: float = 0.5
    """Time that the gripper takes to close or open."""
    address: str | None = None
    """Network address of the controller; None: `NAME.local`."""


@dataclass(frozen=True, eq=False)
class CellRobot:
    """Robot of a cell: arm, base, gripper, home configuration and drop-off poses."""

    name: str
    model: RobotModel
    base: Array
    """Pose of the base link in the world, shape (4, 4)."""
    gripper: Gripper
    home: Array
    """Home configuration, shape (joints,)."""
    places: Array
    """Tool frames in the world where a carried part is handed over, shape (places, 4, 4): drop-off in disassembly,
    pick-up in assembly. The orientation of the part is free; z points into the part."""
    maker: str | None = None
    """Maker of the arm, as the cell states it; None: it does not."""
    signals: Signals = field(default_factory=Signals)

    @property
    def payload(self) -> float:
        """Heaviest part that arm and gripper together can carry, kg."""
        arm = np.inf if self.model.payload is None else self.model.payload - self.gripper.mass
        return float(min(arm, self.gripper.payload))

    @property
    def is_upright(self) -> bool:
        """Whether its base stands upright, not on a wall or a ceiling."""
        return bool(self.base[2, 2] > 1 - 1e-6)


def maker_of(robot: CellRobot) -> tuple[str | None, bool]:
    """Return the maker of an arm, and whether it is only taken from the name in a URDF file; None if it is unknown."""
    if robot.maker is not None:
        return robot.maker, False
    name = robot.model.name
    found = next((maker for maker, pattern in _MAKERS.items() if pattern.match(name)), None)
    return found, found is not None and robot.model.source != "built-in"


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Fixed obstacle of the cell: convex pieces in the world frame."""

    name: str
    pieces: Pieces


@dataclass(frozen=True)
class Placement:
    """Pose, scale and density of a structure in the cell."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the origin of the structure's own frame, metres."""
    yaw: float = 0.0
    """Rotation about z, rad."""
    scale: float = 1.0
    """Ratio of real size to the size of the meshes."""
    density: float | None = None
    """Density of the material in the cell, kg/m3; None: that of the structure."""

    @property
    def pose(self) -> Array:
        """Pose of the structure's frame in the world, without the scale. Shape (4, 4)."""
        return pose(self.position, self.yaw)


class Margins(FileModel, frozen=True):
    """Distances that motions keep."""

    free: Annotated[float, Meta(ge=0.0005, le=1)] = 0.005
    """Clearance of free motions, metres."""
    line: Annotated[float, Meta(ge=0, le=1)] = 0.001
    """Clearance of the straight motions of a part, metres; pairs in a contact rule may touch."""
    approach: Annotated[float, Meta(ge=0.001, le=10)] = 0.10
    """Length of the straight motion to a part, metres."""


@dataclass(frozen=True, eq=False)
class Cell:
    """Robots and static surroundings of a plan."""

    name: str
    robots: tuple[CellRobot, ...]
    obstacles: tuple[Obstacle, ...] = ()
    floor: float | None = 0.0
    """Height of the floor, metres; None: no floor."""
    placement: Placement = field(default_factory=Placement)
    margins: Margins = field(default_factory=Margins)
    speed: float = 1.0
    """Share of the robots' velocity limits that motions may use; of acceleration limits its square."""

    def __repr__(self) -> str:
        return f"<Cell {self.name}: robots {', '.join(robot.name for robot in self.robots)}>"

    @property
    def robot_count(self) -> int:
        """Number of robots."""
        return len(self.robots)

    @property
    def homes(self) -> tuple[Array, ...]:
        """Home configuration of every robot."""
        return tuple(robot.home for robot in self.robots)


_NO_MOTION = {
    *("source", "path", "meshes", "assumed", "srdf", "group_states"),
    *("maker", "signals", "center_of_mass", "inertia"),
}
"""Fields that motions do not depend on."""


def cell_identity(cell: Cell) -> str:
    """Return the SHA-256 digest, hexadecimal, of everything in a cell that motions depend on.

    What motions do not depend on does not count: file names, the source of a description, meshes that only the check
    uses, and settings that only exports use.
    """
    digest = hashlib.sha256(b"falsework.cell/1")
    _feed(digest, cell)
    return digest.hexdigest()


def _feed(digest, value: Any) -> None:
    if is_dataclass(value) or isinstance(value, FileModel):
        names = [entry.name for entry in fields(value)] if is_dataclass(value) else value.__struct_fields__
        for name in names:
            # A limit that is not given was unknown to earlier versions, whose digests stay valid.
            absent = name in ("force", "moment") and np.isinf(getattr(value, name))
            if name not in _NO_MOTION and not absent:
                digest.update(name.encode())
                _feed(digest, getattr(value, name))
    elif isinstance(value, np.ndarray):
        # Rounded, so that the digest survives a round trip through a file.
        digest.update((np.round(value.astype(np.float64), 9) + 0.0).astype("<f8").tobytes())
    elif isinstance(value, (tuple, list)):
        digest.update(np.int64(len(value)).tobytes())
        for entry in value:
            _feed(digest, entry)
    elif isinstance(value, (set, frozenset)):
        _feed(digest, sorted(value))
    else:
        digest.update(repr(value).encode())
