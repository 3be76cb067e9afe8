"""Contact graph of a structure as a network reads it: the same numbers however the structure is turned or numbered.

Lengths are in units of a typical part, weights in units of the mean one. Nothing depends on the unit of length, on the
place of the structure, on the order of its parts, or on its rotation about the vertical: of a horizontal vector only
the length is a feature. Horizontal lever arms are kept as vectors beside the features; a network may use them in sums
whose lengths it takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from falsework.assembly.model import Assembly
from falsework.geometry.arrays import read_only, segment_sum

PART_FEATURES = 18
PAIR_FEATURES = 19
WHOLE_FEATURES = 4
MOST_NEIGHBOURS = 16
"""Neighbours that a part sees at most, those with the largest contacts: bounds the cost of a plate that carries
everything. All of them see the plate."""
_UNREACHED = 20.0
"""Hops from the boundary that an unreachable part counts with."""

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ContactGraph:
    """Parts, and for each its neighbours in slots, of which the first are used; read-only arrays."""

    part: Floats
    """Height, size, weight and how contacts surround the part, shape (parts, PART_FEATURES)."""
    neighbour: NDArray[np.int64]
    """Number of the part in each slot, 0 in empty ones, shape (parts, slots)."""
    taken: NDArray[np.bool_]
    """Slots with a neighbour, shape (parts, slots)."""
    pair: Floats
    """Contacts with each neighbour, shape (parts, slots, PAIR_FEATURES)."""
    lever: Floats
    """Horizontal vector from the centre of mass to the contacts with each neighbour, shape (parts, slots, 2)."""
    whole: Floats
    """Number of parts, friction, neighbours and height of the structure, shape (WHOLE_FEATURES,)."""
    boundary: NDArray[np.bool_]
    """Shape (parts,)."""

    def __post_init__(self) -> None:
        read_only(*vars(self).values())

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.part)

    @staticmethod
    def from_assembly(assembly: Assembly) -> ContactGraph:
        """Compute the graph of a structure."""
        fixed, centre, mass = assembly.boundary, assembly.mass.center, assembly.mass.mass
        movable = ~fixed if not fixed.all() else fixed
        spread = _spreads(assembly)
        length = float(np.median(np.sqrt((spread**2).sum(axis=1))[movable]))
        pairs = _Pairs.from_assembly(assembly)
        own, other, area = pairs.own, pairs.other, pairs.area
        parts = assembly.part_count

        whole_area = np.bincount(own, area, parts)
        share = area / whole_area[own]
        back = area / whole_area[other]
        arm, arm_back = (pairs.middle - centre[own]) / length, (pairs.middle - centre[other]) / length
        push = pairs.push / area[:, None]
        flat = np.linalg.norm(push[:, :2], axis=1)
        along = np.divide((arm[:, :2] * push[:, :2]).sum(axis=1), flat, out=np.zeros_like(flat), where=flat > 1e-9)
        apart = (centre[other] - centre[own]) / length
        typical = area.mean() if len(area) else 1.0
        ratio = np.log(mass[other] / mass[own])
        pair = np.stack(
            [
                share, back, pairs.up / area, pairs.down / area, flat, push[:, 2], np.log1p(area / typical),
                np.clip(arm[:, 2], -4, 4), np.minimum(np.linalg.norm(arm[:, :2], axis=1), 4),
                np.clip(arm_back[:, 2], -4, 4), np.minimum(np.linalg.norm(arm_back[:, :2], axis=1), 4),
                np.clip(along, -4, 4), np.log1p(np.linalg.norm(apart, axis=1)), np.tanh(apart[:, 2]),
                np.clip(ratio, -6, 6) / 3, pairs.friction, np.log1p(pairs.count),
                fixed[other].astype(float), np.minimum(pairs.size / length, 4),
            ],
            axis=1,
        )  # fmt: skip

        edges = csr_array((np.ones(len(own)), (own, other)), shape=(parts, parts))
        hops = dijkstra(edges, unweighted=True, indices=np.flatnonzero(fixed), min_only=True)
        low, high = _heights(assembly, movable)
        neighbours = np.bincount(own, minlength=parts)
        carried = np.bincount(own, pairs.up, parts)
        support = segment_sum(pairs.up[:, None] * arm[:, :2], own, parts)
        support /= np.maximum(carried, 1e-9 * whole_area + 1e-300)[:, None]
        total = segment_sum(pairs.push, own, parts)
        total /= np.maximum(whole_area, 1e-300)[:, None]
        raised = np.maximum(centre[:, 2] - low, 0.0)
        part = np.stack(
            [
                np.log1p(raised / length), raised / max(high - low, 1e-9),
                np.clip(np.log(mass / mass[movable].mean()), -6, 6) / 2, *np.minimum(spread / length, 4).T,
                np.bincount(own, share * fixed[other], parts), neighbours / 6,
                *(np.bincount(own, share * (one / area), parts) for one in (pairs.up, pairs.down)),
                np.linalg.norm(total[:, :2], axis=1), total[:, 2],
                np.minimum(np.linalg.norm(support, axis=1), 4),
                np.clip(np.bincount(own, share * arm[:, 2], parts), -4, 4),
                fixed.astype(float), np.log1p(np.minimum(hops, _UNREACHED)), np.log1p(whole_area / length**2),
                np.minimum(mass / mass[movable].mean(), 8) / 4,
            ],
            axis=1,
        )  # fmt: skip
        friction = assembly.friction
        degree = neighbours[movable].mean() / 6
        whole = np.array([np.log(parts) / 5, friction, degree, np.log1p((high - low) / length)])
        return _slotted(part, own, other, area, pair, arm[:, :2], whole, fixed.copy())


@dataclass(frozen=True, eq=False)
class _Pairs:
    """All contacts of each ordered pair of parts that touch, seen from `own`, in ascending order."""

    own: NDArray[np.int64]
    other: NDArray[np.int64]
    area: NDArray[np.float64]
    push: NDArray[np.float64]
    """Area times normal into `own`, shape (pairs, 3)."""
    up: NDArray[np.float64]
    """Area times upward component, of contacts that carry `own`."""
    down: NDArray[np.float64]
    middle: NDArray[np.float64]
    """Mean of the contact points, weighted by area, shape (pairs, 3)."""
    size: NDArray[np.float64]
    """Root of the mean squared distance of contact points from the middle."""
    friction: NDArray[np.float64]
    count: NDArray[np.int64]

    @staticmethod
    def from_assembly(assembly: Assembly) -> _Pairs:
        contacts = assembly.contacts
        points = np.maximum(np.diff(contacts.start), 1)
        owner = contacts.contact_of_point
        centre = contacts.centres
        away = ((contacts.points - centre[owner]) ** 2).sum(axis=1)
        radius = np.bincount(owner, away, len(contacts)) / points
        friction = np.full(len(contacts), assembly.friction)
        if assembly.joints is not None:
            own = assembly.joints.friction[contacts.start[:-1]]  # the same at all points of a contact
            friction = np.where(np.isnan(own), friction, own)

        ends = np.concatenate([contacts.parts, contacts.parts[:, ::-1]]).astype(np.int64)
        unique, back = np.unique(ends, axis=0, return_inverse=True)
        back = back.ravel()
        area = np.tile(contacts.areas, 2)
        normals = np.concatenate([-contacts.normals, contacts.normals])

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.bincount(back, values, len(unique)).astype(np.float64)

        areas = total(area)
        middle = segment_sum(area[:, None] * np.tile(centre, (2, 1)), back, len(unique)) / areas[:, None]
        shift = ((np.tile(centre, (2, 1)) - middle[back]) ** 2).sum(axis=1)
        return _Pairs(
            unique[:, 0],
            unique[:, 1],
            areas,
            segment_sum(area[:, None] * normals, back, len(unique)),
            total(area * np.maximum(normals[:, 2], 0)),
            total(area * np.maximum(-normals[:, 2], 0)),
            middle,
            np.sqrt(total(area * (np.tile(radius, 2) + shift)) / areas),
            total(area * np.tile(friction, 2)) / areas,
            np.bincount(back, minlength=len(unique)),
        )


def _spreads(assembly: Assembly) -> NDArray[np.float64]:
    """Return how far the mass of each part spreads upwards, and the long and short way across; shape (parts, 3)."""
    inertia = assembly.mass.inertia
    second = 0.5 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inertia
    second /= assembly.mass.mass[:, None, None]
    across = np.linalg.eigvalsh(second[:, :2, :2])[:, ::-1]
    return np.sqrt(np.maximum(np.column_stack([second[:, 2, 2], across]), 0.0))


def _heights(assembly: Assembly, movable: NDArray[np.bool_]) -> tuple[float, float]:
    bounds = np.array([mesh.bounds for mesh in assembly.meshes])[movable, :, 2]
    return float(bounds[:, 0].min()), float(bounds[:, 1].max())


def _slotted(
    part: NDArray[np.float64],
    own: NDArray[np.int64],
    other: NDArray[np.int64],
    area: NDArray[np.float64],
    pair: NDArray[np.float64],
    lever: NDArray[np.float64],
    whole: NDArray[np.float64],
    boundary: NDArray[np.bool_],
) -> ContactGraph:
    """Put pairs into slots: those with the largest contacts first, so that only the smallest have no slot.

    Boundary parts, which never change, have none: a ground under everything would need as many as there are parts. The
    order of slots has no meaning; a network adds up over them.
    """
    order = np.lexsort((-area, own))
    own, other, pair, lever = own[order], other[order], pair[order], lever[order]
    degree = np.bincount(own, minlength=len(part))
    place = np.arange(len(own)) - np.repeat(np.cumsum(degree) - degree, degree)
    kept = (place < MOST_NEIGHBOURS) & ~boundary[own]
    own, other, pair, lever, place = own[kept], other[kept], pair[kept], lever[kept], place[kept]
    return from_rows(part, own, place, other, pair, lever, whole, boundary)


def from_rows(
    part: NDArray[np.floating],
    own: NDArray[np.integer],
    place: NDArray[np.integer],
    other: NDArray[np.integer],
    pair: NDArray[np.floating],
    lever: NDArray[np.floating],
    whole: NDArray[np.floating],
    boundary: NDArray[np.bool_],
) -> ContactGraph:
    """Make a graph of its pairs, one a row: part, slot and neighbour, features and lever arm."""
    slots = int(place.max(initial=0)) + 1
    shape = len(part), slots
    neighbour, taken = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool)
    features = np.zeros((*shape, PAIR_FEATURES), dtype=np.float32)
    levers = np.zeros((*shape, 2), dtype=np.float32)
    neighbour[own, place], taken[own, place], features[own, place], levers[own, place] = other, True, pair, lever
    return ContactGraph(part.astype(np.float32), neighbour, taken, features, levers, whole.astype(np.float32), boundary)
