"""Unchecked parts of a file, and the assembly made of them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.interfaces import StoredInterface, compare_interfaces, interface_contacts
from falsework.assembly.joints import Joints
from falsework.assembly.loads import GRAVITY, Loads
from falsework.assembly.model import DENSITY, FRICTION, Assembly
from falsework.assembly.part_numbers import boundary_ids
from falsework.errors import AssemblyError, InputError, MeshError
from falsework.geometry.contact.interfaces import ContactSettings
from falsework.geometry.mesh.polygon import triangles_of
from falsework.geometry.mesh.read import read_surfaces, unit_length
from falsework.geometry.mesh.repair import check_meshes, thicken_supports
from falsework.geometry.mesh.surface import distinct_names, warn_of
from falsework.geometry.settling.fits import settled_if_loose
from falsework.utils.quantity import is_number, listed

InterfaceSource = Literal["found", "stored", "compare"]
"""Contacts of an assembly: found from its meshes, those that its file stores, or the former, compared with the
latter."""


@dataclass(frozen=True, eq=False)
class Block:
    """Data of one part in a file."""

    name: str
    vertices: NDArray[np.float64]
    """Shape (vertices, 3), in the unit of the file."""
    faces: Sequence[Sequence[int]] | NDArray[np.int64]
    """Polygons, counter-clockwise seen from outside; triangles if it is an array."""
    support: bool = False
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Attributes of the part; `density` (kg/m3), `friction`, the `cohesion` and `tension` (Pa) of all contacts, `loads`
    (entries of `assembly.json` without the part, `at` in the unit of the file) and the `acceleration` of all parts
    (m/s2) are used."""
    key: Hashable = None
    """Name of the part by which interfaces of the file refer to it."""
    error: str = ""
    """Why the part cannot be read."""

    def triangles(self, scale: float) -> tuple[str, NDArray[np.float64], NDArray[np.int64]]:
        """Return the name, the vertices in metres, shape (vertices, 3), and triangles, shape (triangles, 3).

        Args:
            scale: length of the file's unit in metres.
        """
        if self.error:
            raise MeshError(self.error)
        if isinstance(self.faces, np.ndarray):
            return self.name, self.vertices * scale, self.faces
        if not self.faces:
            raise MeshError(f"part {self.name} has no faces; make a mesh that encloses space of it")
        if min(map(len, self.faces)) < 3:
            raise MeshError(f"part {self.name}: a face has fewer than three corners; write the model again")
        return self.name, self.vertices * scale, triangles_of(f"part {self.name}", self.vertices, self.faces)


@dataclass(frozen=True, eq=False)
class Draft:
    """Unchecked parts and interfaces of a file."""

    path: Path
    scale: float
    """Length of the file's unit in metres."""
    blocks: tuple[Block, ...]
    """At least one, with different names."""
    interfaces: tuple[StoredInterface, ...] = ()
    """In metres."""
    fits: bool = False
    """Whether its format is one of models with clearance, whose parts settle if they do not rest as modelled."""
    says_unit: bool = True
    """Whether the file, or who read it, says the unit."""
    name: str = ""
    """Name of the structure, if the file gives one."""

    @staticmethod
    def from_blocks(
        path: Path, scale: float, blocks: Sequence[Block], interfaces: Sequence[Mapping[str, Any]] = ()
    ) -> Draft:
        """Name the parts and find those of each interface.

        Args:
            scale: length of its unit in metres.
            blocks: parts; names that several have are told apart by numbers behind them, see `distinct_names`.
            interfaces: each with `keys` of its two blocks, `points`, shape (corners, 3), in the unit of the file, and
                `normal`, shape (3,).
        """
        names = distinct_names(path, [block.name for block in blocks])
        blocks = [replace(block, name=name) for block, name in zip(blocks, names, strict=True)]
        number_of = {block.key: number for number, block in enumerate(blocks) if block.key is not None}
        stored = []
        for interface in interfaces:
            one, two = (number_of.get(key, -1) for key in interface["keys"])
            points = np.array(interface["points"], dtype=np.float64).reshape(-1, 3) * scale
            stored.append(StoredInterface((one, two), points, np.asarray(interface["normal"])))
        return Draft(path, scale, tuple(blocks), tuple(stored))

    @staticmethod
    def from_meshes(path: Path, unit: str | None = None) -> Draft:
        """Read the parts of a folder or file of meshes, unchecked.

        Args:
            unit: unit of the coordinates; that which comments of the files name, or metres if not given.
        """
        if unit is not None:
            unit_length(unit)
        surfaces = read_surfaces(path)
        stated = sorted({surface.unit for surface in surfaces if surface.unit})
        if unit is None and len(stated) > 1:
            raise InputError(
                f"comments in {path} name the units {listed(stated)}; give the one of all, such as --unit mm"
            )
        if stated and stated != [unit or "m"]:
            read = f"it was read in {unit}" if unit else "it was read so"
            warn_of(path, f"comments say that the unit is {listed(stated)}; {read}")
        scale = unit_length(unit or (stated or ["m"])[0])
        blocks = [
            Block(
                surface.name,
                surface.vertices,
                surface.faces,
                surface.support,
                {name: value for name in ("density", "friction") if (value := getattr(surface, name)) is not None},
                error=surface.error,
            )
            for surface in surfaces
        ]
        name = next((surface.structure for surface in surfaces if surface.structure), "")
        return Draft(path, scale, tuple(blocks), says_unit=unit is not None or bool(stated), name=name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts."""
        return tuple(block.name for block in self.blocks)

    def renamed(self, names: Sequence[str]) -> Draft:
        """Return the same parts with other names, one for each."""
        blocks = (replace(block, name=name) for block, name in zip(self.blocks, names, strict=True))
        return replace(self, blocks=tuple(blocks))

    def supports(self, boundary: ArrayLike | None) -> list[int]:
        """Return the fixed parts, as far as these exist."""
        if boundary is None:
            return [number for number, block in enumerate(self.blocks) if block.support]
        return sorted(set(boundary_ids(boundary, self.names)))

    def assemble(
        self,
        *,
        density: ArrayLike | None = None,
        friction: float | None = None,
        boundary: ArrayLike | None = None,
        ground: bool = False,
        contact_settings: ContactSettings | None = None,
        interfaces: InterfaceSource = "found",
        name: str | None = None,
        settle: float | None = None,
    ) -> Assembly:
        """Check the parts and make an assembly of them.

        Args:
            density: kg/m3; that of the parts if none is given.
            friction: coefficient of friction of every contact; that of the parts if none is given.
            boundary: ids or names of the fixed parts; the supports if not given.
            ground: add a fixed slab under the lowest point, as the last part. It is added with a warning where neither
                a boundary is given nor a part is a support.
            interfaces: source of the contacts; `compare` finds them and warns where the stored ones differ.
            name: that of the file if none is given, and without one that of its path.
            settle: as for `Assembly.from_meshes`. If not given, parts of a file in which nothing is fixed, or whose
                format has fits, settle with a warning if they do not rest where they are.
        """
        if interfaces not in get_args(InterfaceSource):
            raise InputError(f"no source of interfaces {interfaces!r}; choose {', '.join(get_args(InterfaceSource))}")
        if interfaces != "found" and not self.interfaces:
            raise InputError(f"{self.path} stores no interfaces; leave out --interfaces {interfaces}")
        fixed = self.supports(boundary)
        solids = [block.triangles(self.scale) for block in self.blocks]
        meshes = check_meshes(thicken_supports(solids, fixed))
        frictions = set(self._values("friction"))
        if friction is None and len(frictions) > 1:
            raise AssemblyError(f"{self.path} has blocks of different friction; give one for all with --friction")
        unsaid = boundary is None and not fixed and not ground and interfaces != "stored"
        if unsaid:
            warn_of(self.path, "no part is fixed, so a ground was added under the lowest point, as the last part")
        make = partial(
            Assembly.from_meshes,
            meshes,
            boundary=fixed if boundary is None else boundary,
            density=self._density() if density is None else density,
            friction=next(iter(frictions), FRICTION) if friction is None else friction,
            name=name or self.name.strip() or (self.path.resolve().name if self.path.is_dir() else self.path.stem),
            ground=ground or unsaid,
            contact_settings=contact_settings or ContactSettings(),
            contacts=interface_contacts(meshes, self.interfaces) if interfaces == "stored" else None,
        )
        if settle is None and (unsaid or self.fits):
            assembly = settled_if_loose(lambda length: make(settle=length), meshes, self.path)
        else:
            assembly = make(settle=settle)
        strength = {name: max(self._values(name), default=None) for name in ("cohesion", "tension")}
        assembly = assembly.replace(
            joints=Joints.from_uniform(assembly.contacts, **strength), loads=self._loads(assembly)
        )
        if interfaces == "compare":
            compare_interfaces(interface_contacts(meshes, self.interfaces), assembly.contacts).warn(assembly.names)
        return assembly

    def _density(self) -> list[float]:
        """Return the density of each part, the default where the file has none."""
        lacking = [block.name for block in self.blocks if not is_number(block.attributes.get("density"))]
        if 0 < len(lacking) < len(self.blocks):
            warn_of(self.path, f"parts without a density were given {DENSITY:g} kg/m3: {listed(lacking)}")
        given = [block.attributes.get("density") for block in self.blocks]
        return [float(value) if is_number(value) else DENSITY for value in given]

    def _loads(self, assembly: Assembly) -> Loads | None:
        """Return the loads of the blocks; None if they have none."""
        entries = []
        for number, block in enumerate(self.blocks):
            for load in block.attributes.get("loads", ()):
                place = {"at": (np.asarray(load["at"]) * self.scale).tolist()} if "at" in load else {}
                entries.append({"part": number, **load, **place})
        acting = Loads.from_entries(entries, None, assembly.names, assembly.mass.center)
        pulled = np.array(next(block.attributes.get("acceleration") or (0, 0, 0) for block in self.blocks), dtype=float)
        if not pulled.any():
            return acting
        wrench = None if acting is None else acting.wrench
        return Loads.from_arrays(assembly.part_count, wrench=wrench, acceleration=pulled / GRAVITY)

    def _values(self, name: str) -> list[float]:
        """Return an attribute of the blocks that have it as a number."""
        values = [block.attributes.get(name) for block in self.blocks]
        return [value for value in values if is_number(value)]
