"""Model of cell files, from which reading, messages and the JSON Schema derive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from falsework.errors import CellError
from falsework.robots.model.cell import Margins, Signals
from falsework.robots.model.shapes import Array, pose
from falsework.utils.models import FileModel, model_schema, read_model

Kind = TypeVar("Kind")

FORMAT = "falsework.cell/1"

Text = Annotated[str, Meta(min_length=1)]
Vector = Annotated[list[float], Meta(min_length=3, max_length=3)]
Length = Annotated[float, Meta(ge=1e-4, le=100)]
Limit = Annotated[float, Meta(ge=0)]
_SIGNALS = Signals()


class PoseEntry(FileModel, frozen=True):
    """Position and rotation."""

    position: Vector | None = None
    """Metres; the origin if not given."""
    rpy: Vector | None = None
    """Roll, pitch and yaw about fixed axes, degrees."""
    yaw: float | None = None
    """Rotation about z instead of rpy, degrees."""


class BoxEntry(FileModel, frozen=True):
    """Box between two corners."""

    low: Vector
    """Metres."""
    high: Vector
    """Metres, every coordinate above that of low."""


class CylinderEntry(FileModel, frozen=True):
    """Cylinder along z."""

    radius: Length
    """Metres."""
    low: float
    """Height of its lower end, metres."""
    high: float
    """Height of its upper end, metres."""


class ShapeEntry(PoseEntry, frozen=True):
    """Box, cylinder or both, at a pose."""

    box: BoxEntry | None = None
    cylinder: CylinderEntry | None = None


class _GripperEntry(FileModel, frozen=True, tag_field="kind"):
    payload: Annotated[float, Meta(ge=0)]
    """Largest mass that it lifts, kg."""
    shapes: Annotated[list[ShapeEntry], Meta(min_length=1)]
    """Its bodies, for collision checks."""
    tool: PoseEntry = PoseEntry()
    """Frame whose origin touches the part, in the frame of the flange."""
    mass: Annotated[float, Meta(ge=0)] = 0.0
    """kg."""
    force: Limit | None = None
    """Largest force that it bears, N."""
    moment: Annotated[float, Meta(gt=0)] | None = None
    """Largest moment that it bears, N m."""
    center_of_mass: Vector | None = None
    """In the frame of the flange, metres."""
    inertia: Annotated[list[float], Meta(min_length=3, max_length=6)] | None = None
    """Ixx, Iyy, Izz, and if needed Ixy, Ixz, Iyz, about the centre of mass, kg m2."""


class SuctionEntry(_GripperEntry, frozen=True, tag="suction", kw_only=True):
    """Suction gripper."""

    cup: Length
    """Radius of the cup, metres."""


class JawEntry(_GripperEntry, frozen=True, tag="jaw", kw_only=True):
    """Gripper with two parallel jaws."""

    opening: Length
    """Largest opening, metres."""
    depth: Length
    """Contact length of the jaws along z, metres."""


GripperEntry = SuctionEntry | JawEntry


class PlaceEntry(FileModel, frozen=True):
    """Place at which parts may be put down by a tool that points down, in the frame of the base of the robot."""

    position: Vector
    """Metres."""


class SignalsEntry(FileModel, frozen=True):
    """Settings of the controller."""

    grip: Text | None = None
    """Digital output that closes the gripper."""
    closed: Literal[0, 1] = 1 if _SIGNALS.closed else 0
    """Level of the output at which the gripper is closed."""
    seconds: Annotated[float, Meta(ge=0, le=60)] = _SIGNALS.seconds
    """Time that the gripper takes."""
    address: Text | None = None
    """Network address of the controller."""


class RobotEntry(FileModel, frozen=True):
    """Robot: arm, base, gripper, home, places and settings of the controller."""

    name: Text
    model: Text
    """Built-in arm, or path of a URDF file."""
    gripper: Text
    """Name of a gripper of the cell."""
    base: PoseEntry = PoseEntry()
    """Pose of the base in the world."""
    base_link: Text | None = None
    tip_link: Text | None = None
    srdf: Text | None = None
    """Path of an SRDF file."""
    joint_limits: Text | None = None
    """Path of a joint_limits.yaml."""
    home: list[float] | dict[str, float] | str | None = None
    """Joint values, all or by joint, degrees or metres, or the name of a state of the SRDF."""
    acceleration: list[float] | None = None
    """Of every joint, degrees or metres per s2."""
    places: list[PlaceEntry] = []
    maker: Text | None = None
    """Maker of the arm."""
    signals: SignalsEntry = SignalsEntry()


class ObstacleEntry(ShapeEntry, frozen=True, kw_only=True):
    """Obstacle."""

    name: Text


class PlacementEntry(FileModel, frozen=True):
    """Place of the structure in the cell."""

    position: Vector | None = None
    """Metres; the origin if not given."""
    yaw: float = 0.0
    """Degrees."""
    scale: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    density: Annotated[float, Meta(ge=1e-06)] | None = None
    """kg/m3, of every part."""


class CellFile(FileModel, frozen=True, kw_only=True):
    """Cell file."""

    format: str = FORMAT
    name: Text | None = None
    structure: PlacementEntry = PlacementEntry()
    margins: Margins = Margins()
    speed: Annotated[float, Meta(ge=0.001, le=1)] = 1.0
    """Share of the largest joint velocities."""
    floor: bool | float = 0.0
    """Height of the floor, metres; false for none."""
    grippers: dict[str, GripperEntry] = {}
    robots: list[RobotEntry]
    obstacles: list[ObstacleEntry] = []


@dataclass(frozen=True)
class Place:
    """Place in a cell file, for messages."""

    source: str
    where: str = ""

    def name(self, key: str) -> str:
        """Return a key as messages call it, such as `robots[0].base`."""
        return f"{self.where}.{key}" if self.where and key else self.where + key

    def inside(self, key: str) -> Place:
        """Return the place of a key."""
        return Place(self.source, self.name(key))

    def fail(self, key: str, problem: str) -> CellError:
        """Return an error about a key."""
        return CellError(f"{self.source}: {self.name(key)} {problem}")

    def read(self, kind: type[Kind], values: Any) -> Kind:
        """Return plain values as a model; CellError for a key that is missing, unknown or wrong."""
        return read_model(kind, values, f"{self.source}: ", CellError, self.where)


def pose_of(entry: PoseEntry, place: Place) -> Array:
    """Return the pose of an entry, shape (4, 4); CellError if it has yaw beside roll, pitch and yaw."""
    if entry.yaw is not None and entry.rpy is not None:
        raise place.fail("yaw", "is given beside rpy; give one of them")
    made = np.array(pose(entry.position or (0.0, 0.0, 0.0)))
    turns = entry.rpy or [0.0, 0.0, entry.yaw or 0.0]
    made[:3, :3] = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    return made


def cell_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of cell files, which editors of TOML use too."""
    about = (
        "Robots with their grippers and surroundings. Lengths are in metres, angles in degrees, masses in kilograms."
    )
    return model_schema(CellFile, "cell-1", "falsework cell, version 1", about)
