"""Places that a beam leaves open for parts which do not stand where they come last.

In a replay parts are inserted unstressed. A wedge at the edge of an opening stands because its neighbours press on it;
inserted when all of them are in place, it slides out as soon as the robot lets go of it. So one of them must come
later. Verdicts do not show that, since they load all parts at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.search.beam.frontier import Frontier
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


class OpenPlaces:
    """Rule of a beam in the order of assembly: one place beside such a part stays open until the part is there."""

    def __init__(self, neighbours: Mask, parts: NDArray[np.integer]) -> None:
        """Keep places open.

        Args:
            neighbours: which movable parts are in contact, shape (parts, parts).
            parts: that cannot come last, shape (count,).
        """
        self._parts, self._beside = parts, neighbours[parts].astype(np.float32)

    def keep(self, frontier: Frontier) -> bool:
        """Take the moves that close a place out of a frontier, unless no other part can be fixed.

        Returns:
            Whether there were any.
        """
        parts = frontier.level.shape[1]
        closing, fixing = self._closing(frontier.level), frontier.fixing[:, parts:]
        if not (fixing & closing).any() or not (fixing & ~closing).any():
            return False
        frontier.moves[:, parts:][closing] = False
        fixing[closing] = False
        return True

    def _closing(self, level: States) -> Mask:
        """Return the parts that are the last ones beside an absent part of the rule, shape (level, parts)."""
        absent = level == REMOVED
        last = absent[:, self._parts] & (absent.astype(np.float32) @ self._beside.T == 1.0)
        return absent & (last.astype(np.float32) @ self._beside > 0.0)
