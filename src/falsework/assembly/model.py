"""Immutable assembly: parts, contacts, boundary, density and friction."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from dataclasses import replace as _replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.assembly_model import MOST, MOST_FRICTION, Prop
from falsework.assembly.joints import Joints
from falsework.assembly.loads import Loads
from falsework.assembly.part_numbers import part_ids
from falsework.assembly.touching import check_touching, contact_warnings, warn_of
from falsework.errors import AssemblyError
from falsework.geometry.arrays import read_only
from falsework.geometry.clearance.part_sets import SetClearance
from falsework.geometry.clearance.table import ClearanceTable, StraightWays
from falsework.geometry.contact.interfaces import Contacts, ContactSettings, find_contacts
from falsework.geometry.contact.joints import JointReport
from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh, ground_slab, mass_properties
from falsework.geometry.settling.fits import clearance_hint
from falsework.geometry.settling.settlement import Settlement
from falsework.utils.display.notebook import Displayed
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.geometry.paths.motions import PartMotions

DENSITY = 2400.0
"""Default density, kg/m3: concrete."""
FRICTION = 0.55
"""Default coefficient of friction, that of the paper's structures."""


@dataclass(frozen=True, eq=False)
class Assembly(Displayed):
    """Rigid parts and the contacts between them; everything that depends on the structure alone."""

    name: str
    meshes: tuple[TriangleMesh, ...]
    boundary: NDArray[np.bool_]
    """Permanently fixed parts, shape (parts,)."""
    density: NDArray[np.float64]
    """Shape (parts,), kg/m3."""
    friction: float
    """Coefficient of friction of every contact."""
    contacts: Contacts
    mass: MassProperties
    contact_settings: ContactSettings = field(default_factory=ContactSettings)
    """Tolerances with which the contacts were found."""
    contacts_given: bool = False
    """Whether the contacts were given, such as interfaces that a file stores, and not found from the meshes."""
    loads: Loads | None = None
    """Loads in addition to the weight of the parts."""
    props: tuple[Prop, ...] = ()
    """Props that states may have: the last parts, which never move and need no robot; see `with_props`."""
    joints: Joints | None = None
    """Friction, cohesion and tension of the contacts, where they are not dry or differ."""
    settlement: Settlement | None = None
    """Motion of the parts from the poses of their model into these, if they settled."""

    @staticmethod
    def from_meshes(
        meshes: Sequence[TriangleMesh],
        *,
        boundary: ArrayLike,
        density: ArrayLike = DENSITY,
        friction: float = FRICTION,
        name: str = "assembly",
        contact_settings: ContactSettings | None = None,
        ground: bool = False,
        contacts: Contacts | None = None,
        settle: float | None = None,
    ) -> Assembly:
        """Find contacts and masses, and check that the parts make an assembly.

        Pairs of parts that touch along a line or at a point only are reported as `ContactWarning`, see `warnings`.

        Args:
            meshes: closed meshes that face outwards, metres.
            boundary: ids or names of the fixed parts, or a mask of shape (parts,).
            density: one number or one a part, kg/m3.
            friction: coefficient of friction of every contact.
            name: name of the structure in plans and messages.
            ground: add a fixed slab under the lowest point, as the last part.
            contacts: contacts of the parts, if they are known; found from the meshes if not given.
            settle: largest motion with which parts settle into their clearance first, metres; none if not given or 0.

        Raises:
            AssemblyError: no parts, blank names, no boundary or ids out of range, density or friction out of range,
                parts that pass through each other, a part that touches nothing, or parts that cannot settle.
            MeshError: a part whose volume is not positive.
        """
        parts = tuple(meshes)
        wrong = next((part for part in parts if not isinstance(part, TriangleMesh)), None)
        if wrong is not None:
            raise AssemblyError(
                f"a part is a {type(wrong).__name__}; make it a TriangleMesh, such as by "
                "TriangleMesh.from_arrays(name, vertices, faces)"
            )
        if not parts:
            raise AssemblyError("an assembly needs at least one part")
        for number, part in enumerate(parts):
            if not (isinstance(part.name, str) and part.name.strip()):
                raise AssemblyError(f"the name of part {number} is {part.name!r}; give a text that is not blank")
        friction = _friction(friction)
        densities = _density(density, len(parts))
        fixed = _boundary(boundary, parts)
        if ground:
            if contacts is not None:
                raise AssemblyError("given contacts know no ground; name fixed parts (--boundary) or find the contacts")
            parts = (*parts, ground_slab(parts))
            fixed = np.append(fixed, True)
            densities = np.append(densities, DENSITY)
        if not fixed.any():
            raise AssemblyError(
                "no part is boundary, so nothing carries the structure; "
                "name the fixed parts, or use --ground to put a fixed ground under the lowest point"
            )
        mass = mass_properties(parts, densities)
        settings = contact_settings or ContactSettings()
        given, settlement = contacts is not None, None
        if settle:
            if given:
                raise AssemblyError("given contacts belong to the poses of the parts, which cannot settle; find them")
            from falsework.geometry.settling.settle import settle_parts  # few structures need it

            parts, settlement = settle_parts(parts, fixed, mass, friction, settle)
            mass = mass_properties(parts, densities)
        contacts = find_contacts(parts, settings) if contacts is None else contacts
        check_touching(parts, fixed, contacts, settings, settle or None)
        read_only(fixed, densities)
        assembly = Assembly(
            name, parts, fixed, densities, friction, contacts, mass, settings, given, settlement=settlement
        )
        warn_of(assembly.warnings)
        return assembly

    def __repr__(self) -> str:
        fixed = int(self.boundary.sum())
        return (
            f"<Assembly {self.name}: {counted(self.part_count, 'part')}, {fixed} of them boundary, "
            f"{counted(len(self.contacts), 'contact')}, friction {self.friction:g}>"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for all joints that were resolved, and one for each pair that touches on less than a face.

        That is along lines, at points, or on strips narrower than the default gap. Real edges and corners have a width,
        which the meshes do not say, and may be chipped off. Pairs whose faces are inclined to each other by more than
        friction holds have a line too. Pairs of boundary parts are omitted: no verdict depends on them.
        """
        return contact_warnings(self.meshes, self.boundary, self.contacts, self.friction)

    @property
    def clearance_hint(self) -> str:
        """What to do if parts do not rest where the model has them, because they have clearance; empty if none has."""
        known = self.settlement is not None or self.contacts_given
        return "" if known else clearance_hint(self.meshes, self.boundary, self.contact_settings)

    @property
    def report(self) -> JointReport:
        """Joints whose overlap or gap was beyond the contact tolerance, with their parts and lengths."""
        return self.contacts.report

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.meshes)

    @property
    def immovable(self) -> NDArray[np.bool_]:
        """Parts that never move and that no robot holds, boundary and props; shape (parts,)."""
        mask = self.boundary.copy()
        mask[self.part_count - len(self.props) :] = True
        return mask

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(mesh.name for mesh in self.meshes)

    @property
    def identity(self) -> str:
        """Digest of everything that a verdict depends on: same digest, same structure; hexadecimal SHA-256.

        Taken over the corners of the faces, so that it does not depend on how vertices are numbered, nor on
        names.
        """
        digest = hashlib.sha256(b"falsework.assembly/1")
        for mesh in self.meshes:
            digest.update(np.int64(len(mesh.faces)).tobytes())
            digest.update((mesh.triangles + 0.0).astype("<f8").tobytes())
        digest.update(np.packbits(self.boundary).tobytes())
        digest.update(self.density.astype("<f8").tobytes())
        digest.update(np.array([self.friction], dtype="<f8").tobytes())
        # Only what differs from the defaults, so that a setting added later changes no identity.
        standard = asdict(ContactSettings())
        changed = {key: value for key, value in asdict(self.contact_settings).items() if value != standard[key]}
        digest.update(repr(sorted(changed.items())).encode())
        if self.contacts_given:
            given = self.contacts
            for array in (given.parts, given.frames, given.points, given.start, given.areas):
                digest.update((array + 0.0).astype("<f8").tobytes())
            if given.curved is not None:
                digest.update(b"curved" + (given.curved + 0.0).astype("<f8").tobytes())
            if given.lean is not None:
                digest.update(b"lean" + (given.lean + 0.0).astype("<f8").tobytes())
        if self.loads is not None:
            for array in (self.loads.wrench, self.loads.acceleration):
                digest.update(b"loads" + (array + 0.0).astype("<f8").tobytes())
        if self.props:
            digest.update(f"{len(self.props)} props".encode())
        if self.joints is not None:
            for array in self.joints.arrays:
                digest.update(b"joints" + np.nan_to_num(array + 0.0, nan=-1.0).astype("<f8").tobytes())
        return digest.hexdigest()

    def applied_wrench(self, gravity: float = 9.81) -> NDArray[np.float64]:
        """Return weight and loads on the parts, N and Nm about the centres of mass, shape (parts, 6).

        Args:
            gravity: m/s2 along -z.
        """
        loads = self.loads or Loads.from_arrays(self.part_count)
        return loads.applied(self.mass.mass, gravity)

    @cached_property
    def straight_ways(self) -> StraightWays:
        """Straight ways out of every part."""
        _, overlap = self.contact_settings.lengths(self.meshes)
        return StraightWays(self.meshes, self.contacts, tolerance=overlap)

    @property
    def clearance(self) -> ClearanceTable:
        """Exit directions of every part and their blockers."""
        return self.straight_ways.table

    @cached_property
    def clearance_of_sets(self) -> SetClearance:
        """Ways out of several parts that leave together; each is computed at first use."""
        _, overlap = self.contact_settings.lengths(self.meshes)
        return SetClearance(self.meshes, self.contacts, self.straight_ways, overlap)

    @cached_property
    def part_motions(self) -> PartMotions:
        """Swept tests of moves of the parts."""
        from falsework.geometry.paths.motions import PartMotions  # few structures need it

        _, overlap = self.contact_settings.lengths(self.meshes)
        return PartMotions(self.meshes, self.contacts, overlap)

    def replace(
        self,
        *,
        name: str | None = None,
        boundary: ArrayLike | None = None,
        density: ArrayLike | None = None,
        friction: float | None = None,
        loads: Loads | None = None,
        joints: Joints | None = None,
    ) -> Assembly:
        """Return the same parts with another name, boundary, density, friction, loads or joints; contacts are kept.

        Arguments are given as to `from_meshes`; None keeps what the structure has.

        Raises:
            AssemblyError: as `from_meshes`, or loads or joints of another structure.
        """
        fixed = self.boundary if boundary is None else _boundary(boundary, self.meshes)
        if not fixed.any():
            raise AssemblyError("no part is boundary, so nothing carries the structure; keep at least one fixed part")
        check_touching(self.meshes, fixed, self.contacts, self.contact_settings)
        densities = self.density if density is None else _density(density, self.part_count)
        changed = _replace(
            self,
            name=self.name if name is None else name,
            boundary=fixed,
            density=densities,
            friction=self.friction if friction is None else _friction(friction),
            mass=self.mass if density is None else mass_properties(self.meshes, densities),
            loads=self.loads if loads is None else _loads(loads, self.part_count),
            joints=self.joints if joints is None else _joints(joints, self.contacts),
        )
        read_only(fixed, densities)
        for name in ("straight_ways", "clearance_of_sets", "part_motions"):  # they depend on the meshes alone
            if name in self.__dict__:
                changed.__dict__[name] = self.__dict__[name]
        return changed

    def at_friction(self, friction: float) -> Assembly:
        """Return the structure at another coefficient of friction, those of its joints changed in proportion.

        In a structure whose own coefficient is zero, joints keep theirs.
        """
        joints, other = self.joints, _friction(friction)
        if joints is not None and self.friction > 0.0:
            joints = joints.scale_friction(other / self.friction)
        return _replace(self, friction=other, joints=joints)

    @property
    def has_common_friction(self) -> bool:
        """Whether `at_friction` changes every coefficient: joints have friction only if the structure has, too."""
        return self.friction > 0.0 or self.joints is None or not (self.joints.friction > 0.0).any()

    def with_ground(self) -> Assembly:
        """Return the same structure on a fixed slab under the lowest point, which becomes the last part.

        Raises:
            AssemblyError: given contacts, which know no ground, or joints of contacts that change with it.
        """
        grounded = Assembly.from_meshes(
            self.meshes,
            boundary=self.boundary,
            density=self.density,
            friction=self.friction,
            name=self.name,
            contact_settings=self.contact_settings,
            ground=True,
            contacts=self.contacts if self.contacts_given else None,
        )
        loads, joints = self.loads, self.joints
        if loads is not None:
            wrench = np.concatenate([loads.wrench, np.zeros((1, 6))])
            loads = Loads.from_arrays(len(wrench), wrench=wrench, acceleration=loads.acceleration)
        if joints is not None:
            joints = joints.with_more_parts(self.contacts, grounded.contacts, self.part_count)
        return _replace(grounded, loads=loads, joints=joints, settlement=self.settlement)


def _loads(given: Loads, parts: int) -> Loads:
    if len(given.wrench) != parts:
        raise AssemblyError(f"loads are of {len(given.wrench)} parts, but there are {parts}; make them anew")
    return given


def _joints(given: Joints, contacts: Contacts) -> Joints:
    if len(given.tension) != len(contacts.points):
        raise AssemblyError(
            f"joints are of {len(given.tension)} contact points, but there are {len(contacts.points)}; make them anew"
        )
    return given


def _friction(value: float) -> float:
    try:
        friction = float(value)
    except (TypeError, ValueError):
        raise AssemblyError(f"friction is {value!r}; give a number such as {FRICTION}") from None
    if not 0 <= friction <= MOST_FRICTION:
        raise AssemblyError(f"friction is {friction:g}; give a number from 0 to {MOST_FRICTION:g}, such as {FRICTION}")
    return friction


def _density(value: ArrayLike, parts: int) -> NDArray[np.float64]:
    try:
        density = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise AssemblyError(f"density is {value!r}; give one number in kg/m3, or one a part") from None
    if density.shape not in ((), (parts,)):
        raise AssemblyError(f"density has shape {density.shape}; give one number in kg/m3, or {parts}, one a part")
    density = np.array(np.broadcast_to(density, parts))
    wrong = ~((density >= 1 / MOST) & (density <= MOST))
    if wrong.any():
        part = int(np.argmax(wrong))
        raise AssemblyError(f"density of part {part} is {density[part]:g} kg/m3; give {1 / MOST:g} to {MOST:g}")
    return density


def _boundary(value: ArrayLike, meshes: Sequence[TriangleMesh]) -> NDArray[np.bool_]:
    parts = len(meshes)
    listed: list[Any] = list(value) if isinstance(value, (list, tuple)) else []
    if any(isinstance(item, str) for item in listed):
        value = part_ids(listed, [mesh.name for mesh in meshes], "boundary")
    given = np.asarray(None if any(isinstance(item, (list, tuple, dict)) for item in listed) else value)
    if given.dtype == bool:
        if given.shape != (parts,):
            raise AssemblyError(f"the boundary mask has shape {given.shape}; expected ({parts},), one a part")
        return given.copy()
    mask = np.zeros(parts, dtype=bool)
    if given.size == 0:
        return mask
    if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer):
        raise AssemblyError(f"boundary is {value!r}; give ids of parts, 0 to {parts - 1}, or names")
    for part in given.tolist():
        if not 0 <= part < parts:
            raise AssemblyError(f"boundary part {part} does not exist; ids of parts are 0 to {parts - 1}")
        if mask[part]:
            raise AssemblyError(f"boundary names part {part} twice; give every id once")
        mask[part] = True
    return mask
