"""Fasteners: screws, dowels and magnets, as points with a strength between two parts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.assembly_model import FastenerEntry
from falsework.assembly.joints import Joints
from falsework.assembly.loads import Loads
from falsework.assembly.part_numbers import part_id
from falsework.errors import AssemblyError, ReadWarning
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.contact.patches import frames_of
from falsework.utils.models import plain, read_model
from falsework.utils.quantity import format_quantity, listed

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]


def fasten(assembly: Assembly, entries: Sequence[Mapping[str, Any]]) -> Assembly:
    """Return the assembly with fasteners, each a contact point of its own.

    A fastener is as stiff as a corner of the contacts between its parts, or of the structure where they have none. It
    transmits pressure too, as if the parts touched there.

    Args:
        assembly: with or without joints.
        entries: objects with `parts` (two ids or names), `at` (m), `tension` (N), and perhaps `shear` (N; friction
            times tension if not given), `axis` (towards either part; the normal of the contact between the parts if not
            given) and `ductile` (true for one that slides out or releases slowly).

    Raises:
        AssemblyError: parts that do not exist, invalid numbers, a place far from the parts, or no axis where the parts
            do not touch.
    """
    contacts = assembly.contacts
    joints = assembly.joints or Joints.from_arrays(contacts)
    corner = contacts.areas / np.diff(contacts.start)
    parts, points, axes, areas, strengths = [], [], [], [], []
    for entry in read_model(list[FastenerEntry], plain(entries), "", AssemblyError, "fasteners"):
        a, b = sorted(part_id(item, assembly.names, "a fastener is in part") for item in entry.parts)
        if a == b:
            raise AssemblyError(f"a fastener is between part {assembly.names[a]} and itself; give two parts")
        names = f"the fastener between parts {assembly.names[a]} and {assembly.names[b]}"
        mine = (contacts.parts == (a, b)).all(axis=1)
        axis = _normal(contacts, mine, names) if entry.axis is None else np.array(entry.axis)
        if not axis.any():
            raise AssemblyError(f"{names} needs an axis that is not zero")
        if axis @ (assembly.mass.center[b] - assembly.mass.center[a]) < 0 and entry.axis is not None:
            axis = -axis
        parts.append((a, b))
        points.append(_place(np.array(entry.at), assembly, (a, b), names))
        axes.append(axis / np.linalg.norm(axis))
        areas.append(float(corner[mine].mean() if mine.any() else corner.mean() if len(corner) else 1.0))
        shear = np.nan if entry.shear is None else entry.shear
        strengths.append((np.nan, shear, entry.tension, entry.ductile, -1))
    if not parts:
        return assembly
    frames = frames_of(np.array(axes))
    singly = np.arange(len(parts) + 1, dtype=np.int32)
    both = contacts.join(Contacts(np.array(parts, np.int32), frames, np.array(points), singly, np.array(areas)))
    order = np.lexsort(both.parts.T[::-1])
    joined, rows = both.take(order), both.points_of(order)
    old = (joints.friction, joints.cohesion, joints.tension, joints.ductile, joints.sets)
    arrays: list[NDArray[Any]] = [
        np.concatenate([array, np.array(new, array.dtype)])[rows] if len(array) == len(contacts.points) else array
        for array, new in zip(old, zip(*strengths, strict=True), strict=True)
    ]
    friction, cohesion, tension, ductile, sets = arrays
    strength = Joints(friction, cohesion, tension, ductile, joints.setting, sets)
    return replace(assembly, contacts=joined, contacts_given=True, joints=strength)


def furnish(
    assembly: Assembly,
    *,
    loads: Any = None,
    earthquake: Any = None,
    materials: Any = None,
    joints: Any = None,
    fasteners: Any = None,
) -> Assembly:
    """Return the assembly with the loads, joints and fasteners that `assembly.json` or a caller gives.

    Args:
        loads, earthquake: as for `Loads.from_entries`.
        materials, joints: as for `Joints.from_entries`.
        fasteners: as for `fasten`.
    """
    acting, own = Loads.from_entries(loads, earthquake, assembly.names, assembly.mass.center), assembly.loads
    if acting is not None and own is not None:  # what is given replaces what the file has of the same kind
        wrench = own.wrench if loads is None else acting.wrench
        pulled = own.acceleration if earthquake is None else acting.acceleration
        acting = Loads.from_arrays(assembly.part_count, wrench=wrench, acceleration=pulled)
    idle = [] if acting is None else np.flatnonzero(acting.wrench.any(axis=1) & assembly.boundary).tolist()
    if idle:
        names = listed([assembly.names[part] for part in idle])
        warnings.warn(f"loads on parts that are boundary have no effect: {names}", ReadWarning, stacklevel=2)
    joined = Joints.from_entries(joints, materials, assembly.names, assembly.contacts)
    if acting is not None or joined is not None:
        assembly = assembly.replace(loads=acting, joints=joined)
    return fasten(assembly, fasteners or [])


def _normal(contacts: Contacts, mine: NDArray[np.bool_], names: str) -> Array:
    """Return the normal of the largest contact between two parts."""
    if not mine.any():
        raise AssemblyError(f"{names} has no contact to be normal to; give its axis")
    rows = np.flatnonzero(mine)
    return contacts.frames[rows[np.argmax(contacts.areas[rows])], 0]


def _place(at: Array, assembly: Assembly, pair: tuple[int, int], names: str) -> Array:
    """Return the point of a fastener, which may not be farther from either part than the part is large."""
    for part in pair:
        low, high = (corner(assembly.meshes[part].vertices, axis=0) for corner in (np.min, np.max))
        away = float(np.linalg.norm(np.maximum(np.maximum(low - at, at - high), 0.0)))
        if away > float(np.linalg.norm(high - low)):
            raise AssemblyError(
                f"{names} is {format_quantity(away, 'length')} away from part {assembly.names[part]}; "
                "give its place in metres, within the parts"
            )
    return at
