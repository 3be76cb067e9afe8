"""Search for exit directions that ends with a proof of completeness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from falsework.geometry.clearance.cover import DEEPEST, Triangles, uncovered
from falsework.geometry.clearance.sweep import Exits, Sweeper
from falsework.utils.interruption import check_interruption

_SWEEPS = 192
"""Directions that are swept for one part before giving up."""
_FINER = 3
"""Number of cuts of triangles before the centres of the rest are tested."""
_AT_ONCE = 16
"""Directions that are swept before the triangles are examined again."""


def all_exits(sweeper: Sweeper, part: int | Sequence[int], exits: Exits) -> tuple[Exits, bool]:
    """Add exit directions until every direction is proved to be no better than one of them.

    The sphere of directions is cut into triangles. A triangle is settled if the blocking cones show that it contains no
    new exit. Otherwise its centre is swept: either it is a new exit direction, or the triangle is subdivided.

    Args:
        sweeper: the structure.
        part: the part that leaves, or several that leave together.
        exits: known exit directions, at least one.

    Returns:
        All exit directions, and whether the proof succeeded; if not, others may exist that sweeping did not find.
    """
    if not exits.blockers.any(axis=1).all():  # one is always free
        return exits, True
    cones, named = None, np.zeros(0, dtype=np.int64)
    triangles, limit, swept = Triangles.sphere(), _FINER, 0
    while swept < _SWEEPS:
        check_interruption()
        blockers = np.flatnonzero(exits.blockers.any(axis=0))
        if len(blockers) > 64:
            return exits, False
        if cones is None or not np.isin(blockers, named).all():
            named = np.union1d(named, blockers)
            cones = sweeper.cones(part, named)
        look = uncovered(triangles, cones.take(blockers), exits.blockers, limit)
        if look is None:
            return exits, False
        left, doubtful = look
        if not len(left):
            return exits, True
        order = np.lexsort((left.cut, ~doubtful))
        count = min(int(doubtful.sum()), _AT_ONCE)
        now, later = order[:count], order[count:]
        if count == 0:
            limit += _FINER
        if limit > DEEPEST or (left.cut[now] >= DEEPEST).any():
            return exits, False
        exits = sweeper.least_blocked(part, left.centres[now], exits)
        swept += count
        if not exits.blockers.any(axis=1).all():
            return exits, True
        # A triangle whose centre is a new exit direction may be settled by it or not: its quarters decide.
        triangles = Triangles.join([left.take(now).quartered(), left.take(later)])
    return exits, False
