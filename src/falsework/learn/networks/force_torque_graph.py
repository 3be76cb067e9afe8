"""Force-torque graph of a structure: the quantities in its equilibrium equations (paper, section 5.4 and figure 8).

Balance of a part says that forces and torques on it add up to zero. The graph has nodes for the three kinds of
quantities: parts, forces between parts, and the torque of a force at a contact point about the centre of each of the
two parts.

- Part: one for each part; held, in the target, mass.
- Force: one for each distinct contact normal of two parts that touch; the normal.
- Torque: two for each contact point, one for either part; the lever arm from the part's centre to the point.

Edges run both ways: torque and its part, torque and its force, the two torques of one contact point, force and each of
its two parts (of two kinds: the normal points into the part, or out of it), and each part to all others; every node has
one to itself. The graph is built once for a structure. A state changes no edge of it: it disables nodes, and a node is
present if all its parts are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.geometry.arrays import read_only

PARALLEL = 5.0
"""Contacts of one pair whose normals differ by less are one force, degrees."""
CURVED_FROM = 6
"""A pair with more distinct normals than this has a curved interface; polycubes have up to 6."""
CURVED = 30.0
"""On a curved interface normals that differ by less from the largest contact's are one force, degrees."""
CURVED_POINTS = 4
"""Contact points that are kept of each force on a curved interface: those farthest apart."""


@dataclass(frozen=True, eq=False)
class ForceTorqueGraph:
    """Nodes and edges of one structure, frozen; lengths are in units of a typical part, so units do not matter."""

    boundary: NDArray[np.bool_]
    """Shape (parts,)."""
    mass: NDArray[np.float32]
    """Logarithm of the mass by that of the median part, shape (parts,)."""
    force_parts: NDArray[np.int32]
    """Parts `a` and `b` of each force, shape (forces, 2)."""
    normals: NDArray[np.float32]
    """Unit normal of each force, out of `a` and into `b`, upwards (level ones towards +x, else +y) so that it does not
    depend on how parts are numbered; shape (forces, 3)."""
    point_force: NDArray[np.int32]
    """Force of each contact point, ascending, shape (points,)."""
    levers: NDArray[np.float32]
    """From the centres of `a` and `b` to each contact point, shape (points, 2, 3)."""

    @staticmethod
    def from_assembly(assembly: Assembly) -> ForceTorqueGraph:
        """Build the graph of a structure; contacts between two boundary parts carry nothing and are left out."""
        contacts = assembly.contacts
        fixed = assembly.boundary
        a, b = contacts.parts.T
        used = np.flatnonzero(~(fixed[a] & fixed[b]))
        force = np.full(len(contacts), -1, dtype=np.int64)
        parts: list[NDArray[np.int32]] = []
        normals: list[NDArray[np.float64]] = []
        curved: list[bool] = []
        pairs = contacts.parts[used]
        starts = np.flatnonzero(np.append(True, (pairs[1:] != pairs[:-1]).any(axis=1))) if len(used) else []
        for group in np.split(used, starts[1:]) if len(used) else []:
            areas, directions = contacts.areas[group], contacts.normals[group]
            label = _clusters(directions, areas, PARALLEL)
            bent = label.max() + 1 > CURVED_FROM
            if bent:
                label = _clusters(directions, areas, CURVED)
            for one in range(label.max() + 1):
                members = group[label == one]
                force[members] = len(parts)
                mean = (contacts.areas[members, None] * contacts.normals[members]).sum(axis=0)
                mean /= np.linalg.norm(mean)
                upwards = _upwards(mean)
                parts.append(contacts.parts[group[0]] if upwards else contacts.parts[group[0], ::-1])
                normals.append(mean if upwards else -mean)
                curved.append(bool(bent))

        owner = force[contacts.contact_of_point]
        kept = []
        for one in range(len(parts)):
            mine = np.flatnonzero(owner == one)
            kept.append(mine[_spread(contacts.points[mine], CURVED_POINTS)] if curved[one] else mine)
        points = np.concatenate(kept) if kept else np.zeros(0, dtype=np.int64)
        point_force = owner[points].astype(np.int32)
        force_parts = np.array(parts, dtype=np.int32).reshape(-1, 2)

        movable = ~fixed if not fixed.all() else fixed
        bounds = np.array([mesh.bounds for mesh in assembly.meshes])
        length = float(np.median(np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)[movable]))
        levers = (contacts.points[points, None] - assembly.mass.center[force_parts[point_force]]) / length
        mass = np.log(assembly.mass.mass / np.median(assembly.mass.mass[movable]))
        arrays = read_only(
            mass.astype(np.float32),
            force_parts,
            np.array(normals, dtype=np.float32).reshape(-1, 3),
            point_force,
            levers.astype(np.float32).reshape(-1, 2, 3),
        )
        return ForceTorqueGraph(fixed, *arrays)

    @property
    def part_count(self) -> int:
        """Number of part nodes."""
        return len(self.boundary)

    @property
    def force_count(self) -> int:
        """Number of force nodes."""
        return len(self.normals)

    def grid(self) -> TorqueGrid:
        """Arrange torque nodes in rows of equal length, each of one force, so that most of the work needs no index.

        The length is the one that wastes least, counting two slots for every row.
        """
        count = np.bincount(self.point_force, minlength=self.force_count)
        width = min(range(1, int(count.max(initial=1)) + 1), key=lambda w: (w + 2) * int((-(-count // w)).sum()))
        rows = -(-count // width)
        place = np.arange(len(self.point_force)) - np.repeat(np.cumsum(count) - count, count)
        row = (np.cumsum(rows) - rows)[self.point_force] + place // width
        levers = np.zeros((int(rows.sum()), 2, width, 3), dtype=np.float32)
        taken = np.zeros((len(levers), width), dtype=bool)
        levers[row, :, place % width] = self.levers
        taken[row, place % width] = True
        return TorqueGrid(levers, taken, np.repeat(np.arange(self.force_count), rows))


@dataclass(frozen=True, eq=False)
class TorqueGrid:
    """Torque nodes on a grid of rows, the two sides of each contact point, and slots for contact points."""

    levers: NDArray[np.float32]
    """Shape (rows, 2, slots, 3); zero where no point is."""
    taken: NDArray[np.bool_]
    """Slots with a contact point, shape (rows, slots)."""
    force: NDArray[np.int64]
    """Force of each row, ascending, shape (rows,)."""


def _upwards(normal: NDArray[np.float64]) -> bool:
    for axis in (2, 0, 1):
        if abs(normal[axis]) > 1e-3:
            return bool(normal[axis] > 0)
    return True


def _clusters(normals: NDArray[np.float64], areas: NDArray[np.float64], angle: float) -> NDArray[np.int64]:
    """Group normals: the largest contact that is left collects all within an angle (degrees) of its normal."""
    limit = np.cos(np.radians(angle))
    label = np.full(len(normals), -1, dtype=np.int64)
    # Equal areas must not be told apart by rounding, or moving the structure would change its graph.
    for seed in np.argsort(-np.round(areas / areas.max(), 6), kind="stable").tolist():
        if label[seed] < 0:
            label[(label < 0) & (normals @ normals[seed] >= limit)] = label.max() + 1
    return label


def _spread(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return indices of points far from each other, first the one farthest from the middle."""
    size = np.ptp(points, axis=0).max()
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    chosen: list[int] = []
    for _ in range(min(count, len(points))):
        # Rounded, so that equally far points are taken in their order.
        nearest = np.round(distance / max(size, 1e-300), 6)
        if chosen and nearest.max() == 0:
            break
        chosen.append(int(nearest.argmax()))
        away = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = away if len(chosen) == 1 else np.minimum(distance, away)
    return np.array(sorted(chosen), dtype=np.int64)
