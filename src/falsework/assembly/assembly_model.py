"""Model of `assembly.json`, and of loads, joints and fasteners as a caller gives them."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta

from falsework.utils.models import FileModel, model_schema

FORMAT = "falsework.assembly/1"
MOST = 1e12
"""Largest load, or margin of one, in SI units: beyond all that can be built, and far from where numbers overflow."""
MOST_FRICTION = 1e8
"""Largest coefficient of friction: with far larger ones verdicts depend on rounding."""

Bounded = Annotated[float, Meta(ge=-MOST, le=MOST)]
Vector = Annotated[list[Bounded], Meta(min_length=3, max_length=3)]
Pair = Annotated[list[int | str], Meta(min_length=2, max_length=2)]
Friction = Annotated[float, Meta(ge=0, le=MOST_FRICTION)]
Strength = Annotated[float, Meta(ge=0, le=MOST)]
Count = Annotated[int, Meta(ge=0)]
Earthquake = Annotated[list[Bounded], Meta(min_length=1, max_length=2)]


class Prop(FileModel, frozen=True):
    """Place of a prop."""

    part: Count
    """Part that it carries."""
    at: tuple[float, float, float]
    """Middle of its head, on the lower side of the part, m."""
    floor: float
    """Height of its floor, m."""


class LoadEntry(FileModel, frozen=True):
    """Load on a part."""

    part: int | str
    """Id or name."""
    force: Vector | None = None
    """N."""
    moment: Vector | None = None
    """Nm."""
    at: Vector | None = None
    """Where the force acts, m; at the centre of mass if not given."""


class JointEntry(FileModel, frozen=True):
    """Strength of contacts between two materials or parts, or of all contacts."""

    between: Annotated[list[str], Meta(min_length=2, max_length=2)] | None = None
    """Two materials."""
    parts: Pair | None = None
    """Ids or names of two parts."""
    friction: Friction | None = None
    """Coefficient."""
    cohesion: Strength | None = None
    """Pa."""
    tension: Strength | None = None
    """Pa."""
    sets: list[Annotated[list[float], Meta(min_length=2, max_length=2)]] | None = None
    """Pairs of steps and shares of the strength that rise to 1."""
    ductile: bool | None = None
    """Whether the joint bears its tension when it is pulled apart."""


class FastenerEntry(FileModel, frozen=True):
    """Screw, dowel or magnet between two parts."""

    parts: Pair
    """Ids or names of two parts."""
    at: Vector
    """Place, m."""
    tension: Strength
    """N."""
    shear: Strength | None = None
    """N; friction times tension if not given."""
    axis: Vector | None = None
    """Towards either part; the normal of the contact if not given."""
    ductile: bool = False
    """Whether it slides out or releases slowly."""


class ContactEntry(FileModel, frozen=True):
    """Tolerances of contact detection, as in `ContactSettings`, which would load far more than a plan needs."""

    gap: float | None = None
    """Largest gap between faces that touch, m."""
    overlap: float | None = None
    """Largest depth to which faces that touch pass through each other, m."""
    corner: float | None = None
    """Largest depth to which corners and edges cut into another part, m."""
    angle: float = 6.0
    """Largest angle between faces that touch, degrees."""
    curvature: float = 7.5
    """Largest angle between the normals of a curved interface that is treated as one plane, degrees."""


class AssemblyFile(FileModel, frozen=True, forbid_unknown_fields=False):
    """`assembly.json`; other entries, such as an author, have no effect."""

    format: str = FORMAT
    name: str | None = None
    unit: str | None = None
    """Unit of the meshes: m, dm, cm, mm, in or ft."""
    friction: float | None = None
    """Coefficient of every contact."""
    density: float | list[float] | None = None
    """One number or one a part, kg/m3."""
    boundary: list[Any] | None = None
    """Ids or names of the fixed parts, or a mask of all parts."""
    parts: Count | None = None
    """Number of parts."""
    names: list[Annotated[str, Meta(pattern="\\S")]] | None = None
    """Different names, one a part."""
    contact: ContactEntry | None = None
    settle: Annotated[float, Meta(ge=0)] | None = None
    """Largest motion with which parts settle into their clearance before they are judged, m; 0: none."""
    loads: list[LoadEntry] | None = None
    earthquake: float | Earthquake | None = None
    """Pseudo-static horizontal acceleration along x, or along x and y, in shares of gravity."""
    materials: str | list[str] | None = None
    """Of each part, or one for all."""
    joints: list[JointEntry] | None = None
    fasteners: list[FastenerEntry] | None = None


def assembly_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of `assembly.json`."""
    about = "Structure of rigid parts beside the meshes of its parts. All entries may be missing. Units are SI."
    return model_schema(AssemblyFile, "assembly-1", "falsework assembly, version 1", about)
