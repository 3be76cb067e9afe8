"""Props: passive posts from the floor to the lower side of a part, which carry it without a robot.

A prop is a part of its own that never moves: it is present or absent, so results for states hold for it too.
Its head is a small square cut to the slope of the part's lower side, with a pad that does not slip up to 45 degrees. It
is a contact like any other: it pushes, and does not pull, within a cone of friction that is as wide as those of the
structure, turned upright as far as the pad permits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from dataclasses import replace as _replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.assembly_model import Prop
from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, States, complete_state
from falsework.errors import AssemblyError
from falsework.geometry.arrays import read_only
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.contact.patches import frames_of
from falsework.geometry.mesh.mesh import MassProperties, TriangleMesh, mass_properties, triangle_normals

Array = NDArray[np.float64]

_HEAD = 0.05
"""Side of a head, as a share of the diagonal of the part above."""
_GRID = 9
"""Places tried along each side of a part, seen from above."""
_FLAT = 1e-6
"""Largest deviation of the corners of a head from one plane, as a share of its side."""
_PAD = 1.0
"""Friction of the pad of a head, rubber on dry concrete: limits the steepest lower side that transmits a vertical
load."""
_DENSITY = 600.0
"""kg/m3: timber. A prop never moves, so nothing depends on it."""


@dataclass(frozen=True, eq=False)
class ProppedAssembly(Assembly):
    """Structure with places for props, which are found anew where it changes: heads depend on friction."""

    def replace(self, **changes: Any) -> Assembly:
        """As of `Assembly`."""
        return keep_props(super().replace(**changes), range(len(self.props)))

    def at_friction(self, friction: float) -> Assembly:
        """As of `Assembly`, but heads keep their axes, so that contacts count as given."""
        other = super().at_friction(friction)
        turned = bool(self.props) and other.friction != self.friction
        return _replace(other, contacts_given=self.contacts_given or turned)

    def with_ground(self) -> Assembly:
        """As of `Assembly`; the slab comes before the props."""
        if not self.props:
            return super().with_ground()
        return with_props(keep_props(self, ()).with_ground(), self.props)


def prop_places(assembly: Assembly) -> tuple[Prop, ...]:
    """Return a place for a prop under each part that has one, the nearest to below its centre of mass.

    The lower side must be flat there and at most 45 degrees steep, so that the prop can carry weight straight down, and
    the part below must be a fixed one: its floor.

    Raises:
        AssemblyError: no part has such a place.
    """
    columns = _Columns(assembly)
    heads = [columns.best(part)[0] for part in np.flatnonzero(~assembly.boundary).tolist()]
    found = tuple(head.prop for head in heads if head is not None)
    if not found:
        raise AssemblyError(
            "no part has a place for a prop: a prop stands upright on a fixed part, with nothing in between; "
            "put a floor under the structure (--ground)"
        )
    return found


def prop_place(assembly: Assembly, part: int) -> Prop:
    """Return the place for a prop under one part, as `prop_places` finds it."""
    name = assembly.names[part]
    if assembly.immovable[part]:
        raise AssemblyError(f"part {name} is fixed and needs no prop; name another part")
    head, wrong = _Columns(assembly).best(part)
    if head is None:
        raise AssemblyError(
            f"part {name} has no place for a prop: straight below its centre, it {wrong}; name another part, "
            "or put a floor under the structure (--ground)"
        )
    return head.prop


def with_props(assembly: Assembly, props: Sequence[Prop]) -> Assembly:
    """Return the structure with places for props as its last parts, which are present only in states that include them.

    Args:
        assembly: a structure without props.
        props: their places; the floors are recomputed.

    Raises:
        AssemblyError: a part that does not exist or is fixed, a head that is not on a flat lower side, or no floor
            under it.
    """
    if not props:
        return assembly
    columns, parts = _Columns(assembly), assembly.part_count
    heads = [columns.placed(prop) for prop in props]
    taken = set(assembly.names)
    meshes = []
    for number, head in enumerate(heads):
        name = f"prop-{assembly.names[head.prop.part]}"
        name = name if name not in taken else f"{name}-{number}"
        taken.add(name)
        meshes.append(head.mesh(name))
    mass = mass_properties(meshes, np.full(len(meshes), _DENSITY))
    joined = {key: np.concatenate([getattr(assembly.mass, key), getattr(mass, key)]) for key in vars(mass)}
    contacts = assembly.contacts
    pairs = np.array([[head.prop.part, parts + number] for number, head in enumerate(heads)], dtype=np.int32)
    both = contacts.join(
        Contacts(
            pairs,
            frames_of(np.array([head.axis for head in heads])),
            np.concatenate([head.corners for head in heads]),
            4 * np.arange(len(heads) + 1, dtype=np.int32),
            np.array([head.area for head in heads]),
        )
    )
    merged = both.take(np.lexsort(both.parts.T[::-1]))
    loads = assembly.loads
    if loads is not None:
        loads = _replace(loads, wrench=np.concatenate([loads.wrench, np.zeros((len(heads), 6))]))
    if not isinstance(assembly, ProppedAssembly):
        assembly = ProppedAssembly(**{field.name: getattr(assembly, field.name) for field in fields(assembly)})
    propped = _replace(
        assembly,
        meshes=(*assembly.meshes, *meshes),
        boundary=np.append(assembly.boundary, np.zeros(len(heads), dtype=bool)),
        density=np.append(assembly.density, np.full(len(heads), _DENSITY)),
        mass=MassProperties(**joined),
        contacts=merged,
        loads=loads,
        joints=None if assembly.joints is None else assembly.joints.with_more_parts(contacts, merged, parts),
        props=tuple(head.prop for head in heads),
    )
    read_only(propped.boundary, propped.density)
    return propped


def keep_props(assembly: Assembly, kept: Sequence[int]) -> Assembly:
    """Return a structure with only some of its props, by their numbers from 0."""
    if not assembly.props:
        return assembly
    bare = assembly.part_count - len(assembly.props)
    stays = np.asarray((assembly.contacts.parts < bare).all(axis=1))
    contacts = assembly.contacts
    loads, joints = assembly.loads, assembly.joints
    plain = _replace(
        assembly,
        meshes=assembly.meshes[:bare],
        boundary=assembly.boundary[:bare],
        density=assembly.density[:bare],
        mass=MassProperties(**{key: value[:bare] for key, value in vars(assembly.mass).items()}),
        contacts=contacts.take(np.flatnonzero(stays)),
        loads=None if loads is None else _replace(loads, wrench=loads.wrench[:bare]),
        joints=None if joints is None else joints.of_points(stays[contacts.contact_of_point]),
        props=(),
    )
    return with_props(plain, [assembly.props[k] for k in kept])


def whole_state(assembly: Assembly) -> States:
    """Return the state of the complete structure, without its props; shape (parts,)."""
    state = complete_state(assembly.boundary)
    state[assembly.part_count - len(assembly.props) :] = REMOVED
    return state


def without_props(state: ArrayLike | None, assembly: Assembly) -> ArrayLike | None:
    """Return a state with its props absent, where it was given without any."""
    if state is None or not assembly.props or np.shape(state) != (assembly.part_count - len(assembly.props),):
        return state
    return np.append(np.asarray(state), np.zeros(len(assembly.props), dtype=np.uint8))


@dataclass(frozen=True, eq=False)
class _Head:
    """Head of a prop: a square seen from above, in the plane of the lower side of its part."""

    prop: Prop
    corners: Array
    """Shape (4, 3), m, counter-clockwise from above."""
    axis: Array
    """Axis of the cone of friction, out of the part, downwards."""

    @property
    def area(self) -> float:
        """Area in the plane of the lower side, m2."""
        first, second, _, last = self.corners
        return float(np.linalg.norm(np.cross(second - first, last - first)))

    def mesh(self, name: str) -> TriangleMesh:
        """Return the prop as a post below its head."""
        foot = np.column_stack([self.corners[:, :2], np.full(4, self.prop.floor)])
        faces = [(4, 5, 6), (4, 6, 7), (0, 2, 1), (0, 3, 2)]
        for k in range(4):
            n = (k + 1) % 4
            faces += [(k, n, 4 + n), (k, 4 + n, 4 + k)]
        return TriangleMesh.from_arrays(name, np.concatenate([foot, self.corners]), faces)


def _upright(normal: Array, most: float) -> Array:
    """Turn the downward normal of a lower side towards straight down, by at most so many radians."""
    slope = float(np.hypot(*normal[:2]))
    steep = max(np.arctan2(slope, -normal[2]) - max(float(most), 0.0), 0.0)
    return np.array([0.0, 0.0, -1.0]) if steep == 0.0 else np.append(normal[:2] / slope * np.sin(steep), -np.cos(steep))


class _Columns:
    """Vertical lines through the parts of a structure."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        self._triangles = np.concatenate([mesh.triangles for mesh in assembly.meshes])
        self._part = np.repeat(np.arange(assembly.part_count), [len(mesh.faces) for mesh in assembly.meshes])
        self._normal = triangle_normals(self._triangles)
        self._low, self._high = self._triangles[:, :, :2].min(axis=1), self._triangles[:, :, :2].max(axis=1)

    def best(self, part: int) -> tuple[_Head | None, str]:
        """Return the head of a prop under a part, the nearest to below its centre of mass.

        If there is none: why, for the place below the centre of mass.
        """
        low, high = self._assembly.meshes[part].bounds
        share = (np.arange(_GRID) + 0.5) / _GRID
        x, y = np.meshgrid(low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1]))
        center = self._assembly.mass.center[part, :2]
        places = np.vstack([center, np.column_stack([x.ravel(), y.ravel()])])
        why = ""
        for place in places[np.argsort(np.linalg.norm(places - center, axis=1), kind="stable")]:
            head, wrong = self.head(part, place)
            if head is not None:
                return head, ""
            why = why or wrong
        return None, why

    def placed(self, prop: Prop) -> _Head:
        """Return the head of a requested prop."""
        assembly = self._assembly
        if not 0 <= prop.part < assembly.part_count:
            last = assembly.part_count - 1
            raise AssemblyError(f"a prop stands under part {prop.part}, but parts are numbered 0 to {last}")
        name = assembly.names[prop.part]
        if assembly.boundary[prop.part]:
            raise AssemblyError(f"a prop stands under part {name}, which is fixed; leave it out")
        head, wrong = self.head(prop.part, np.asarray(prop.at[:2]))
        if head is None:
            raise AssemblyError(f"the prop under part {name} {wrong}; move it, or put a floor there (--ground)")
        if abs(head.prop.at[2] - prop.at[2]) > 1e-3 * max(abs(prop.at[2] - prop.floor), 1e-6):
            raise AssemblyError(f"the prop under part {name} ends off its lower side; give its height there")
        return head

    def head(self, part: int, place: Array) -> tuple[_Head | None, str]:
        """Return the head of a prop under a part at a place seen from above, or None and why there is none.

        Args:
            place: x and y, m.
        """
        assembly = self._assembly
        side = _HEAD * float(np.linalg.norm(np.ptp(assembly.meshes[part].bounds, axis=0)))
        offsets = 0.5 * side * np.array([[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]])
        points, normals, floors = [], [], []
        for x, y in place + offsets:
            hits = self._hits(x, y)
            own = [hit for hit in hits if hit[1] == part and hit[2][2] < 0]
            if not own:
                return None, "is not below it"
            z, _, normal = own[0]
            below = [hit for hit in hits if hit[0] <= z + 0.5 * side and hit[1] != part and hit[2][2] > 0]
            if not below or not assembly.boundary[below[-1][1]]:
                return None, "has no floor under it"
            points.append((x, y, z))
            normals.append(normal / np.linalg.norm(normal))
            floors.append(below[-1][0])
        corners, normal = np.array(points[1:]), normals[0]
        off = np.abs((corners - points[0]) @ normal).max()
        if off > max(_FLAT * side, 1e-9) or np.hypot(*normal[:2]) > _PAD * -normal[2]:
            return None, "has no flat lower side of at most 45 degrees above it"
        if points[0][2] - max(floors) < side:
            return None, "has no room above its floor"
        axis = _upright(normal, np.arctan(_PAD) - np.arctan(assembly.friction))
        x, y, z = (float(value) for value in points[0])
        return _Head(Prop(part, (x, y, z), float(min(floors))), corners, axis), ""

    def _hits(self, x: float, y: float) -> list[tuple[float, int, Array]]:
        """Return height, part and normal where a vertical line meets faces, from below."""
        near = np.flatnonzero(((self._low <= (x, y)) & (self._high >= (x, y))).all(axis=1))
        a, b, c = (self._triangles[near, k] - (x, y, 0.0) for k in range(3))
        u, v, w = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b)))
        whole = u + v + w  # twice the area seen from above, negative for lower sides
        inside = (whole != 0) & ((u * whole >= 0) & (v * whole >= 0) & (w * whole >= 0))
        near, a, b, c, u, v, w, whole = (row[inside] for row in (near, a, b, c, u, v, w, whole))
        heights = (u * a[:, 2] + v * b[:, 2] + w * c[:, 2]) / whole
        order = np.argsort(heights, kind="stable")
        return [(float(heights[k]), int(self._part[near[k]]), self._normal[near[k]]) for k in order]
