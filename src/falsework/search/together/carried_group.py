"""Groups of parts that one robot carries by one part: whether they hold together in the air."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import complete_state
from falsework.errors import AssemblyError
from falsework.geometry.mesh.mesh import MassProperties
from falsework.stability.holds import limits_of
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings


def holds_together(assembly: Assembly, parts: Sequence[int], carrier: int, settings: StabilitySettings) -> bool:
    """Return whether a group stands alone, held at one part, and a robot can bear its weight and moment there.

    The group keeps its orientation, so one verdict is enough for its whole way out, as long as that is straight.

    Args:
        assembly: the structure.
        parts: the group.
        carrier: the part of it that the robot holds.
        settings: criterion and limits of robots.

    Raises:
        AssemblyError: parts that no contacts connect.
    """
    group = carried_group(assembly, parts, carrier)
    wrench = assembly.applied_wrench(settings.gravity)[list(parts)]
    lever = assembly.mass.center[list(parts)] - assembly.mass.center[carrier]
    force = wrench[:, :3].sum(axis=0)
    moment = (wrench[:, 3:] + np.cross(lever, wrench[:, :3])).sum(axis=0)
    if settings.criterion == "contact":
        limits = limits_of(assembly, settings.holds, settings.gravity)
        if np.linalg.norm(force) > limits.force[carrier] or np.linalg.norm(moment) > limits.moment[carrier]:
            return False
    verdicts = StabilityOracle(group, settings).verdicts(complete_state(group.boundary), require_certificate=True)
    return bool(verdicts.stable[0])


def carried_group(assembly: Assembly, parts: Sequence[int], carrier: int) -> Assembly:
    """Return a group as a structure of its own, in which the part that a robot holds is the boundary.

    Raises:
        AssemblyError: parts that no contacts connect.
    """
    rows, contacts = np.array(sorted(parts)), assembly.contacts
    inside = np.asarray(np.isin(contacts.parts, rows).all(axis=1))
    own = contacts.take(np.flatnonzero(inside))
    own = replace(own, parts=np.searchsorted(rows, own.parts).astype(np.int32))
    alone = next((part for part in rows.tolist() if part not in _reached(own.parts, rows, carrier)), None)
    if alone is not None:
        raise AssemblyError(
            f"parts {', '.join(assembly.names[part] for part in rows)} are no group that one robot can carry: no "
            f"contact connects {assembly.names[alone]} to {assembly.names[carrier]}"
        )
    loads, joints = assembly.loads, assembly.joints
    return replace(
        assembly,
        name=f"{assembly.name} ({', '.join(assembly.names[part] for part in rows)})",
        meshes=tuple(assembly.meshes[part] for part in rows),
        boundary=rows == carrier,
        density=assembly.density[rows],
        mass=MassProperties(**{key: value[rows] for key, value in vars(assembly.mass).items()}),
        contacts=own,
        contacts_given=True,
        loads=None if loads is None else replace(loads, wrench=loads.wrench[rows]),
        joints=None if joints is None else joints.of_points(inside[contacts.contact_of_point]),
        props=(),
    )


def _reached(pairs: np.ndarray, rows: np.ndarray, carrier: int) -> set[int]:
    """Return the parts that contacts connect to the carrier, itself included."""
    found = np.zeros(len(rows), dtype=bool)
    found[np.searchsorted(rows, carrier)] = True
    for _ in rows:
        touched = found[pairs].any(axis=1)
        found[pairs[touched]] = True
    return set(rows[found].tolist())
