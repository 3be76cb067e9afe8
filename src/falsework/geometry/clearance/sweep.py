"""Sweep test: parts hit by one or several parts that move along a straight line to infinity."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.cones import Cones, Pieces, cones_between
from falsework.geometry.clearance.directions import sphere_directions
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.collision import Body, shrink
from falsework.geometry.mesh.edges import components, directed_edges
from falsework.geometry.mesh.mesh import TriangleMesh, triangle_normals
from falsework.utils.bits import intersect, pack
from falsework.utils.interruption import check_interruption

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SHARE = 0.75
"""Share of the tolerance by which each part shrinks: touching parts are then half of it apart at least."""
INTO = np.sin(np.radians(3.0))
"""Sine of the angle to a contact from which on a move counts as into it."""
_PLANES = 1000
"""Normals of planes that are tried to separate parts before any collision is computed."""
_PAIRS = 128
"""Pairs of parts whose cones are kept, a few megabytes each where neither part is convex."""
_BATCH = 125
"""Directions that are tested together; the first ones often settle a part."""


@dataclass(frozen=True, eq=False)
class Exits:
    """Exit directions of one part, or of several that move together, with the parts that block them."""

    directions: Array
    """Unit vectors, shape (exits, 3)."""
    blockers: Mask
    """Shape (exits, parts)."""


class Sweeper:
    """Straight sweeps of parts through all others, of one at a time or of several that move as one body."""

    def __init__(self, meshes: Sequence[TriangleMesh], contacts: Contacts, tolerance: float) -> None:
        """Shrink the parts, and find planes that keep pairs of them apart.

        Args:
            meshes: closed meshes that face outwards.
            tolerance: overlap of touching parts that modelling may leave, metres.
        """
        self._meshes = meshes
        self._contacts = contacts
        self._tolerance = tolerance
        self._shapes: dict[tuple[int, int], _Shape] = {}
        self._convex: dict[tuple[int, int], Pieces] = {}
        self._pairs: OrderedDict[tuple[int, int], Cones] = OrderedDict()
        points = np.concatenate([self._shape(part, 0).vertices for part in range(len(meshes))])
        first = np.concatenate([[0], np.cumsum([len(mesh.vertices) for mesh in meshes])[:-1]])
        self._points, self._first = points, first
        self._reach = 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))
        self._planes = sphere_directions(_PLANES)
        self._low, self._high = self.spans(self._planes)
        self._apart = self._separating_contacts(points, first)
        self._boxes = np.minimum.reduceat(points, first), np.maximum.reduceat(points, first)
        self._levels: dict[tuple[int, int], int] = {}

    def spans(self, normals: Array) -> tuple[Array, Array]:
        """Return where each shrunken part begins and ends along directions, m, two arrays of shape (parts, normals)."""
        level = self._points @ normals.T
        return np.minimum.reduceat(level, self._first, axis=0), np.maximum.reduceat(level, self._first, axis=0)

    def blocked(self, part: int | Sequence[int], directions: Array, others: Mask | None = None) -> Mask:
        """Return whether each part blocks a part, or several together, in each direction, shape (directions, parts).

        Most pairs are decided without a collision. A plane that has the part on one side and the other part
        on the other leaves all directions away from the other open; a contact closes all directions into it.
        The rest are swept, or taken as free if they are not among `others`, shape (parts,).
        """
        moving = _members(part)
        free, hit = self._known_together(moving, directions)
        if others is not None:
            free |= ~(hit | others)
        for ray in np.flatnonzero((~free & ~hit).any(axis=1)).tolist():
            check_interruption()
            walls: dict[tuple[int, int], Body] = {}
            for other in np.flatnonzero(~free[ray] & ~hit[ray]).tolist():
                hit[ray, other] = self._meets(moving, other, directions[ray], walls)
        return hit

    def least_blocked(self, part: int | Sequence[int], directions: Array, known: Exits | None = None) -> Exits:
        """Return the directions that no other beats: those whose blockers do not include all blockers of another.

        A direction is discarded as soon as its known blockers include those of one already found, so that most sweeps
        are skipped; of directions with the same blockers one is kept.

        Args:
            part: the part that leaves, or several that leave together.
            directions: unit vectors, shape (directions, 3).
            known: exit directions found before.

        Returns:
            The remaining known exit directions, then the new ones, in the given order.
        """
        found = Exits(np.zeros((0, 3)), np.zeros((0, len(self._meshes)), dtype=bool)) if known is None else known
        moving = _members(part)
        rank = np.arange(-len(found.directions), 0)
        rows = found.blockers
        exits = found.directions
        for start in range(0, len(directions), _BATCH):
            batch = directions[start : start + _BATCH]
            free, hit = self._known_together(moving, batch)
            for ray in np.argsort(hit.sum(axis=1), kind="stable").tolist():
                check_interruption()
                row = hit[ray]
                walls: dict[tuple[int, int], Body] = {}
                beaten = includes_one(row, rows)
                others = np.flatnonzero(~free[ray] & ~row)
                # First the blockers of the exits already found: they most likely show that this one is no better.
                for other in others[np.argsort(-rows.sum(axis=0)[others], kind="stable")].tolist():
                    if beaten:
                        break
                    if self._meets(moving, other, batch[ray], walls):
                        row[other] = True
                        beaten = includes_one(row, rows)
                if beaten:
                    continue
                kept = ~(rows | ~row).all(axis=1)
                rank = np.append(rank[kept], start + ray)
                exits = np.concatenate([exits[kept], batch[ray, None]])
                rows = np.concatenate([rows[kept], row[None]])
                if not row.any():
                    return Exits(exits, rows)
        order = np.argsort(rank)
        return Exits(exits[order], rows[order])

    def cones(self, part: int | Sequence[int], others: NDArray[np.integer]) -> Cones:
        """Return cones of directions in which the part, or one of several, is blocked by some of the other parts.

        In each direction of a cone the part moves into a contact, or collides with the shrunken other part; a
        direction in no cone need not be free.
        """
        several = []
        for member in _members(part):
            for side, sign in ((0, 1.0), (1, -1.0)):
                mine = np.flatnonzero(
                    (self._contacts.parts[:, side] == member) & np.isin(self._contacts.parts[:, 1 - side], others)
                )
                neighbours = self._contacts.parts[mine, 1 - side]
                several.append(Cones.from_half_spaces(sign * self._contacts.normals[mine], INTO, neighbours))
            several += [self._cones_between(member, other) for other in others.tolist()]
        return Cones.concatenate(several)

    def _cones_between(self, part: int, other: int) -> Cones:
        """Return the cones between two parts; those of the last pairs are kept, since sets share them."""
        if (part, other) not in self._pairs:
            check_interruption()
            level = self.level(part, other)
            self._pairs[part, other] = cones_between(self._pieces(part, level), self._pieces(other, level), other)
            while len(self._pairs) > _PAIRS:
                self._pairs.popitem(last=False)
        self._pairs.move_to_end((part, other))
        return self._pairs[part, other]

    def _pieces(self, part: int, level: int) -> Pieces:
        if (part, level) not in self._convex:
            vertices = self._shape(part, level).vertices
            self._convex[part, level] = Pieces.from_mesh(self._meshes[part], vertices, 0.5 * self._tolerance)
        return self._convex[part, level]

    def _known_together(self, moving: Sequence[int], directions: Array) -> tuple[Mask, Mask]:
        """Return pairs known to be free and known to be blocked, each of shape (directions, parts)."""
        free, hit = self._known(moving[0], directions)
        for member in moving[1:]:
            more_free, more_hit = self._known(member, directions)
            free &= more_free
            hit |= more_hit
        free[:, list(moving)] = True
        return free, hit & ~free

    def _known(self, part: int, directions: Array) -> tuple[Mask, Mask]:
        """As `_known_together`, of one part."""
        ahead = self._low[part] >= self._high
        away = np.einsum("ki,pi->kp", directions, self._planes) >= 0
        free = intersect(pack(away), pack(ahead))
        hit = np.zeros_like(free)
        for side, sign in ((0, -1.0), (1, 1.0)):
            mine = np.flatnonzero(self._contacts.parts[:, side] == part)
            neighbour = self._contacts.parts[mine, 1 - side]
            along = sign * (directions @ self._contacts.normals[mine].T)
            for column, contact in enumerate(mine.tolist()):
                if self._apart[contact]:
                    free[:, neighbour[column]] |= along[:, column] >= -1e-9
                hit[:, neighbour[column]] |= along[:, column] < -INTO
        free[:, part] = True
        return free, hit & ~free

    def _meets(self, moving: Sequence[int], other: int, direction: Array, walls: dict[tuple[int, int], Body]) -> bool:
        """Return whether one of the parts hits the other along the direction; `walls` caches their walls for that.

        The swept volume is bounded by the wall that the outline of a part sweeps, apart from its two
        ends. Another part that it meets either crosses that wall or is enclosed by the volume; then the
        wall of any of its edges, swept backwards, crosses the part.
        """
        move = direction * self._reach
        for part in moving:
            level = self.level(part, other)
            shape, obstacle = self._shape(part, level), self._shape(other, level)
            if (part, level) not in walls:
                walls[part, level] = shape.wall(move)
            if walls[part, level].hits(obstacle.body) or obstacle.edge_wall(-move).hits(shape.body):
                return True
        return False

    def shrunk(self, part: int, level: int) -> Array:
        """Return the vertices of a part shrunk as beside others of a `level`, shape (vertices, 3), metres."""
        return self._shape(part, level).vertices

    def _shape(self, part: int, level: int) -> _Shape:
        """Return a part shrunk by its share of the tolerance, doubled `level` times."""
        if (part, level) not in self._shapes:
            distance = _SHARE * self._tolerance * 2**level
            self._shapes[part, level] = _Shape(self._meshes[part], distance)
        return self._shapes[part, level]

    def _collide(self, a: int, b: int, level: int) -> bool:
        return self._shape(a, level).body.hits(self._shape(b, level).body)

    def _separating_contacts(self, points: Array, first: NDArray[np.integer]) -> Mask:
        """Return contacts whose plane has one part wholly on one side and the other on the other, shape (contacts,)."""
        ends = np.append(first[1:], len(points))
        apart = np.zeros(len(self._contacts), dtype=bool)
        for contact, (a, b) in enumerate(self._contacts.parts.tolist()):
            normal = self._contacts.normals[contact]
            apart[contact] = (points[first[a] : ends[a]] @ normal).max() <= (points[first[b] : ends[b]] @ normal).min()
        return apart

    def level(self, a: int, b: int) -> int:
        """Count the doublings of the shrinking after which the corners of two parts no longer cut into each other.

        It stops at a quarter of the thickness of the thinner part; pairs that still collide are never free.
        """
        pair = min(a, b), max(a, b)
        if pair not in self._levels:
            low, high = self._boxes
            level = 0
            if (low[a] <= high[b]).all() and (low[b] <= high[a]).all() and self._collide(a, b, 0):
                level = 1
                deepest = min(self._meshes[a].thickness, self._meshes[b].thickness) / (4 * _SHARE * self._tolerance)
                while 2**level < deepest and self._collide(a, b, level):
                    level += 1
            self._levels[pair] = level
        return self._levels[pair]


def _members(part: int | Sequence[int]) -> tuple[int, ...]:
    return tuple(part) if isinstance(part, Sequence) else (int(part),)


def includes_one(row: NDArray[np.bool_], rows: Mask) -> bool:
    """Return whether a set includes at least one of the others."""
    return bool((~rows | row).all(axis=1).any())


class _Shape:
    """Shrunken part, as obstacle and as swept body."""

    def __init__(self, mesh: TriangleMesh, distance: float) -> None:
        self.vertices = shrink(mesh, distance)
        self._mesh = mesh

    @cached_property
    def body(self) -> Body:
        """The surface."""
        return Body(self.vertices, self._mesh.faces)

    @cached_property
    def _edges(self) -> _Edges:
        return _Edges(self._mesh.faces)

    @cached_property
    def _normals(self) -> Array:
        corners = self.vertices[self._mesh.faces]
        return triangle_normals(corners)

    def wall(self, move: Array) -> Body:
        """Return the surface that the silhouette of the part sweeps."""
        front = self._normals @ move > 0
        return self._swept(self._edges.ends[front[self._edges.one] != front[self._edges.two]], move)

    def edge_wall(self, move: Array) -> Body:
        """Return the surface that one edge of every component of the part sweeps."""
        return self._swept(self._edges.samples, move)

    def _swept(self, ends: NDArray[np.integer], move: Array) -> Body:
        near = self.vertices[ends.ravel()]
        count = len(ends)
        first = 2 * np.arange(count)[:, None]
        faces = np.concatenate([first + (0, 1, 2 * count), first + (1, 2 * count + 1, 2 * count)])
        return Body(np.concatenate([near, near + move]), faces)


class _Edges:
    """Edges of a closed mesh with the two faces of each."""

    def __init__(self, faces: NDArray[np.int32]) -> None:
        tail, head = directed_edges(faces.astype(np.int64))
        owner = np.repeat(np.arange(len(faces)), 3)
        # A closed surface passes each edge as often forwards as backwards: sorting both ways pairs them up.
        up, down = tail < head, tail > head
        up_order = np.lexsort((head[up], tail[up]))
        down_order = np.lexsort((tail[down], head[down]))
        self.ends = np.stack([tail[up], head[up]], axis=1)[up_order]
        self.one = owner[up][up_order]
        self.two = owner[down][down_order]
        _, sample = np.unique(components(self.one, self.two, len(faces))[self.one], return_index=True)
        self.samples = self.ends[sample]
