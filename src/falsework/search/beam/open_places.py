"""Places that a beam leaves open for parts which do not stand where they come last.

In a replay parts are inserted unstressed. A wedge at the edge of an opening stands because its neighbours press on it;
inserted when all of them are in place, it slides out as soon as the robot lets go of it. So one of them must come
later. Verdicts do not show that, since they load all parts at once. Which parts cannot come last is asked before the
search where neighbours that do not yield decide it, and seen where a beam dies otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask
from falsework.search.beam.frontier import Frontier, Level, PackedLevel
from falsework.search.problem.edge_rows import edge_rows
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Task
from falsework.stability.problem import Problem


def cannot_come_last(task: Task, oracle: Oracle, problem: Problem) -> NDArray[np.int64]:
    """Return the parts that do not stand unstressed between neighbours which robots hold.

    That they do not stand between neighbours which yield either is an observation, not a theorem. It is wrong where
    free edges are arches between supports: when such an arch closes, it presses on parts that came last beside their
    neighbours. Structures whose parts lie in rows behind such edges are left out.

    Args:
        task: rules of the search.
        oracle: decides stability.
        problem: contact problem of the structure.
    """
    if task.neighbours is None:
        return np.empty(0, dtype=np.int64)
    parts = np.flatnonzero((task.start == INSTALLED) & (task.target == REMOVED) & task.neighbours.any(axis=1))
    if not len(parts):
        return parts
    states = np.tile(np.where(task.start == REMOVED, REMOVED, HELD).astype(np.uint8), (len(parts), 1))
    states[np.arange(len(parts)), parts] = INSTALLED
    parts = parts[~oracle.judge(states).stable]
    if len(parts):
        pairs = np.unique(np.stack([problem.part_a, problem.part_b], axis=1), axis=0)
        if edge_rows(pairs, task.boundary) is not None:
            return parts[:0]
    return parts


def filled_gaps(levels: Sequence[Level | PackedLevel], neighbours: Mask) -> dict[int, int]:
    """Return the parts that robots hold though all parts around them were there before and stand without them.

    Args:
        levels: of a search in the order of assembly.
        neighbours: which movable parts are in contact, shape (parts, parts).

    Returns:
        For each of them, on the way to the best scored state of the last level, the level before the first of those
        around it was placed.
    """
    last, row = levels[-1].states[0], 0
    parts = len(neighbours)
    placed = np.full(parts, -1)
    for number in range(len(levels) - 1, 0, -1):
        part = int(levels[number].action[row]) % parts
        row = int(levels[number].parent[row])
        if levels[number - 1].states[row, part] == REMOVED:
            placed[part] = number - 1
    found = {}
    for part in np.flatnonzero((last == HELD) & (placed >= 0)).tolist():
        around = neighbours[part]
        when = placed[around]
        if (last[around] == INSTALLED).all() and (when < placed[part]).all() and (when >= 0).any():
            found[part] = int(when[when >= 0].min())
    return found


class OpenPlaces:
    """Rules of a beam in the order of assembly that leave places open for parts to come.

    One place beside each part that cannot come last stays open until it is there. All places around a part stay open
    that robots could not let go of on the way before, since it came last.
    """

    def __init__(self, neighbours: Mask, wedges: NDArray[np.integer]) -> None:
        """Keep places open.

        Args:
            neighbours: which movable parts are in contact, shape (parts, parts).
            wedges: parts that cannot come last, shape (count,).
        """
        self._neighbours, self._wedges = neighbours, wedges
        self._beside = neighbours[wedges].astype(np.float32)

    def keep(self, frontier: Frontier, early: Sequence[int] = ()) -> bool:
        """Take the moves that close such places out of a frontier.

        Args:
            frontier: candidates of the beam.
            early: parts around which all places stay open while they are absent.

        Returns:
            Whether there were any.
        """
        parts, absent = frontier.level.shape[1], frontier.level == REMOVED
        moves, fixing = frontier.moves[:, parts:], frontier.fixing[:, parts:]
        closing = np.zeros_like(absent)
        if len(self._wedges):
            closing = self._closing(absent)
            if not (fixing & ~closing).any():  # nothing else can be fixed
                closing[:] = False
        if early:
            around = absent[:, early] @ self._neighbours[list(early)]
            around[:, early] = False
            closing |= around
        closing &= fixing
        moves[closing] = fixing[closing] = False
        return bool(closing.any())

    def _closing(self, absent: Mask) -> Mask:
        """Return the parts that are the last ones beside an absent part that cannot come last, shape (level, parts)."""
        last = absent[:, self._wedges] & (absent.astype(np.float32) @ self._beside.T == 1.0)
        return absent & (last.astype(np.float32) @ self._beside > 0.0)
