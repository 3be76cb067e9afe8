"""Swept tests of moves: which parts are hit by others that move in straight lines, turn, or screw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import apply, box_around
from falsework.geometry.clearance.moves import PathMove, Poses, after
from falsework.geometry.clearance.sweep import Sweeper
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.paths.cells import CellGrid
from falsework.geometry.paths.hulls import first_hits, near_order, swept
from falsework.utils.interruption import check_interruption

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAGITTA = 0.25
"""Share of the tolerance by which parts that turn may leave the hulls that are tested in their stead."""
_FIRST_STEPS = 8
"""Steps of a turn that are tested first; then twice as many, and so on."""
_HOME = np.eye(4)
IN_PLACE: Poses = MappingProxyType({})
"""Poses where every part is in place."""


class PartMotions:
    """Swept tests of moves, with a proof of every way that is found free.

    Parts are shrunk as for straight exits, by three quarters of the tolerance at first (`Sweeper`). Each triangle of a
    moving part is inside the convex hull of its corners at the ends of a step, for a straight move exactly, for a turn
    up to a sagitta of a quarter of the tolerance, which sets the number of steps. A move is free if a plane proves each
    of these hulls farther than that from each triangle at rest: then no surfaces meet on the way. So a free move
    never makes the shrunken parts collide; a move that is refused brings them within half of the tolerance.
    """

    def __init__(self, meshes: Sequence[TriangleMesh], contacts: Contacts, tolerance: float) -> None:
        """Take a structure.

        Args:
            meshes: closed meshes that face outwards.
            tolerance: overlap of touching parts that modelling may leave, metres.
        """
        self.meshes, self.tolerance, self._contacts = meshes, tolerance, contacts
        self._shrunken: dict[tuple[int, int], Array] = {}
        self._bounds = np.array([mesh.bounds for mesh in meshes])
        self._grids: dict[tuple[int, ...], CellGrid] = {}

    def __reduce__(self) -> tuple[type[PartMotions], tuple[Any, ...]]:
        """Pickle what it is made of."""
        return PartMotions, (self.meshes, self._contacts, self.tolerance)

    def grid(self, parts: tuple[int, ...]) -> CellGrid | None:
        """Return the grid of whose cells some parts consist; None if there is none."""
        found = CellGrid.from_meshes(self.meshes, parts, self.tolerance)
        return None if found is None else self._grids.setdefault(found.name, found)

    @cached_property
    def _sweeper(self) -> Sweeper:
        return Sweeper(self.meshes, self._contacts, self.tolerance)

    def _triangles(self, part: int, level: int) -> Array:
        if (part, level) not in self._shrunken:
            triangles = self._sweeper.shrunk(part, level)[self.meshes[part].faces]
            self._shrunken[part, level] = triangles[near_order(triangles)]
        return self._shrunken[part, level]

    def blockers(self, move: PathMove, others: Mask, poses: Poses = IN_PLACE, *, stop: bool = False) -> Mask:
        """Return which parts a move hits, shape (parts,).

        Args:
            move: its parts begin where they are.
            others: parts at rest, shape (parts,); those of the move do not count.
            poses: parts that are not in place.
            stop: return after the first.
        """
        found = np.zeros(len(self.meshes), dtype=bool)
        for begin, end in self._stretches(move, poses, stop):
            check_interruption()
            found |= np.isfinite(self._first_shares(move, begin, end, others & ~found, poses, stop))
            if stop and found.any():
                break
        return found

    def free_share(self, move: PathMove, others: Mask, poses: Poses = IN_PLACE) -> tuple[float, Mask]:
        """Return the share of a move up to the step in which it first hits others, and these, shape (parts,).

        Arguments as of `blockers`.
        """
        for begin, end in self._stretches(move, poses, True):
            check_interruption()
            shares = self._first_shares(move, begin, end, others, poses, False)
            if np.isfinite(shares).any():
                return float(shares.min()), shares == shares.min()
        return 1.0, np.zeros(len(self.meshes), dtype=bool)

    def _stretches(self, move: PathMove, poses: Poses, short: bool) -> Iterator[tuple[float, float]]:
        """Yield stretches of a move to be tested one after the other, each twice as long as the one before if short."""
        points = np.concatenate([apply(poses.get(part, _HOME), self.meshes[part].vertices) for part in move.parts])
        steps, begin, count = move.steps(points, SAGITTA * self.tolerance), 0, _FIRST_STEPS
        while begin < steps:
            end = min(steps, begin + count) if short else steps
            yield begin / steps, end / steps
            begin, count = end, 2 * count

    def _first_shares(self, move: PathMove, begin: float, end: float, others: Mask, poses: Poses, stop: bool) -> Array:
        """Return the share of a move free of each part, if it is hit between two shares, else infinity, (parts,)."""
        shares = np.full(len(self.meshes), np.inf)
        rest = others.copy()
        rest[list(move.parts)] = False
        near = SAGITTA * self.tolerance if move.turns else 0.0
        for part in move.parts:
            for level, group in self._groups(part, rest):
                triangles = apply(poses.get(part, _HOME), self._triangles(part, level))
                # Shrinking may move corners outwards, so that steps are counted anew.
                steps = int(np.ceil((end - begin) * move.steps(triangles.reshape(-1, 3), near)))
                times = np.linspace(begin, end, steps + 1)
                frames = np.stack([apply(move.displacement(share), triangles) for share in times])
                found = np.full(len(group), steps, dtype=np.int64)
                walls = [self._triangles(other, level) for other in group]
                walls = [
                    apply(poses[other], wall) if other in poses else wall
                    for other, wall in zip(group, walls, strict=True)
                ]
                owner = np.repeat(np.arange(len(group)), [len(wall) for wall in walls])
                hulls = swept(frames).reshape(-1, 3)
                first_hits(hulls, steps, np.concatenate(walls).reshape(-1, 3), owner, near, found, stop)
                hit = found < steps
                rows = np.array(group)[hit]
                shares[rows] = np.minimum(shares[rows], times[found[hit]])
                if stop and hit.any():
                    return shares
        return shares

    def _groups(self, part: int, others: Mask) -> list[tuple[int, list[int]]]:
        """Return the other parts by the level of shrinking that they need beside a part."""
        groups: dict[int, list[int]] = {}
        for other in np.flatnonzero(others).tolist():
            groups.setdefault(self._sweeper.level(part, other), []).append(other)
        return sorted(groups.items())

    def box(self, part: int, pose: Array = _HOME) -> Array:
        """Return the lowest and highest coordinates of a part in a pose, shape (2, 3), metres."""
        return box_around(apply(pose, self.meshes[part].vertices))

    def bounds(self, parts: Mask, poses: Poses = IN_PLACE) -> Array:
        """Return the lowest and highest coordinates of parts, shape (2, 3), metres."""
        boxes = [self.box(part, poses[part]) if part in poses else self._bounds[part] for part in np.flatnonzero(parts)]
        return np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])

    def bounds_without(self, parts: tuple[int, ...]) -> Array:
        """Return the lowest and highest coordinates of all parts in place but some, shape (2, 3), metres."""
        return self.bounds(~np.isin(np.arange(len(self.meshes)), parts))

    def leaves(self, moves: Sequence[PathMove], others: Mask) -> str:
        """Return why moves, one after the other, do not take the parts of the last one out; empty if they do.

        Out is where a plane along a face of the box around the others has the parts on its outer side. Other parts that
        moves have displaced go back as they came, which is free if the way there was.

        Args:
            moves: from where all parts are in place.
            others: parts that are there besides those of the last move, shape (parts,).
        """
        last = moves[-1].parts
        there = others.copy()
        there[list(last)] = True
        for number, move in enumerate(moves):
            absent = [part for part in move.parts if not there[part]]
            if absent:
                return f"move {number + 1} moves {self.meshes[absent[0]].name}, which is not there"
            hit = np.flatnonzero(self.blockers(move, there, after(moves[:number])))
            if len(hit):
                name = self.meshes[move.parts[0]].name
                return f"move {number + 1} takes {name} into {self.meshes[int(hit[0])].name}"
        poses = after(moves)
        rest = there.copy()
        rest[list(last)] = False
        if not rest.any():
            return ""
        low, high = self.bounds(rest, poses)
        for part in last:
            box = self.box(part, poses[part])
            if not ((box[0] >= high - self.tolerance) | (box[1] <= low + self.tolerance)).any():
                return f"its moves end while {self.meshes[part].name} is still among the other parts"
        return ""
