"""Unchecked parts of a file, and the assembly made of them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.interfaces import StoredInterface, compare_interfaces, interface_contacts
from falsework.assembly.joints import Joints
from falsework.assembly.loads import GRAVITY, Loads
from falsework.assembly.model import DENSITY, FRICTION, Assembly
from falsework.assembly.store import support_names
from falsework.errors import AssemblyError, InputError, MeshError
from falsework.geometry.contact.interfaces import ContactSettings
from falsework.geometry.mesh.polygon import triangulate
from falsework.geometry.mesh.repair import check_mesh, thicken_supports

InterfaceSource = Literal["found", "stored", "compare"]
"""Contacts of an assembly: found from its meshes, those that its file stores, or the former, compared with the
latter."""


@dataclass(frozen=True, eq=False)
class Block:
    """Data of one part in a file."""

    name: str
    vertices: NDArray[np.float64]
    """Shape (vertices, 3), in the unit of the file."""
    faces: Sequence[Sequence[int]]
    """Polygons, counter-clockwise seen from outside."""
    support: bool = False
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Attributes of the part; `density` (kg/m3), `friction`, the `cohesion` and `tension` (Pa) of all contacts, `loads`
    (entries of `assembly.json` without the part, `at` in the unit of the file) and the `acceleration` of all parts
    (m/s2) are used."""
    key: Hashable = None
    """Name of the part by which interfaces of the file refer to it."""

    def triangles(self, scale: float) -> tuple[str, NDArray[np.float64], NDArray[np.int64]]:
        """Return the name, the vertices in metres, shape (vertices, 3), and triangles, shape (triangles, 3).

        Args:
            scale: length of the file's unit in metres.

        Raises:
            MeshError: no faces, or a face without its vertices.
        """
        faces: list[list[int]] = []
        for face in self.faces:
            if len(face) < 3 or min(face) < 0 or max(face) >= len(self.vertices):
                raise MeshError(f"part {self.name}: a face uses a vertex that does not exist; write the model again")
            corners = [[0, 1, 2]] if len(face) == 3 else triangulate(self.vertices[list(face)])
            faces.extend([face[corner] for corner in triangle] for triangle in corners)
        if not faces:
            raise MeshError(f"part {self.name} has no faces; leave it out of the model")
        return self.name, self.vertices * scale, np.array(faces, dtype=np.int64)


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

    @staticmethod
    def of(path: Path, scale: float, blocks: Sequence[Block], interfaces: Sequence[Mapping[str, Any]] = ()) -> Draft:
        """Name the parts and find those of each interface.

        Args:
            path: the file.
            scale: length of its unit in metres.
            blocks: parts; where names are not unique, numbers replace them.
            interfaces: each with `keys` of its two blocks, `points`, shape (corners, 3), in the unit of the file, and
                `normal`, shape (3,).
        """
        names = [block.name for block in blocks]
        if not all(names) or len(set(names)) < len(names):
            blocks = [replace(block, name=str(number)) for number, block in enumerate(blocks)]
        number_of = {block.key: number for number, block in enumerate(blocks) if block.key is not None}
        stored = []
        for interface in interfaces:
            one, two = (number_of.get(key, -1) for key in interface["keys"])
            try:
                points = np.array(interface["points"], dtype=float).reshape(-1, 3) * scale
            except (TypeError, ValueError):
                raise AssemblyError(f"{path}: an interface has corners that are no points; export it again") from None
            stored.append(StoredInterface((one, two), points, np.asarray(interface["normal"])))
        return Draft(path, scale, tuple(blocks), tuple(stored))

    def supports(self, boundary: ArrayLike | None) -> list[int]:
        """Return the fixed parts, as far as these exist.

        Args:
            boundary: as of `assemble`.
        """
        if boundary is None:
            return [number for number, block in enumerate(self.blocks) if block.support]
        named = support_names(boundary)
        return [number for number, block in enumerate(self.blocks) if number in named or block.name in named]

    def assemble(
        self,
        *,
        density: ArrayLike | None = None,
        friction: float | None = None,
        boundary: ArrayLike | None = None,
        ground: bool = False,
        contact_settings: ContactSettings | None = None,
        interfaces: InterfaceSource = "found",
    ) -> Assembly:
        """Check the parts and make an assembly of them.

        Args:
            density: kg/m3; that of the parts if all have one and none is given.
            friction: coefficient of friction of every contact; that of the parts if none is given.
            boundary: ids or names of the fixed parts; the supports if not given.
            ground: add a fixed slab under the lowest point, as the last part.
            contact_settings: tolerances.
            interfaces: source of the contacts; `compare` finds them and warns where the stored ones differ.

        Raises:
            InputError: stored interfaces are requested and there are none.
            MeshError: a part that does not bound a solid.
            AssemblyError: the parts make no assembly, or stored interfaces do not fit them.
        """
        if interfaces not in get_args(InterfaceSource):
            raise InputError(f"no source of interfaces {interfaces!r}; choose {', '.join(get_args(InterfaceSource))}")
        if interfaces != "found" and not self.interfaces:
            raise InputError(f"{self.path} stores no interfaces; leave out --interfaces {interfaces}")
        fixed = self.supports(boundary)
        solids = [block.triangles(self.scale) for block in self.blocks]
        meshes = tuple(check_mesh(*solid) for solid in thicken_supports(solids, fixed))
        numbers = [float(value) for value in self._values("density")]
        frictions = set(self._values("friction"))
        if friction is None and len(frictions) > 1:
            raise AssemblyError(f"{self.path} has blocks of different friction; give one for all with --friction")
        if boundary is None:
            boundary = fixed
        assembly = Assembly.from_meshes(
            meshes,
            boundary=boundary,
            density=density if density is not None else numbers if len(numbers) == len(meshes) else DENSITY,
            friction=next(iter(frictions), FRICTION) if friction is None else friction,
            name=self.path.stem,
            ground=ground,
            contact_settings=contact_settings or ContactSettings(),
            contacts=interface_contacts(meshes, self.interfaces) if interfaces == "stored" else None,
        )
        strength = {name: max(self._values(name), default=None) for name in ("cohesion", "tension")}
        assembly = assembly.replace(
            joints=Joints.throughout(assembly.contacts, **strength), loads=self._loads(assembly)
        )
        if interfaces == "compare":
            compare_interfaces(interface_contacts(meshes, self.interfaces), assembly.contacts).warn(assembly.names)
        return assembly

    def _loads(self, assembly: Assembly) -> Loads | None:
        """Return the loads of the blocks; None if they have none."""
        entries = []
        for number, block in enumerate(self.blocks):
            for load in block.attributes.get("loads", ()):
                place = {"at": (np.asarray(load["at"]) * self.scale).tolist()} if "at" in load else {}
                entries.append({"part": number, **load, **place})
        acting = Loads.read(entries, None, assembly.names, assembly.mass.center)
        pulled = np.array(next(block.attributes.get("acceleration") or (0, 0, 0) for block in self.blocks), dtype=float)
        if not pulled.any():
            return acting
        wrench = None if acting is None else acting.wrench
        return Loads.of(assembly.part_count, wrench=wrench, acceleration=pulled / GRAVITY)

    def _values(self, name: str) -> list[float]:
        """Return an attribute of the blocks that have it as a number."""
        values = [block.attributes.get(name) for block in self.blocks]
        return [value for value in values if isinstance(value, (int, float)) and not isinstance(value, bool)]
