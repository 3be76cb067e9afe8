"""First motions of parts, and ways out of several that move at the same time along different directions.

What cannot begin to move, shifting or turning, has no way out of any shape. What can, may still have no straight one.

The velocities at which some parts can begin to move past the others form a cone: no contact is pushed into. Linear
programs tell whether every part of the set can move, and whether two can move relative to each other; if not, no motion
takes the set apart. Otherwise their solutions are velocities to try. At constant velocities parts move in straight
lines relative to each other, so that sweeps of pairs decide whether nothing collides on the whole way.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import box_around, box_corners
from falsework.geometry.clearance.locked import PartSet
from falsework.geometry.clearance.sweep import INTO, Sweeper
from falsework.geometry.contact.interfaces import Contacts
from falsework.utils.bits import Words, pack

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STILL = 1e-6
"""Velocity, as a share of the largest, below which a part rests."""


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Motion of a set of parts at constant velocities."""

    velocities: Array
    """Of each part of the set, the fastest at 1, shape (parts of the set, 3)."""
    blockers: Words
    """Parts that block it, shape (words,)."""


class RelativeMotions:
    """Motions of sets of parts along different directions, found when first asked for."""

    def __init__(self, contacts: Contacts, sweeper: Sweeper, parts: int) -> None:
        """Take a structure.

        Args:
            sweeper: of its parts.
        """
        self._contacts, self._sweeper, self._parts = contacts, sweeper, parts
        self._motions: dict[PartSet, list[RelativeMotion]] = {}
        self._asked: dict[tuple[PartSet, bytes], bool] = {}
        self.unsure: set[PartSet] = set()
        """Sets that can begin to move apart, though no motion was found that takes them out."""

    def motion(self, parts: PartSet, present: Mask) -> RelativeMotion | None:
        """Return a motion that takes a set out along different directions; None if there is none, or none was found.

        Args:
            present: parts that are there, shape (parts,); those of the set count as there.
        """
        there = present.copy()
        there[list(parts)] = True
        beside = there & self._contacts.touched(parts, self._parts)
        key = parts, np.packbits(beside).tobytes()
        others = there.copy()
        others[list(parts)] = False
        known = self._free(parts, others)
        if known is not None:
            return known
        if key not in self._asked:
            velocities = self._begins(parts, beside)
            self._asked[key] = velocities != []
            self._try(parts, velocities)
        known = self._free(parts, others)
        if known is None and self._asked[key]:
            self.unsure.add(parts)
        return known

    def _free(self, parts: PartSet, others: Mask) -> RelativeMotion | None:
        words = pack(others[None])[0]
        return next((motion for motion in self._motions.get(parts, ()) if not (motion.blockers & words).any()), None)

    def _begins(self, parts: PartSet, present: Mask) -> list[Array]:
        """Return velocities at which a set can begin to move apart, each of shape (parts of the set, 3); none if not.

        Args:
            present: parts that are there, shape (parts,).
        """
        rows, count = [], len(parts)
        pairs, normals = self._contacts.parts, self._contacts.normals
        ours = np.isin(pairs, parts)
        for contact in np.flatnonzero(ours.any(axis=1) & present[pairs].all(axis=1)).tolist():
            row = np.zeros((count, 3))
            for part, sign in zip(pairs[contact].tolist(), (1.0, -1.0), strict=True):
                if part in parts:
                    row[parts.index(part)] += sign * normals[contact]
            rows.append(row.ravel())
        into = np.array(rows).reshape(-1, 3 * count)
        units = np.eye(3 * count).reshape(count, 3, 3 * count)
        found: list[Array] = []
        for part in range(count):
            # Scaled by the velocity of this part, and by the largest of all.
            some = [
                feasible_velocities(into, sign * axis, np.eye(3 * count)) for axis in units[part] for sign in (1, -1)
            ]
            some = [velocity for velocity in some if velocity is not None]
            if not some:
                return []
            found += some
        relative = np.concatenate([units[a] - units[b] for a, b in combinations(range(count), 2)])
        apart = [feasible_velocities(into, sign * row, relative) for row in relative for sign in (1, -1)]
        apart = [velocity for velocity in apart if velocity is not None]
        if not apart:
            return []
        found += apart
        return [velocity.reshape(count, 3) for velocity in (*found, np.sum(found, axis=0))]

    def _try(self, parts: PartSet, velocities: list[Array]) -> None:
        """Sweep a set at some velocities, and keep the motions in which its parts do not collide with each other."""
        motions = self._motions.setdefault(parts, [])
        for velocity in velocities:
            speed = np.linalg.norm(velocity, axis=1)
            velocity = np.where(np.abs(velocity) < _STILL * speed.max(), 0.0, velocity / speed.max())
            relative = {(a, b): velocity[a] - velocity[b] for a, b in combinations(range(len(parts)), 2)}
            rests = (speed < _STILL * speed.max()).any()
            if rests or all(np.abs(between).max() < _STILL for between in relative.values()):
                continue
            if any(np.abs(motion.velocities - velocity).max() < _STILL for motion in motions):
                continue
            if any(self.collide(parts[a], parts[b], between) for (a, b), between in relative.items()):
                continue
            hit = np.zeros(self._parts, dtype=bool)
            for part, own in zip(parts, velocity, strict=True):
                hit |= self._sweeper.blocked(part, own[None] / np.linalg.norm(own))[0]
            hit[list(parts)] = False
            motions.append(RelativeMotion(velocity, pack(hit[None])[0]))

    def collide(self, a: int, b: int, between: Array) -> bool:
        """Return whether two parts collide at a relative velocity."""
        size = float(np.linalg.norm(between))
        if size < _STILL:
            return False
        only = np.zeros(self._parts, dtype=bool)
        only[b] = True
        return bool(self._sweeper.blocked(a, between[None] / size, only)[0, b])


def can_begin_to_move(contacts: Contacts, parts: PartSet, present: NDArray[np.bool_]) -> bool:
    """Return whether all parts of a set can begin to move at the same time while the others rest.

    To first order: no contact point is pushed into, see `feasible_velocities`. So what cannot begin to move has no way
    out of any shape. Each part of the set moves on its own. Of several, each has to be able to where the others of
    the set are not there, and one of them, the fastest, where they are.

    Args:
        present: parts that are there, shape (parts,).
    """
    rest = present.copy()
    rest[list(parts)] = False
    alone = all(_one_begins(contacts, (part,), rest) for part in parts)
    return alone and (len(parts) == 1 or _one_begins(contacts, parts, rest))


def _one_begins(contacts: Contacts, parts: PartSet, rest: Mask) -> bool:
    """Return whether one of some parts can begin to move past those at rest where none of the others is faster.

    The speed of a part is here that of the fastest corner of a box around its contact points: none of these is faster.
    """
    from scipy.linalg import block_diag

    pairs, points = contacts.parts[contacts.contact_of_point], contacts.points
    moves = np.isin(pairs, parts)
    rows = np.flatnonzero(moves.any(axis=1) & (moves | rest[pairs]).all(axis=1))
    into = np.zeros((len(rows), len(parts), 6))
    speeds = []
    for place, part in enumerate(parts):
        own = (pairs[rows] == part).any(axis=1)
        if not own.any():
            return True
        arms = points[rows] - points[rows[own]].mean(axis=0)
        axes = np.linalg.eigh(arms[own].T @ arms[own])[1].T
        local = arms @ axes.T
        extent = max(float(np.abs(local[own]).max()), 1e-12)  # shifts and turns then have like sizes
        corners = box_corners(box_around(local[own]) / extent)
        fastest = np.concatenate([np.hstack([np.eye(3), np.cross(corner, np.eye(3))]) for corner in corners])
        fastest = np.unique(np.round(fastest, 12), axis=0)
        if np.linalg.matrix_rank(fastest) < 6:
            return True  # it turns about the line on which all points lie
        speeds.append(fastest)
        normals = contacts.point_frames[rows, 0] @ axes.T
        twist = np.concatenate([normals, np.cross(local / extent, normals)], axis=1)
        into[:, place] = np.select([pairs[rows, :1] == part, pairs[rows, 1:] == part], [twist, -twist], 0.0)
    # Two parts that both move are up to twice as fast past each other.
    into /= moves[rows].sum(axis=1)[:, None, None]
    bounded = block_diag(*speeds)
    return any(
        feasible_velocities(into.reshape(len(rows), -1), sign * speed, bounded) is not None
        for speed in bounded
        for sign in (1.0, -1.0)
    )


def feasible_velocities(into: Array, fixed: Array, bounded: Array) -> Array | None:
    """Return velocities for which one combination is 1 and others are at most 1 in size, and no contact is pushed into.

    What is at most 1 in size is each component of the speed. A model is exact to `INTO` of that: so fast parts may move
    into contacts, if they have to.

    Args:
        into: rows whose products with the velocities are the speeds into contacts, shape (contacts, n).
        fixed: the combination that is 1, shape (n,).
        bounded: combinations that are at most 1 in size, shape (m, n).

    Returns:
        Of all solutions one that goes least into contacts, and of these one with the least sum of sizes, shape (n,);
        None if there is none.
    """
    from scipy.optimize import linprog

    count = into.shape[1]
    # Velocities are differences of two parts that are not negative, whose sum is least; then the speed into contacts.
    signed = np.concatenate([into, bounded, -bounded])
    slack = np.repeat([-1.0, 0.0], [len(into), 2 * len(bounded)])
    solved = linprog(
        np.append(np.ones(2 * count), 1.0 / _STILL),
        A_ub=np.column_stack([signed, -signed, slack]),
        b_ub=np.repeat([1e-9, 1.0], [len(into), 2 * len(bounded)]),
        A_eq=np.concatenate([fixed, -fixed, [0.0]])[None],
        b_eq=[1.0],
        bounds=[*[(0.0, None)] * (2 * count), (0.0, np.sqrt(3.0) * INTO)],
        method="highs",
    )
    return solved.x[:count] - solved.x[count : 2 * count] if solved.status == 0 else None
