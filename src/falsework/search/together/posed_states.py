"""Stability of states in which parts wait half way out of their places."""

from __future__ import annotations

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, Mask, States
from falsework.errors import AssemblyError, InputError
from falsework.geometry.arrays import apply
from falsework.geometry.clearance.moves import Poses
from falsework.geometry.contact.interfaces import find_contacts
from falsework.geometry.mesh.mesh import TriangleMesh, mass_properties
from falsework.search.problem.oracle import Oracle
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings

_HOME = np.eye(4)


class PosedStates:
    """States of a structure in which parts are not in place, each judged from rest, with the contacts that it has then.

    Only parts that are there count: what waits touches others than those of its place.
    """

    def __init__(self, assembly: Assembly) -> None:
        """Take a structure.

        Raises:
            InputError: what it bears, or its contacts, belong to the places of its parts.
        """
        tied = {
            "given contacts": assembly.contacts_given,
            "joints": assembly.joints is not None,
            "loads": assembly.loads is not None,
            "props": bool(assembly.props),
        }
        if any(tied.values()):
            what = next(name for name, has in tied.items() if has)
            raise InputError(
                f"{assembly.name} has {what}, which belong to parts in place, so that none can wait half way"
            )
        self._assembly = assembly
        self._known: dict[tuple[StabilitySettings, bytes], bool] = {}

    def __reduce__(self) -> tuple[type[PosedStates], tuple[Assembly]]:
        """Pickle what it is made of."""
        return PosedStates, (self._assembly,)

    @property
    def immovable(self) -> Mask:
        """Parts that no robot holds, shape (parts,)."""
        return self._assembly.immovable

    def stands(self, oracle: Oracle, state: States, poses: Poses) -> bool:
        """Return whether a state, shape (parts,), stands in some poses; never where an oracle has no settings."""
        if oracle.settings is None:
            return False
        moved = {
            part: pose for part, pose in sorted(poses.items()) if state[part] and np.abs(pose - _HOME).max() > 1e-12
        }
        if not moved:
            return bool(oracle.verdicts(state[None]).stable[0])
        names = [np.append(np.round(pose, 9) + 0.0, part).tobytes() for part, pose in moved.items()]
        key = oracle.settings, b"".join([state.tobytes(), *names])
        if key not in self._known:
            self._known[key] = self._judge(oracle.settings, state, moved)
        return self._known[key]

    def _judge(self, settings: StabilitySettings, state: States, poses: Poses) -> bool:
        there = np.flatnonzero(state != REMOVED)
        meshes = [self._assembly.meshes[part] for part in there.tolist()]
        for row, part in enumerate(there.tolist()):
            if part in poses:
                points = apply(poses[part], meshes[row].vertices)
                meshes[row] = TriangleMesh.from_arrays(meshes[row].name, points, meshes[row].faces)
        try:
            contacts = find_contacts(meshes, self._assembly.contact_settings)
        except AssemblyError:  # parts that overlap by more than the tolerance
            return False
        whole, density = self._assembly, self._assembly.density[there]
        mass = mass_properties(meshes, density)
        posed = Assembly(
            whole.name, tuple(meshes), whole.boundary[there], density, whole.friction, contacts, mass,
            whole.contact_settings, False,
        )  # fmt: skip
        return bool(StabilityOracle(posed, settings).verdicts(state[there]).stable[0])
