"""Contacts between parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.arrays import segment_mean, segment_sum
from falsework.geometry.contact.contacts import Contacts
from falsework.geometry.contact.grouping import COPLANAR, curved_groups, planes
from falsework.geometry.contact.joints import JointReport, check_joints, find_joints, refuse_deep
from falsework.geometry.contact.narrow_phase import NARROW, ContactTolerances, Narrow, merged, narrow_places
from falsework.geometry.contact.overlap import Overlaps, find_overlaps
from falsework.geometry.contact.patches import Patches, face_patches, frames_of
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]

FLAT = 1e-5
"""Largest angle between the normals of surfaces and that of a contact which has one normal for all its points, radians:
a tenth of the residual that a stable state may have, as a share of gravity."""
_MORE = 1.02
"""Area of a joint, relative to that found within the tolerances, above which the latter is incomplete."""


@dataclass(frozen=True)
class ContactSettings:
    """Tolerances of contact detection and of the grouping into planes."""

    gap: float | None = None
    """Largest gap between faces that still touch, metres. None: 1/2000 of the median diagonal of the parts, or
    1/20 of the thickness of the thinnest if that is less."""
    overlap: float | None = None
    """Largest depth to which faces that touch may pass through each other, metres. None: as `gap`."""
    corner: float | None = None
    """Largest depth to which corners and edges may cut into another part, metres. None: 1/50 of the diagonal
    of the smaller part, or 1/5 of the thickness of the thinner one if that is less."""
    angle: float = 6.0
    """Largest angle between faces that touch, degrees."""
    curvature: float = 7.5
    """Largest angle between the normals of a curved interface that is treated as one plane, degrees."""

    def __post_init__(self) -> None:
        for name in ("gap", "overlap", "corner"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"contact tolerance {name} is {value} m; give a positive length or leave it out")
        for name in ("angle", "curvature"):
            if not 0 < getattr(self, name) < 45:
                raise InputError(f"contact tolerance {name} is {getattr(self, name)} degrees; give 0 to 45")

    def lengths(self, meshes: Sequence[TriangleMesh]) -> tuple[float, float]:
        """Return the gap and overlap in metres for these parts."""
        gap = default_gap(meshes) if self.gap is None else self.gap
        return gap, gap if self.overlap is None else self.overlap


def default_gap(meshes: Sequence[TriangleMesh]) -> float:
    """Return the gap that is bridged by default, metres: see `ContactSettings.gap`."""
    diagonal = np.median([np.linalg.norm(np.ptp(mesh.bounds, axis=0)) for mesh in meshes])
    return min(float(diagonal) / 2000, min(mesh.thickness for mesh in meshes) / 20)


def find_contacts(meshes: Sequence[TriangleMesh], settings: ContactSettings | None = None) -> Contacts:
    """Find the contacts between parts.

    Opposed faces within the tolerances are intersected; the patches of one pair of parts that lie in one
    plane become one contact, reduced to the corners of their common convex hull. Nothing is lost by that:
    a point of a patch is a convex combination of the corners, and the friction cone is convex and the same
    all over the plane, so a force at the point, shared out among the corners in the same proportions, stays
    in the cone and keeps its total force and moment. Nothing is gained either, since the corners are points
    of the patches.

    The interface of a pair with more than `grouping.CURVED_FROM` planes is taken as curved: neighbouring
    patches whose normals differ by at most `settings.curvature` from that of the largest among them become
    one contact, whose points are corners of patches with the normals of these patches. So all its forces are forces
    that the patches can transmit, but not the other way round: forces inside the contact are replaced by several at its
    rim. On a cylinder or a sphere that loses nothing but the width of facets.

    Where parts touch by a convex edge or corner alone, the contact is a line or a point: see `narrow_places`. One
    that lies in the hull of a planar contact of the same pair is an edge of that contact, and is left out; so is
    one where other parts lie against both sides of the edge. The same goes for planar contacts that are narrower than
    the default gap; others keep their width, down to `narrow_phase.NARROW` of it, where they become lines.

    Parts that overlap by more than the tolerance, and parts that touch nothing, are typical of models whose faces are
    warped, or triangulated differently on both sides. With default lengths, pairs of such parts are given a joint where
    `find_joints` finds faces that these rules refuse or leave out, and the parts meet or are as near as
    `JointSurfaces.near` says; its patches are grouped by `settings.curvature`. Given lengths are taken literally.

    Args:
        meshes: closed meshes that face outwards.

    Returns:
        Contacts sorted by their parts, of one pair planar ones first, then lines, then points; their order and
        points depend on the geometry alone, not on how faces are cut into triangles. A larger gap or overlap finds
        contacts of the same pairs of parts at least, as long as the lengths are given.

    Raises:
        AssemblyError: two parts pass through each other; names them and how deep.
    """
    settings = settings or ContactSettings()
    _, overlap = settings.lengths(meshes)
    overlaps = find_overlaps(meshes, overlap, corner=settings.corner)
    if not (settings.gap is None and settings.overlap is None):
        overlaps.raise_first(meshes, range(len(overlaps.parts)))
        return exact_contacts(meshes, settings)
    refuse_deep(meshes, overlaps)
    contacts = exact_contacts(meshes, settings)
    inexact = np.ones(len(meshes), dtype=bool)
    inexact[contacts.parts.ravel()] = False
    among = inexact[:, None] | inexact
    if overlaps.any_deeper(meshes):
        # Such a model is less exact than the tolerance elsewhere too: parts that touch may have larger contacts.
        inexact[overlaps.parts.ravel()] = True
        among = inexact[:, None] | inexact
        among[tuple(contacts.parts.T)] = True
    return _with_joints(meshes, contacts, overlaps, among, settings) if among.any() else contacts


def exact_contacts(meshes: Sequence[TriangleMesh], settings: ContactSettings) -> Contacts:
    """Find the contacts of `find_contacts` within the tolerances, without joints and without a check of overlaps."""
    gap, overlap = settings.lengths(meshes)
    # What counts as one place depends on the parts alone, so that a larger tolerance never finds less.
    near = default_gap(meshes)
    patches = face_patches(meshes, gap=gap, overlap=overlap, angle=settings.angle, least=near / 1000)
    group = planes(patches, COPLANAR, near)
    group = curved_groups(patches, group, settings.curvature, near)
    found, thin, slivers = _contacts(patches, group, near)
    contacts = _with_thin(found, thin, settings.angle, near)
    places = narrow_places(meshes, ContactTolerances(gap, overlap, settings.angle, near), slivers)
    if not len(places.parts):
        return contacts
    return _with_narrow(contacts, *merged(places, COPLANAR, near), settings.angle, near)


def _with_joints(
    meshes: Sequence[TriangleMesh],
    contacts: Contacts,
    overlaps: Overlaps,
    among: NDArray[np.bool_],
    settings: ContactSettings,
) -> Contacts:
    """Replace the contacts of pairs that overlap too much, or lack a part of their joint, by those of the joint."""
    tolerance = max(settings.lengths(meshes))
    joints = find_joints(meshes, among, settings.curvature, 2 * tolerance).without_far_sides(meshes, overlaps)
    first, second = overlaps.parts.T
    check_joints(meshes, overlaps, joints.bound[first, second])
    area = np.zeros((2, len(meshes), len(meshes)))
    np.add.at(area[0], tuple(joints.patches.parts.T), joints.patches.areas)
    np.add.at(area[1], tuple(contacts.parts.T), np.where(contacts.dimension == 2, contacts.areas, 0.0))
    chosen = (area[0] > _MORE * area[1]) & joints.near(tolerance)
    chosen[first, second] = joints.bound[first, second] > 0
    joints = joints.take(chosen[tuple(joints.patches.parts.T)])
    fitted, thin, _ = _contacts(joints.patches, joints.group, tolerance)
    fitted = _with_thin(fitted, thin, settings.angle, tolerance)
    both = contacts.take(np.flatnonzero(~chosen[tuple(contacts.parts.T)])).join(fitted)
    return replace(both.take(np.lexsort(both.parts.T[::-1])), report=JointReport.from_patches(joints.patches))


def _contacts(
    patches: Patches, group: NDArray[np.int64], tolerance: float
) -> tuple[Contacts, NDArray[np.bool_], Narrow]:
    """Return one contact a group of patches: mean frame, hull corners counter-clockwise.

    Also whether each is narrower than the tolerance, shape (contacts,), and the groups without a width.
    """
    count = int(group.max()) + 1 if len(group) else 0
    normals = segment_sum(patches.normals * patches.areas[:, None], group, count)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = segment_sum(patches.areas[:, None], group, count)[:, 0]
    parts = np.zeros((count, 2), dtype=np.int32)
    parts[group] = patches.parts
    frames = frames_of(normals)

    owner = group[patches.owner]
    origin = segment_mean(patches.points, owner, count)
    local = np.einsum("pij,pj->pi", frames[owner], patches.points - origin[owner])
    order = np.argsort(owner, kind="stable")
    clouds = shapely.multipoints(shapely.points(local[order][:, [1, 2, 0]]), indices=owner[order])
    hulls: Any = shapely.convex_hull(clouds)
    # Corners that stand out of the hull by rounding alone depend on the triangulation; simplify drops them. Where it is
    # to preserve topology, it leaves a fourth corner.
    simple = shapely.simplify(hulls, tolerance / 100, preserve_topology=False)
    hulls = np.where(shapely.is_empty(simple), hulls, simple)

    width = 2 * shapely.area(hulls) / np.maximum(shapely.length(hulls), 1e-300)
    keep = width >= NARROW * tolerance
    corners, hull = shapely.get_coordinates(hulls[keep], include_z=True, return_index=True)
    index = np.flatnonzero(keep)
    ring_end = np.append(hull[1:] != hull[:-1], True) if len(hull) else np.zeros(0, bool)
    corners, hull = corners[~ring_end], hull[~ring_end]
    middle = segment_mean(corners, hull, len(index))
    turn = np.arctan2(*(corners - middle[hull])[:, 1::-1].T)
    # Sorting by angle makes the hull counter-clockwise; the odd start keeps corners off the branch cut.
    turn = np.mod(turn + 0.7391, 2 * np.pi)
    position = origin[index][hull] + np.einsum("pji,pj->pi", frames[index][hull], corners[:, [2, 0, 1]])

    centre = np.round(segment_mean(position, hull, len(index)) / tolerance)
    rank = np.lexsort((*centre.T[::-1], parts[index, 1], parts[index, 0]))
    place = np.empty(len(index), dtype=np.int64)
    place[rank] = np.arange(len(index))
    order = np.lexsort((turn, place[hull]))
    sizes = np.bincount(place[hull], minlength=len(index))
    index = index[rank]
    arrays = (
        parts[index],
        np.ascontiguousarray(frames[index]),
        np.ascontiguousarray(position[order]),
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32),
        areas[index],
    )
    curved, lean = _own_surfaces(patches, group, frames, np.repeat(index, sizes), arrays[2], tolerance / 100)
    slivers = _slivers(hulls[~keep], NARROW * tolerance)
    rows = np.flatnonzero(~keep)
    ends = origin[rows, None] + np.einsum("pji,pkj->pki", frames[rows], slivers)
    extent = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    # A strip has one normal for all of its patches, so that those that differ from it are inclined by more.
    leans = np.zeros(count)
    away = np.linalg.norm(patches.normals - normals[group], axis=1)
    np.maximum.at(leans, group, patches.lean + np.where(away > FLAT, away, 0.0))
    narrow = Narrow(
        parts[rows], normals[rows], ends, extent, np.where(leans > FLAT, leans, 0.0)[rows], np.zeros((len(rows), 2))
    )
    return Contacts(*arrays, curved=curved, lean=lean), width[index] < tolerance, narrow


def _own_surfaces(
    patches: Patches, group: NDArray[np.int64], frames: Array, owner: NDArray[np.int64], points: Array, near: float
) -> tuple[Array | None, Array | None]:
    """Return the frame of each point with the normal of its own patch, and the angle between this and either face.

    A force at a point has to be one that the surface there can bear; the mean normal of the contact would let it lean
    by half the angle that the contact spans. Where patches of a contact meet in a point, the one that lets forces lean
    farthest counts, inclined most and with the least angle between its faces: together with the other points it spans
    those of the others.

    Args:
        patches: patches of all contacts.
        group: contact of each patch, shape (patches,).
        frames: of the contacts, shape (contacts, 3, 3).
        owner: contact of each point, shape (points,).
        points: corners of patches, shape (points, 3), metres.
        near: distance up to which a corner of a patch is the same point, metres.

    Returns:
        Shapes (points, 3, 3), None if all contacts are flat, and (points,), None if all faces are parallel.
    """
    inclined = np.linalg.norm(patches.normals - frames[group, 0], axis=1)
    bent, apart = np.zeros((2, len(frames)), dtype=bool)
    bent[group[inclined > FLAT]] = True
    apart[group[patches.lean > FLAT]] = True
    rows = np.flatnonzero((bent | apart)[owner])
    if not len(rows):
        return None, None
    from scipy.spatial import KDTree

    corners = np.flatnonzero((bent | apart)[group[patches.owner]])
    beside = KDTree(patches.points[corners]).query_ball_point(points[rows], near)
    # Equal inclinations come in all triangulations in the same order: by direction, not by rounding.
    reach = np.round(inclined, 6) - np.round(patches.lean, 6)
    rank = np.empty(len(reach), dtype=np.int64)
    rank[np.lexsort((*np.round(patches.normals, 6).T, reach))] = np.arange(len(reach))
    normals, lean = frames[owner, 0].copy(), np.zeros(len(owner))
    for row, found in zip(rows.tolist(), beside, strict=True):
        mine = patches.owner[corners[found]]
        mine = mine[group[mine] == owner[row]]
        chosen = mine[rank[mine].argmax()]
        normals[row], lean[row] = patches.normals[chosen], patches.lean[chosen]
    lean[lean <= FLAT] = 0.0
    # Where all contacts are flat, their normals are those of their patches to within `FLAT`.
    return frames_of(normals) if bent.any() else None, lean if lean.any() else None


def _with_thin(contacts: Contacts, thin: NDArray[np.bool_], angle: float, tolerance: float) -> Contacts:
    """Leave out the contacts narrower than the tolerance that others cover; see `_adds_nothing`."""
    wide, rows = contacts.take(np.flatnonzero(~thin)), np.flatnonzero(thin)
    if not len(wide) or not len(rows):
        return contacts
    ends = np.empty((len(rows), 2, 3))
    for place, row in enumerate(rows.tolist()):
        ends[place] = _farthest(contacts.points[contacts.start[row] : contacts.start[row + 1]])
    extent = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    places = Narrow(
        contacts.parts[rows], contacts.normals[rows], ends, extent, np.zeros(len(rows)), np.zeros((len(rows), 2))
    )
    covered = np.zeros(len(contacts), dtype=bool)
    covered[rows[_adds_nothing(wide, places, angle, tolerance)]] = True
    return contacts.take(np.flatnonzero(~covered))


def _slivers(hulls: NDArray, tolerance: float) -> Array:
    """Return the two points of each hull farthest apart, or twice its middle if it is a dot; shape (hulls, 2, 3)."""
    ends = np.zeros((len(hulls), 2, 3))
    for row, hull in enumerate(hulls):
        far = _farthest(shapely.get_coordinates(hull, include_z=True)[:, [2, 0, 1]])
        ends[row] = far if np.linalg.norm(far[1] - far[0]) > tolerance else far.mean(axis=0)
    return ends


def _farthest(points: Array) -> Array:
    """Return the two points farthest apart, shape (2, 3)."""
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    return points[list(np.unravel_index(apart.argmax(), apart.shape))]


def _with_narrow(
    contacts: Contacts, places: Narrow, normals: Array, lean: Array, angle: float, tolerance: float
) -> Contacts:
    """Add lines and points, with normals and leans at their ends as of `merged`, but for those inside an area."""
    if len(contacts):
        adds = ~_adds_nothing(contacts, places, angle, tolerance)
        places, normals, lean = places.take(adds), normals[adds], lean[adds]
    if not len(places.parts):
        return contacts
    lines = places.extent > 0
    counts = np.where(lines, 2, 1)
    each = np.stack([np.ones(len(lines), dtype=bool), lines], axis=1)
    bent = (np.linalg.norm(normals - places.normals[:, None], axis=2) > FLAT) & each
    narrow = Contacts(
        places.parts,
        frames_of(places.normals),
        places.ends[each],
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        np.where(lines, places.extent * tolerance, tolerance**2),
        curved=frames_of(normals[each]) if bent.any() else None,
        lean=lean[each] if lean[each].any() else None,
    )
    both = contacts.join(narrow)
    kind = np.concatenate([np.zeros(len(contacts)), np.where(lines, 1, 2)])
    middle = np.round(np.concatenate([np.zeros((len(contacts), 3)), places.ends.mean(axis=1)]) / tolerance)
    return both.take(np.lexsort((*middle.T[::-1], kind, *both.parts.T[::-1])))


def _adds_nothing(contacts: Contacts, places: Narrow, angle: float, tolerance: float) -> NDArray[np.bool_]:
    """Return whether planar contacts already cover each line or point, shape (places,).

    Those are edges of a contact of the same parts, and edges of one part with other parts against both sides (three
    for a point): stones that meet around a line fill all space there, and none of them protrudes.
    """
    first = contacts.start[:-1]
    low = np.minimum.reduceat(contacts.points, first) - tolerance
    high = np.maximum.reduceat(contacts.points, first) + tolerance
    probes = np.concatenate([places.ends, places.ends.mean(axis=1, keepdims=True)], axis=1)
    middle = probes[:, None, 2]
    row, near = np.nonzero(((low <= middle) & (high >= middle)).all(axis=2))
    of_part = (contacts.parts[near][:, :, None] == places.parts[row][:, None]).any(axis=1)
    row, near, of_part = row[of_part.any(axis=1)], near[of_part.any(axis=1)], of_part[of_part.any(axis=1)]

    owner = contacts.contact_of_point
    flat = np.einsum("pij,pj->pi", contacts.frames[owner], contacts.points - contacts.points[first][owner])
    hulls: Any = shapely.polygons(shapely.linearrings(flat[:, 1:], indices=owner))
    local = np.einsum("nij,nkj->nki", contacts.frames[near], probes[row] - contacts.points[first][near][:, None])
    away = shapely.distance(hulls[near][:, None], shapely.points(local[:, :, 1:]))
    # A contact that stands for a curved interface is not flat.
    deep = np.maximum.reduceat(np.abs(flat[:, 0]), first)[near, None] + 2 * tolerance
    held = (away <= tolerance) & (np.abs(local[:, :, 0]) <= deep)

    known = np.zeros(len(places.parts), dtype=bool)
    known[row[of_part.all(axis=1) & held.all(axis=1)]] = True
    limit = np.cos(np.radians(angle))
    for side in (0, 1):
        mine = np.flatnonzero(of_part[:, side] & held[:, 2] & ~known[row])
        for group in np.split(mine, np.flatnonzero(np.diff(row[mine])) + 1):
            part = places.parts[row[group], side, None]
            normals = contacts.normals[near[group]] * np.where(contacts.parts[near[group], :1] == part, 1.0, -1.0)
            apart = normals @ normals.T < limit
            sides = sum(bool(apart[one, :one].all()) for one in range(len(group)))
            known[row[group]] |= sides >= np.where(places.extent[row[group]] > 0, 2, 3)
    return known
