"""Groups of parts that a robot handles as one: the structure in which each is a single part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from dataclasses import replace as _replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_id
from falsework.assembly.props import ProppedAssembly, with_props
from falsework.assembly.state import INSTALLED, REMOVED, States
from falsework.errors import AssemblyError, StateError
from falsework.geometry.mesh.mesh import TriangleMesh, joined_faces


@dataclass(frozen=True, eq=False)
class Groups:
    """Structure whose parts were joined, and which part each of them has become."""

    loose: Assembly
    """The structure with all its parts."""
    joined: NDArray[np.int64]
    """Joined part that each loose part belongs to, shape (loose parts,)."""
    carrier: NDArray[np.int64]
    """Loose part by which robots hold each joined part, shape (joined parts,)."""

    @property
    def names(self) -> list[list[str]]:
        """Names of the parts of each group, the one that robots hold first."""
        found = []
        for joined, carrier in enumerate(self.carrier.tolist()):
            others = [part for part in np.flatnonzero(self.joined == joined).tolist() if part != carrier]
            found += [[self.loose.names[part] for part in (carrier, *others)]] if others else []
        return found

    @property
    def carried_faces(self) -> dict[int, int]:
        """Number of faces of the part that robots hold, the first of the mesh, for each part that was joined."""
        several = np.flatnonzero(np.bincount(self.joined) > 1).tolist()
        return {part: len(self.loose.meshes[self.carrier[part]].faces) for part in several}

    def loosen(self, states: States) -> States:
        """Return the states of the loose parts: those that are carried are installed where their carrier is there.

        Args:
            states: of the joined parts, shape (..., joined parts).

        Returns:
            Shape (..., loose parts).
        """
        found = np.asarray(states)[..., self.joined]
        rides = self.carrier[self.joined] != np.arange(len(self.joined))
        return np.where(rides & (found != REMOVED), INSTALLED, found).astype(np.uint8)

    def join(self, state: States) -> States:
        """Return the state of the joined parts, shape (joined parts,)."""
        found = np.asarray(state, dtype=np.uint8)[self.carrier]
        wrong = np.flatnonzero(self.loosen(found) != state)
        if len(wrong):
            name = self.loose.names[wrong[0]]
            raise StateError(f"part {name} is of a group that one robot carries; insert or remove all of it at once")
        return found


@dataclass(frozen=True, eq=False)
class JoinedAssembly(ProppedAssembly):
    """Structure in which groups of parts are one part each."""

    groups: Groups | None = None

    def __post_init__(self) -> None:
        self._refuse("joints", self.joints)

    def replace(self, **changes: Any) -> Assembly:
        """Return the same groups of a structure that is changed before they are joined; see `Assembly.replace`."""
        for name in ("loads", "joints"):
            self._refuse(name, changes.get(name))
        return self._again(lambda loose: loose.replace(**changes))

    def at_friction(self, friction: float) -> Assembly:
        """As of `Assembly`, with joined and with loose parts."""
        assert self.groups is not None
        joined = super().at_friction(friction)
        assert isinstance(joined, JoinedAssembly)
        return _replace(joined, groups=_replace(self.groups, loose=self.groups.loose.at_friction(friction)))

    def with_ground(self) -> Assembly:
        """As of `Assembly`, with joined and with loose parts."""
        return self._again(lambda loose: loose.with_ground())

    def _again(self, change: Callable[[Assembly], Assembly]) -> Assembly:
        """Return the same groups and props of a structure with loose parts that is changed."""
        assert self.groups is not None
        self._refuse("loads", self.loads)
        return with_props(join_parts(change(self.groups.loose), self.groups.names), self.props)

    def _refuse(self, name: str, what: object) -> None:
        if what is not None:
            raise AssemblyError(
                f"{self.name} has joined parts, and {name} are of single parts; only parts without are joined"
            )


def groups_of(assembly: Assembly) -> Groups | None:
    """Return the groups that are one part each in a structure; None if there are none."""
    return assembly.groups if isinstance(assembly, JoinedAssembly) else None


def join_parts(assembly: Assembly, groups: Sequence[Sequence[int | str]]) -> Assembly:
    """Return the structure in which each of some groups of parts is one part, held by the first of them.

    A joined part has the place of the first in the order of parts. `groups_of` returns the structure with loose
    parts: what is proven of joined parts is not proven of those, which may come apart.

    Args:
        groups: numbers or names of the parts of each group, the one that robots hold first.

    Raises:
        AssemblyError: a part that does not exist, is fixed or in two groups; groups of different densities; or loads,
            joints, props or given contacts, which are of single parts.
    """
    if not groups:
        return assembly
    numbers = [[part_id(part, assembly.names, "a group has part") for part in group] for group in groups]
    every = [part for group in numbers for part in group]
    twice = next((part for part in every if every.count(part) > 1), None)
    if twice is not None:
        raise AssemblyError(f"part {assembly.names[twice]} is in two groups, or twice in one; name it once")
    still = next((part for part in every if assembly.immovable[part]), None)
    if still is not None:
        raise AssemblyError(f"part {assembly.names[still]} is fixed, so no robot carries it; leave it out of the group")
    single = [assembly.loads, assembly.joints, assembly.props or None, assembly.contacts_given or None]
    if any(what is not None for what in single):
        raise AssemblyError(
            f"{assembly.name} has loads, joints, props or given contacts; only parts without are joined"
        )
    rides = [part for group in numbers for part in group[1:]]
    carrier = np.array([part for part in range(assembly.part_count) if part not in rides])
    joined = np.searchsorted(carrier, np.arange(assembly.part_count))
    meshes = [assembly.meshes[part] for part in carrier]
    for group in numbers:
        density = assembly.density[group]
        if np.ptp(density) > 0:
            names = ", ".join(assembly.names[part] for part in group)
            raise AssemblyError(f"parts {names} have different densities; only parts of one are joined")
        joined[group] = place = int(np.searchsorted(carrier, group[0]))
        meshes[place] = _one_mesh([assembly.meshes[part] for part in group])
    found = Assembly.from_meshes(
        meshes,
        boundary=assembly.boundary[carrier],
        density=assembly.density[carrier],
        friction=assembly.friction,
        name=assembly.name,
        contact_settings=assembly.contact_settings,
    )
    return JoinedAssembly(**vars(found), groups=Groups(assembly, joined, carrier))


def _one_mesh(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return the faces of several meshes as one, in their order."""
    name = f"{meshes[0].name} with {', '.join(mesh.name for mesh in meshes[1:])}"
    return TriangleMesh.from_arrays(
        name, *joined_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
    )
