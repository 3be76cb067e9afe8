"""Stored interfaces of a file: contacts made of them, and their comparison with detected contacts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.touching import ContactWarning
from falsework.errors import AssemblyError
from falsework.geometry.contact.interfaces import Contacts, ContactSettings
from falsework.geometry.contact.patches import frames_of
from falsework.geometry.mesh.collision import Body
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.geometry.mesh.polygon import newell_normal
from falsework.utils.quantity import format_quantity, listed

Array = NDArray[np.float64]

_CLOSE = 0.05
"""Largest difference in area of interfaces that count as equal, as a share of the stored one."""


@dataclass(frozen=True, eq=False)
class StoredInterface:
    """Polygon along which two parts touch, or the two ends of a line, or a point, as a file has it."""

    parts: tuple[int, int]
    """Ids of the two; -1 for one that the file does not hold."""
    points: Array
    """Shape (corners, 3), metres."""
    normal: Array
    """Normal of its frame, either way, shape (3,); used where the points span no plane."""


@dataclass(frozen=True)
class InterfaceComparison:
    """Differences between stored interfaces and found contacts, pair by pair of parts."""

    stored: int
    """Pairs with stored interfaces."""
    found: int
    """Pairs with contacts that were found."""
    close: int
    """Pairs of both whose areas differ by at most 5 % of the stored one."""
    missing: tuple[tuple[int, int], ...]
    """Pairs with a stored interface that were not found."""
    extra: tuple[tuple[int, int], ...]
    """Pairs that were found without a stored interface."""
    differing: tuple[tuple[int, int, float], ...]
    """Pairs of both whose areas differ by more, with found over stored area; the worst first."""

    @property
    def both(self) -> int:
        """Pairs with a stored interface that were found."""
        return self.stored - len(self.missing)

    @property
    def agrees(self) -> bool:
        """Whether the same pairs touch, with the same areas."""
        return not (self.missing or self.extra or self.differing)

    def __str__(self) -> str:
        return (
            f"{self.both} of {self.stored} stored interfaces are found, {self.close} of them with an area within 5 %; "
            f"{len(self.extra)} pairs of parts touch without a stored one"
        )

    def to_dict(self) -> dict[str, object]:
        """Return plain JSON values."""
        return asdict(self)

    def warn(self, names: Sequence[str]) -> None:
        """Warn in one line if the two differ."""
        if self.agrees:
            return
        lists = (("not found", self.missing), ("not stored", self.extra), ("of other area", self.differing))
        said = [
            f"{word}: {listed([f'{names[pair[0]]} and {names[pair[1]]}' for pair in pairs])}"
            for word, pairs in lists
            if pairs
        ]
        warnings.warn(f"{self}; {'; '.join(said)}", ContactWarning, stacklevel=2)


def interface_contacts(meshes: Sequence[TriangleMesh], interfaces: Sequence[StoredInterface]) -> Contacts:
    """Make contacts of stored interfaces.

    Corners are reduced to those of the convex hull, as for contacts that are found: see `find_contacts`.

    Raises:
        AssemblyError: an interface that does not fit its parts: one that is farther from the surface of one than the
            thinner of the two is thick, or without an area, or of a part with itself; names the parts.
    """
    gap, overlap = ContactSettings().lengths(meshes)
    tolerance = max(gap, overlap)
    _check_fit(meshes, interfaces)
    parts, normals, corners, areas = [], [], [], []
    for interface in interfaces:
        a, b = sorted(interface.parts)
        points = _distinct(interface.points, 1e-3 * tolerance)
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        if len(points) > 2:
            normal = newell_normal(points)
            area = float(np.linalg.norm(normal))
            if area <= 1e-6 * size**2:
                raise AssemblyError(
                    f"the stored interface of parts {meshes[a].name} and {meshes[b].name} has no area; "
                    "find them instead (--interfaces found)"
                )
            points = _hull(points, normal / area)
        else:
            normal, area = interface.normal, size * tolerance if len(points) == 2 else tolerance**2
        normals.append(_outward(meshes[a], meshes[b], points, normal / np.linalg.norm(normal)))
        parts.append((a, b))
        corners.append(points)
        areas.append(area)
    middles = np.array([points.mean(axis=0) for points in corners])
    kind = np.array([min(len(points), 3) for points in corners])
    pairs = np.array(parts, dtype=np.int32)
    order = np.lexsort((*middles.T[::-1], -kind, pairs[:, 1], pairs[:, 0]))
    return Contacts(
        pairs[order],
        np.ascontiguousarray(frames_of(np.array(normals))[order]),
        np.concatenate([corners[index] for index in order]),
        np.concatenate([[0], np.cumsum([len(corners[index]) for index in order])]).astype(np.int32),
        np.array(areas)[order],
    )


def compare_interfaces(stored: Contacts, found: Contacts) -> InterfaceComparison:
    """Compare contacts of two sources, pair by pair of parts."""
    areas: tuple[dict[tuple[int, int], float], ...] = ({}, {})
    for contacts, area_of in zip((stored, found), areas, strict=True):
        for (a, b), area in zip(contacts.parts.tolist(), contacts.areas.tolist(), strict=True):
            area_of[a, b] = area_of.get((a, b), 0.0) + area
    before, now = areas
    extra = tuple(pair for pair in now if pair not in before)
    ratio = {pair: now[pair] / area for pair, area in before.items() if pair in now}
    differing = [(*pair, share) for pair, share in ratio.items() if abs(share - 1) > _CLOSE]
    return InterfaceComparison(
        stored=len(before),
        found=len(now),
        close=len(ratio) - len(differing),
        missing=tuple(pair for pair in before if pair not in now),
        extra=extra,
        differing=tuple(sorted(differing, key=lambda entry: -abs(entry[2] - 1))),
    )


def _check_fit(meshes: Sequence[TriangleMesh], interfaces: Sequence[StoredInterface]) -> None:
    """Raise for the interface that is farthest from one of its parts, in thicknesses of the thinner one."""
    points_of: dict[int, list[tuple[int, Array]]] = {}
    for number, interface in enumerate(interfaces):
        if min(interface.parts) < 0:
            raise AssemblyError("a stored interface is of a part that does not exist; find them (--interfaces found)")
        if interface.parts[0] == interface.parts[1]:
            raise AssemblyError(
                f"a stored interface joins part {meshes[interface.parts[0]].name} with itself; "
                "find them instead (--interfaces found)"
            )
        if not len(interface.points) or not np.isfinite(interface.points).all():
            raise AssemblyError("a stored interface has no corners; find them instead (--interfaces found)")
        for part in interface.parts:
            points_of.setdefault(part, []).append((number, interface.points))
    worst, where = 0.0, (0, 0, 0.0)
    for part, entries in points_of.items():
        surface = Body(meshes[part].vertices, meshes[part].faces)
        distance = surface.distances(np.concatenate([points for _, points in entries]))
        ends = np.cumsum([len(points) for _, points in entries])[:-1]
        for (number, _), far in zip(entries, np.split(distance, ends), strict=True):
            a, b = interfaces[number].parts
            share = float(far.max()) / min(meshes[a].thickness, meshes[b].thickness)
            if share > worst:
                worst, where = share, (number, part, float(far.max()))
    if worst > 1:
        number, part, far = where
        a, b = (meshes[index].name for index in interfaces[number].parts)
        raise AssemblyError(
            f"stored interfaces do not fit the parts: that of {a} and {b} is {format_quantity(far, 'length')} "
            f"away from "
            f"part {meshes[part].name}; find them instead (--interfaces found)"
        )


def _distinct(points: Array, tolerance: float) -> Array:
    """Drop corners that coincide with the one before them."""
    keep = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1) > tolerance
    return points[keep] if keep.any() else points[:1]


def _hull(points: Array, normal: Array) -> Array:
    """Return the corners of the convex hull of a polygon, counter-clockwise about its normal."""
    from scipy.spatial import ConvexHull

    flat = (points - points.mean(axis=0)) @ frames_of(normal[None])[0, 1:].T
    return points[ConvexHull(flat).vertices]


def _outward(a: TriangleMesh, b: TriangleMesh, points: Array, normal: Array) -> Array:
    """Turn the unit normal of an interface to lead from part `a` to part `b`, as their faces nearest to it do."""
    middle = points.mean(axis=0)
    side = float((_face_normal(a, middle, normal) - _face_normal(b, middle, normal)) @ normal)
    return normal if side >= 0 else -normal


def _face_normal(mesh: TriangleMesh, point: Array, along: Array) -> Array:
    """Return the unit normal of the face nearest to a point, of those that do not lie across the interface."""
    from trimesh.triangles import closest_point

    corners = mesh.triangles
    normals = triangle_normals(corners)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    gap = np.linalg.norm(closest_point(corners, np.broadcast_to(point, (len(corners), 3))) - point, axis=1)
    near = np.where(np.abs(normals @ along) > 0.5, gap, np.inf)
    return normals[int(np.argmin(near if np.isfinite(near).any() else gap))]
