"""Line and point contacts: edges and corners on faces, and edges across edges.

The rules are the counterpart of those for faces. A face that is nearer to parallel with the other than the largest
angle between faces that touch makes a patch; so an edge counts only where both of its faces rise more steeply from
the plane that it lies in, and a corner only where all its edges do. No place is thus found twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import Rows
from falsework.geometry.contact.creases import Creases, Surface, expand, rises
from falsework.geometry.mesh.boxes import crossing_boxes, pairs_of_groups
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CHUNK = 200_000
"""Pairs of faces, or pieces and edges, that are compared at once; bounds the memory of very fine meshes."""
NARROW = 1e-2
"""Width up to which a strip is a line, and distance from an edge of a face up to which a point on the face is on its
edge, as a share of the default gap: 5e-6 of the diagonal of a typical part, just above the rounding of coordinates that
are written with six digits."""


@dataclass(frozen=True, eq=False)
class Narrow(Rows):
    """Line and point contacts between two parts, one row each."""

    parts: NDArray[np.int32]
    """Part `a` and part `b`, `a < b`, shape (places, 2)."""
    normals: Array
    """From `a` to `b`, unit length, shape (places, 3)."""
    ends: Array
    """Both ends of a line, the same point twice otherwise; midway between the parts; shape (places, 2, 3), metres."""
    extent: Array
    """Length that touches, zero for a point, shape (places,), metres."""
    lean: Array
    """Largest angle between the normal and those of the surfaces that have one, shape (places,), radians."""
    gaps: Array
    """Distance of the parts at both ends, along the normal, negative where they overlap, shape (places, 2), metres."""

    @staticmethod
    def none() -> Narrow:
        """Return no places."""
        numbers, pairs = np.zeros(0), np.zeros((0, 2))
        return Narrow(pairs.astype(np.int32), np.zeros((0, 3)), np.zeros((0, 2, 3)), numbers, numbers, pairs)


@dataclass(frozen=True)
class ContactTolerances:
    """Tolerances of contact, metres and degrees; as `face_patches`."""

    gap: float
    overlap: float
    angle: float
    tolerance: float
    """Distance up to which places are one: the default gap, whatever gap and overlap are."""

    @property
    def reach(self) -> float:
        """Largest distance between parts that touch."""
        return max(self.gap, self.overlap)

    @property
    def sine(self) -> float:
        """Sine of the angle."""
        return float(np.sin(np.radians(self.angle)))


def narrow_places(meshes: Sequence[TriangleMesh], limits: ContactTolerances, slivers: Narrow) -> Narrow:
    """Find edges on faces, corners on faces, and edges across edges.

    An edge on a face is a line with the normal of the face; so is a strip of two faces that is too narrow for an
    area, if it does not run along the rim of both. A corner on a face is a point with its normal, and two edges that
    cross are one whose normal is square to both. On the rim of a face, where its outline is convex, the
    normal is not defined, and nothing is found.

    Args:
        meshes: closed meshes that face outwards.
        limits: tolerances of the model.
        slivers: strips of opposed faces that are narrower than the tolerance.

    Returns:
        Pieces of lines, which may adjoin, and points, some of which may occur twice.
    """
    surface = Surface.from_meshes(meshes)
    every = Creases.from_surface(surface, 0.1)
    # Both faces have to rise by more than the angle, so that less of a turn than twice the angle is no edge.
    sharp = every.take(every.turn > np.radians(2 * limits.angle))
    rims = every.take(every.turn > np.radians(limits.angle))
    found = [slivers.take(_inside_a_rim(slivers, every, limits))]
    corners = surface.corners
    vertices, first = np.unique(surface.faces.ravel(), return_index=True)
    of_face = _groups(sharp.face, np.arange(len(sharp.face)), len(corners))
    tips = _groups(first // 3, vertices, len(corners))
    for i, j in _near_faces(corners, surface.part, limits.reach):
        row, edge = _members(of_face, i)
        found.append(_edges_on_faces(surface, sharp, rims, edge, j[row], limits))
        row, vertex = _members(tips, i)
        found.append(_corners_on_faces(surface, rims, vertex, j[row], surface.part[i[row]], limits))
        once = i < j
        row, one = _members(of_face, i[once])
        again, two = _members(of_face, j[once][row])
        found.append(_crossings(sharp, one[again], two, limits))
    return Narrow.join(found)


def _groups(owner: Index, member: Index, count: int) -> tuple[Index, Index]:
    """Return members sorted by owner, and where those of each owner start; shapes (count + 1,) and (members,)."""
    order = np.argsort(owner, kind="stable")
    return np.searchsorted(owner[order], np.arange(count + 1)), member[order]


def _members(groups: tuple[Index, Index], chosen: Index) -> tuple[Index, Index]:
    """Return the members of the chosen faces: the place in `chosen`, and the member."""
    start, member = groups
    row, place = expand(start[chosen], start[chosen + 1])
    return row, member[place]


def _near_faces(corners: Array, part: NDArray[np.int32], reach: float) -> Iterator[tuple[Index, Index]]:
    """Yield chunks of pairs of faces of different parts whose boxes are within `reach`, each pair both ways round."""
    boxes = np.stack([corners.min(axis=1), corners.max(axis=1)])
    for i, j in pairs_of_groups(boxes, boxes + np.array([-reach, reach])[:, None, None], part):
        for chunk in range(0, len(i), _CHUNK // 2):
            one, two = i[chunk : chunk + _CHUNK // 2], j[chunk : chunk + _CHUNK // 2]
            yield np.concatenate([one, two]), np.concatenate([two, one])


def _ordered(first: NDArray[np.int32], second: NDArray[np.int32], normals: Array) -> tuple[NDArray[np.int32], Array]:
    """Return pairs of parts, the lower one first, and normals that pointed from the first to the second."""
    parts = np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1)
    return parts, normals * np.where(first < second, 1.0, -1.0)[:, None]


def merged(found: Narrow, coplanar: float, tolerance: float) -> tuple[Narrow, Array, Array]:
    """Join pieces of one line, and points at one place, that have the same normal; leave out what is too short.

    The longest piece that is left of a pair of parts collects those within `coplanar` degrees and `tolerance` metres.
    A point between two pieces of a line is a convex combination of points that touch, so that their outer ends stand
    for all of it.

    Returns:
        The places with the mean normal of their pieces; and at both ends the normals, shape (places, 2, 3), and the
        angles between these and the surfaces, shape (places, 2).
    """
    middle = np.round(found.ends.mean(axis=1) / tolerance)
    size = np.round(found.extent / tolerance)
    found = found.take(np.lexsort((*middle.T[::-1], -size, found.extent == 0, *found.parts.T[::-1])))
    limit = np.cos(np.radians(coplanar))
    pairs = np.flatnonzero(np.append(True, (found.parts[1:] != found.parts[:-1]).any(axis=1)))
    out, outer, leans = [found.take(np.zeros(0, np.int64))], [np.zeros((0, 2, 3))], [np.zeros((0, 2))]
    for rest in np.split(np.arange(len(found.parts)), pairs[1:]) if len(found.parts) else []:
        while len(rest):
            start, along = found.ends[rest[0], 0], found.ends[rest[0], 1] - found.ends[rest[0], 0]
            along = along / max(float(np.linalg.norm(along)), 1e-300)
            arms = found.ends[rest] - start
            times = arms @ along
            near = np.linalg.norm(arms - times[:, :, None] * along, axis=2).max(axis=1) <= tolerance
            near &= found.normals[rest] @ found.normals[rest[0]] >= limit
            near &= (found.extent[rest] > 0) == (found.extent[rest[0]] > 0)
            near[0] = True
            one, times = rest[near], times[near]
            far = np.array([times.argmin(), times.argmax()])
            ends, normals = found.ends[one].reshape(-1, 3)[far], found.normals[one[far // 2]]
            extent = min(float(found.extent[one].sum()), float(np.ptp(times)))
            normal = np.average(found.normals[one], axis=0, weights=np.maximum(found.extent[one], 1e-300))
            normal /= np.linalg.norm(normal)
            # From the lower end in x, then y, then z, whichever way the edge ran.
            order = np.lexsort(np.round(ends / tolerance).T[::-1])
            if extent >= tolerance or found.extent[one[0]] == 0:
                lean = found.lean[one[far // 2]][order]
                whole = np.array([extent]), np.array([lean.max()])
                gaps = found.gaps[one].ravel()[far][order]
                out.append(Narrow(found.parts[one[:1]], normal[None], ends[None, order], *whole, gaps[None]))
                outer.append(normals[None, order])
                leans.append(lean[None])
            rest = rest[~near]
    return Narrow.join(out), np.concatenate(outer), np.concatenate(leans)


def _edges_on_faces(
    surface: Surface, sharp: Creases, rims: Creases, edge: Index, face: Index, limits: ContactTolerances
) -> Narrow:
    """Return pieces of edges that lie on faces, away from their rims."""
    normal = surface.normals[face]
    keep = (np.einsum("eki,ei->ek", sharp.into[edge], normal) > limits.sine).all(axis=1)
    keep &= np.abs(np.einsum("ei,ei->e", sharp.along[edge], normal)) <= limits.sine
    edge, face, normal = edge[keep], face[keep], normal[keep]
    tail, arm = sharp.tail[edge], sharp.along[edge] * sharp.length[edge, None]
    corners = surface.corners[face] if len(face) else np.zeros((0, 3, 3))
    start, stop = np.zeros(len(edge)), np.ones(len(edge))
    low = np.einsum("ei,ei->e", tail - corners[:, 0], normal)
    climb = np.einsum("ei,ei->e", arm, normal)
    _clip(start, stop, low + limits.overlap, climb)
    _clip(start, stop, limits.gap - low, -climb)
    for corner, inwards in _sides(corners, normal):
        level = np.einsum("ei,ei->e", tail - corner, inwards)
        _clip(start, stop, level + 1e-6 * limits.tolerance, np.einsum("ei,ei->e", arm, inwards))
    extent = (stop - start) * sharp.length[edge]
    keep = extent > 1e-3 * limits.tolerance
    edge, face, normal, tail, arm = edge[keep], face[keep], normal[keep], tail[keep], arm[keep]
    times = np.stack([start[keep], stop[keep]], axis=1)
    ends = tail[:, None] + times[:, :, None] * arm[:, None]
    height = np.einsum("eki,ei->ek", ends - surface.corners[face][:, :1], normal)
    covered = _along_edges(ends, surface.part[face], rims, limits)
    extent = extent[keep] - covered
    ends = ends - height[:, :, None] / 2 * normal[:, None]
    parts, normals = _ordered(sharp.part[edge], surface.part[face], -normal)
    # The face has a normal and the edge has none, so that nothing is inclined to it.
    return Narrow(parts, normals, ends, extent, np.zeros(len(extent)), height).take(extent > 1e-3 * limits.tolerance)


def _sides(corners: Array, normal: Array) -> Iterator[tuple[Array, Array]]:
    """Yield a corner of each face and the unit vector into it from the side that begins there, for its three sides."""
    for side in range(3):
        inwards = np.cross(normal, corners[:, (side + 1) % 3] - corners[:, side])
        yield corners[:, side], inwards / np.maximum(np.linalg.norm(inwards, axis=1), 1e-300)[:, None]


def _clip(start: Array, stop: Array, level: Array, climb: Array) -> None:
    """Shrink the intervals in place to where `level + t climb` is not negative."""
    outside = level + np.where(climb > 0, stop, start) * climb < 0
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = np.where(climb != 0, -level / climb, 0.0)
    np.copyto(start, np.maximum(start, zero), where=climb > 0)
    np.copyto(stop, np.minimum(stop, zero), where=climb < 0)
    stop[outside] = start[outside]
    np.maximum(start, stop, out=stop)


def _along_edges(ends: Array, part: NDArray[np.int32], edges: Creases, limits: ContactTolerances) -> Array:
    """Return the length of segments over which an edge of a part runs beside them, shape (segments,), metres."""
    covered = np.zeros(len(ends))
    width = NARROW * limits.tolerance
    for rows, near in _with_edges(ends, part, edges, width):
        origin, along = ends[rows, 0], ends[rows, 1] - ends[rows, 0]
        length = np.linalg.norm(along, axis=1)
        along /= np.maximum(length, 1e-300)[:, None]
        parallel = np.linalg.norm(np.cross(along, edges.along[near]), axis=1) <= limits.sine
        rows, near = rows[parallel], near[parallel]
        origin, along, length = origin[parallel], along[parallel], length[parallel]
        arms = edges.tail[near] - origin
        first = np.einsum("ei,ei->e", arms, along)
        second = first + edges.length[near] * np.einsum("ei,ei->e", edges.along[near], along)
        low = np.maximum(np.minimum(first, second), 0.0)
        high = np.minimum(np.maximum(first, second), length)
        middle = origin + ((low + high) / 2)[:, None] * along
        away = np.linalg.norm(np.cross(middle - edges.tail[near], edges.along[near]), axis=1)
        beside = (away <= width) & (high > low)
        covered += np.bincount(rows[beside], (high - low)[beside], len(ends))
    return covered


def _with_edges(ends: Array, part: NDArray[np.int32], edges: Creases, width: float) -> Iterator[tuple[Index, Index]]:
    """Yield segments with the edges of their part whose boxes are within a little more than `width`; in chunks.

    Args:
        ends: of the segments, or points twice, shape (segments, 2, 3), metres.
        part: of each segment, shape (segments,).
        width: metres.
    """
    if not len(ends) or not len(edges.tail):
        return
    heads = edges.tail + edges.length[:, None] * edges.along
    boxes = np.minimum(edges.tail, heads), np.maximum(edges.tail, heads)
    reach = 1.1 * width
    for rows, near in crossing_boxes(ends.min(axis=1) - reach, ends.max(axis=1) + reach, *boxes):
        own = part[rows] == edges.part[near]
        rows, near = rows[own], near[own]
        for chunk in range(0, len(rows), _CHUNK):
            yield rows[chunk : chunk + _CHUNK], near[chunk : chunk + _CHUNK]


def _inside_a_rim(slivers: Narrow, edges: Creases, limits: ContactTolerances) -> NDArray[np.bool_]:
    """Return whether each strip belongs to a narrow face inside a wide one of the other part, shape (slivers,)."""
    inside = np.zeros(len(slivers.extent), dtype=bool)
    point = slivers.extent == 0
    for side in (0, 1):
        part = slivers.parts[:, side]
        along = slivers.extent - _along_edges(slivers.ends, part, edges, limits) > limits.tolerance
        inside |= np.where(point, ~_on_edges(slivers.ends[:, 0], part, edges, NARROW * limits.tolerance), along)
    return inside


def _on_edges(points: Array, part: NDArray[np.int32], edges: Creases, width: float) -> NDArray[np.bool_]:
    """Return whether points are within `width` of an edge of a part, shape (points,)."""
    found = np.zeros(len(points), dtype=bool)
    for rows, near in _with_edges(points[:, None], part, edges, width):
        arms = points[rows] - edges.tail[near]
        at = np.clip(np.einsum("ei,ei->e", arms, edges.along[near]), 0.0, edges.length[near])
        found[rows[np.linalg.norm(arms - at[:, None] * edges.along[near], axis=1) <= width]] = True
    return found


def _corners_on_faces(
    surface: Surface, rims: Creases, vertex: Index, face: Index, part: NDArray[np.int32], limits: ContactTolerances
) -> Narrow:
    """Return corners that stand on faces, away from their rims."""
    normal, point = surface.normals[face], surface.points[vertex]
    # Most corners lie in the face by an edge or a face of their own: two edges show that of most of them.
    first = surface.hanging[vertex]
    keep = (np.einsum("eki,ei->ek", first, normal) > limits.sine).all(axis=1)
    vertex, face, part, normal, point = vertex[keep], face[keep], part[keep], normal[keep], point[keep]
    height = np.einsum("ei,ei->e", point - surface.points[surface.faces[face, 0]], normal)
    inside = (height <= limits.gap) & (height >= -limits.overlap)
    corners = surface.points[surface.faces[face]]
    for corner, inwards in _sides(corners, normal):
        inside &= np.einsum("ei,ei->e", point - corner, inwards) >= -1e-6 * limits.tolerance
    keep = np.flatnonzero(inside)
    keep = keep[rises(surface, vertex[keep], normal[keep], limits.sine)]
    keep = keep[~_on_edges(point[keep], surface.part[face[keep]], rims, NARROW * limits.tolerance)]
    height = height[keep]
    middle = point[keep] - height[:, None] / 2 * normal[keep]
    parts, normals = _ordered(part[keep], surface.part[face[keep]], -normal[keep])
    ends, gaps = np.stack([middle, middle], axis=1), np.stack([height, height], axis=1)
    none = np.zeros(len(keep))
    return Narrow(parts, normals, ends, none, none, gaps)


def _crossings(sharp: Creases, one: Index, two: Index, limits: ContactTolerances) -> Narrow:
    """Return edges that cross edges, away from their ends."""
    normal = np.cross(sharp.along[one], sharp.along[two])
    sine = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(sine, 1e-300)[:, None]
    below = np.einsum("eki,ei->ek", sharp.into[one], normal)
    above = np.einsum("eki,ei->ek", sharp.into[two], normal)
    upwards = (below < -limits.sine).all(axis=1) & (above > limits.sine).all(axis=1)
    down = (below > limits.sine).all(axis=1) & (above < -limits.sine).all(axis=1)
    keep = (sine > limits.sine) & (upwards | down)
    one, two, sine = one[keep], two[keep], sine[keep]
    normal = normal[keep] * np.where(upwards[keep], 1.0, -1.0)[:, None]
    d, e = sharp.along[one], sharp.along[two]
    arm = sharp.tail[two] - sharp.tail[one]
    cosine = np.einsum("ei,ei->e", d, e)
    onto, past = np.einsum("ei,ei->e", arm, d), np.einsum("ei,ei->e", arm, e)
    at_one = (onto - cosine * past) / sine**2
    at_two = (cosine * onto - past) / sine**2
    height = np.einsum("ei,ei->e", arm, normal)
    keep = (height <= limits.gap) & (height >= -limits.overlap)
    for at, edge in ((at_one, one), (at_two, two)):
        margin = np.where(sharp.ends[edge], limits.tolerance, -1e-6 * limits.tolerance)
        keep &= (at >= margin[:, 0]) & (at <= sharp.length[edge] - margin[:, 1])
    point = sharp.tail[one] + at_one[:, None] * d + height[:, None] / 2 * normal
    parts, normals = _ordered(sharp.part[one], sharp.part[two], normal)
    ends, gaps = np.stack([point, point], axis=1), np.stack([height, height], axis=1)
    none = np.zeros(len(one))
    return Narrow(parts, normals, ends, none, none, gaps).take(keep)
