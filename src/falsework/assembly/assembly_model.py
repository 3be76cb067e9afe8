"""Model of `assembly.json`, and of loads, joints and fasteners as a caller gives them."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any

from msgspec import Meta, defstruct

from falsework.geometry.contact.interfaces import ContactSettings
from falsework.utils.models import Model, model_schema

FORMAT = "falsework.assembly/1"
MOST = 1e12
"""Largest load, or margin of one, in SI units: beyond all that can be built, and far from where numbers overflow."""

Bounded = Annotated[float, Meta(ge=-MOST, le=MOST)]
Vector = Annotated[list[Bounded], Meta(min_length=3, max_length=3)]
Pair = Annotated[list[int | str], Meta(min_length=2, max_length=2)]
Strength = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=0)]
Earthquake = Annotated[
    list[Bounded],
    Meta(
        min_length=1,
        max_length=2,
        description="Pseudo-static horizontal acceleration along x, or along x and y, in shares of gravity.",
    ),
]


class LoadEntry(Model):
    """Load on a part."""

    part: Annotated[int | str, Meta(description="Id or name.")]
    force: Annotated[Vector | None, Meta(description="N.")] = None
    moment: Annotated[Vector | None, Meta(description="Nm.")] = None
    at: Annotated[Vector | None, Meta(description="Where the force acts, m; at the centre of mass if not given.")] = (
        None
    )


class JointEntry(Model):
    """Strength of contacts between two materials or parts, or of all contacts."""

    between: Annotated[
        Annotated[list[str], Meta(min_length=2, max_length=2)] | None, Meta(description="Two materials.")
    ] = None
    parts: Annotated[Pair | None, Meta(description="Ids or names of two parts.")] = None
    friction: Annotated[Strength | None, Meta(description="Coefficient.")] = None
    cohesion: Annotated[Strength | None, Meta(description="Pa.")] = None
    tension: Annotated[Strength | None, Meta(description="Pa.")] = None
    sets: Annotated[
        list[Annotated[list[float], Meta(min_length=2, max_length=2)]] | None,
        Meta(description="Pairs of steps and shares of the strength that rise to 1."),
    ] = None
    ductile: Annotated[
        bool | None, Meta(description="Whether the joint bears its tension when it is pulled apart.")
    ] = None


class FastenerEntry(Model):
    """Screw, dowel or magnet between two parts."""

    parts: Annotated[Pair, Meta(description="Ids or names of two parts.")]
    at: Annotated[Vector, Meta(description="Place, m.")]
    tension: Annotated[Strength, Meta(description="N.")]
    shear: Annotated[Strength | None, Meta(description="N; friction times tension if not given.")] = None
    axis: Annotated[Vector | None, Meta(description="Towards either part; the normal of the contact if not given.")] = (
        None
    )
    ductile: Annotated[bool, Meta(description="Whether it slides out or releases slowly.")] = False


ContactEntry = defstruct(
    "ContactEntry", [(one.name, float | None, None) for one in fields(ContactSettings)], bases=(Model,)
)
"""Tolerances of contact detection."""


class AssemblyFile(Model, forbid_unknown_fields=False):
    """`assembly.json`; other entries, such as an author, have no effect."""

    format: str = FORMAT
    name: str | None = None
    unit: Annotated[str | None, Meta(description="Unit of the meshes: m, dm, cm, mm, in or ft.")] = None
    friction: Annotated[float | None, Meta(description="Coefficient of every contact.")] = None
    density: Annotated[float | list[float] | None, Meta(description="One number or one a part, kg/m3.")] = None
    boundary: Annotated[
        list[Any] | None, Meta(description="Ids or names of the fixed parts, or a mask of all parts.")
    ] = None
    parts: Annotated[Count | None, Meta(description="Number of parts.")] = None
    names: Annotated[
        list[Annotated[str, Meta(pattern=r"\S")]] | None, Meta(description="Different names, one a part.")
    ] = None
    contact: ContactEntry | None = None  # type: ignore[valid-type]
    loads: list[LoadEntry] | None = None
    earthquake: float | Earthquake | None = None
    materials: Annotated[str | list[str] | None, Meta(description="Of each part, or one for all.")] = None
    joints: list[JointEntry] | None = None
    fasteners: list[FastenerEntry] | None = None


def assembly_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of `assembly.json`."""
    about = "Structure of rigid parts beside the meshes of its parts. All entries may be missing. Units are SI."
    return model_schema(AssemblyFile, "assembly-1", "falsework assembly, version 1", about)
