"""Rule on several parts in one step: which sets leave together, and which of their parts one robot carries them by."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, complete_state
from falsework.errors import AssemblyError, InputError
from falsework.geometry.clearance.locked import LARGEST, PartSet
from falsework.geometry.clearance.part_sets import SetClearance
from falsework.geometry.mesh.edges import components
from falsework.geometry.mesh.mesh import MassProperties
from falsework.search.problem.oracle import Oracle
from falsework.stability.holds import limits_of
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings


class InterlockedSets:
    """Rule that parts of a structure leave together where they lock each other; see `SetClearance`."""

    def __init__(self, assembly: Assembly, largest: int) -> None:
        """Take a structure.

        Args:
            largest: parts of a step at most.

        Raises:
            InputError: fewer than two parts, or more than can move.
        """
        most = min(int((~assembly.immovable).sum()), LARGEST)
        if not (isinstance(largest, int | np.integer) and 1 < largest <= most):
            raise InputError(
                f"{largest} is not a number of parts of {assembly.name} that can move at once; give 1 (one at a time) "
                f"to {max(most, 1)}"
            )
        self.largest, self._assembly = int(largest), assembly
        self.each_held = self.by_one = True
        """Whether several robots may move a set, each with a part of its own; and whether one robot may carry it."""
        self._carriers: dict[tuple[PartSet, StabilitySettings], tuple[int, ...]] = {}

    @property
    def carried(self) -> InterlockedSets:
        """The same rule for sets that one robot carries."""
        new = copy(self)
        new.each_held = False
        return new

    @property
    def held(self) -> InterlockedSets:
        """The same rule for sets of which a robot of its own holds each part."""
        new = copy(self)
        new.by_one = False
        return new

    def sets(self, movable: Mask) -> tuple[PartSet, ...]:
        """Return the sets of two parts and more, among parts of shape (parts,), that may leave together somewhere."""
        return self.clearance.sets(movable, self.largest)

    @property
    def clearance(self) -> SetClearance:
        """Which sets leave together from which states."""
        return self._assembly.clearance_of_sets

    def carriers(self, parts: PartSet, oracle: Oracle) -> tuple[int, ...]:
        """Return the parts by which one robot can carry a set, under the settings of an oracle.

        None if no contacts connect the set, or the oracle has no settings.
        """
        settings = oracle.settings
        if settings is None or not self.by_one:
            return ()
        if (parts, settings) not in self._carriers:
            try:
                found = tuple(part for part in parts if holds_together(self._assembly, parts, part, settings))
            except AssemblyError:
                found = ()
            self._carriers[parts, settings] = found
        return self._carriers[parts, settings]

    def name(self, parts: PartSet) -> str:
        """Return the names of some parts."""
        return " with ".join(self._assembly.names[part] for part in parts)


def holds_together(assembly: Assembly, parts: Sequence[int], carrier: int, settings: StabilitySettings) -> bool:
    """Return whether a group stands alone, held at one part, and a robot can bear its weight and moment there.

    The group keeps its orientation, so one verdict is enough for its whole way out, as long as that is straight.

    Args:
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
        most, turns = limits_of(assembly, settings.holds, settings.gravity)
        if np.linalg.norm(force) > most or np.linalg.norm(moment) > turns:
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
    joined = components(own.parts[:, 0], own.parts[:, 1], len(rows))
    alone = rows[joined != joined[np.searchsorted(rows, carrier)]]
    if len(alone):
        raise AssemblyError(
            f"parts {', '.join(assembly.names[part] for part in rows)} are no group that one robot can carry: no "
            f"contact connects {assembly.names[alone[0]]} to {assembly.names[carrier]}"
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
