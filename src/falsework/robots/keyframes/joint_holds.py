"""Joint holds: pairs of parts that two arms cannot hold at the same time, learned from holds that fail."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, Mask, States
from falsework.robots.kernels.coordination import Swept, first_clear
from falsework.robots.keyframes.grasp_configurations import GraspConfiguration, GraspConfigurations
from falsework.stability.oracle import Stability
from falsework.stability.verdict import Verdicts

Array = NDArray[np.float64]

_MOST_GRIPS = 120
"""Grasp configurations of one arm that are compared with those of another, spread over all of them."""


class JointHolds:
    """Pairs of parts of which one could not be held while an arm held the other.

    If two arms collide with every pair of their grasps, they cannot hold the two parts at the same time, nor with more
    parts present, since grasps only become fewer. That excludes states for all orders of actions (conflict-driven
    learning: Dechter, Enhancement schemes for constraint processing, 1990).
    """

    def __init__(self, grips: GraspConfigurations) -> None:
        """Create an empty set; `grips` are the grasp configurations of the robots of a cell."""
        self.grips, self.cell = grips, grips.cell
        self.rivals: dict[int, set[int]] = defaultdict(set)
        """Parts that could not be held at the same time as a part, by that part; symmetric."""
        self.excluded = 0
        """Number of excluded pairs, each with the parts present."""
        self._excluded: dict[tuple[int, int], list[Mask]] = defaultdict(list)
        self._possible: dict[tuple[int, int], list[Mask]] = defaultdict(list)

    def learn(self, part: int, other: int, state: States) -> bool:
        """Record two parts that could not be held at the same time, and compare their grasps.

        Args:
            part, other: the parts.
            state: state in which one of them could not be held, shape (parts,).

        Returns:
            Whether that excludes further states.
        """
        self.rivals[part].add(other)
        self.rivals[other].add(part)
        pair, present = _pair(part, other), state != REMOVED
        if any((known <= present).all() for known in self._excluded[pair]):
            return False
        if any((present <= known).all() for known in self._possible[pair]):
            return False
        if self._together(part, other, state):
            self._possible[pair].append(present)
            return False
        self.exclude(part, other, state)
        return True

    def exclude(self, part: int, other: int, state: States) -> None:
        """Exclude holding two parts together where all parts of a state are present, shape (parts,)."""
        self.excluded += 1
        self._excluded[_pair(part, other)].append(state != REMOVED)

    def learn_from(self, states: States) -> bool:
        """Compare the grasps of all rivals that are held together in some states; return whether that excludes any.

        Args:
            states: shape (batch, parts).
        """
        new = False
        for state in states:
            held = set(np.flatnonzero(state == HELD).tolist())
            for part in sorted(held & self.rivals.keys()):
                for other in sorted(held & self.rivals[part]):
                    new |= part < other and self.learn(part, other, state)
        return new

    def possible(self, states: States) -> Mask:
        """Return which of the states, shape (batch, parts), hold no excluded pair; shape (batch,)."""
        found: Mask = np.ones(len(states), dtype=bool)
        for (one, other), least in self._excluded.items():
            rows = np.flatnonzero((states[:, one] == HELD) & (states[:, other] == HELD))
            for present in least if len(rows) else ():
                found[rows] &= (states[rows][:, present] == REMOVED).any(axis=1)
        return found

    def _together(self, part: int, other: int, state: States) -> bool:
        """Return whether two arms have grasps of two parts that do not collide."""
        robots = range(self.cell.robot_count)
        for one in robots:
            mine = _some(self.grips.of(one, part, state))
            for two in robots if mine else ():
                theirs = _some(self.grips.of(two, other, state)) if one != two else []
                if theirs and (self._clear(mine, theirs) >= 0).any():
                    return True
        return False

    def _clear(self, mine: Sequence[GraspConfiguration], theirs: Sequence[GraspConfiguration]) -> NDArray[np.int64]:
        return first_clear(self._swept(mine), self._swept(theirs), self.cell.margins.line)

    def _swept(self, grips: Sequence[GraspConfiguration]) -> Swept:
        return self.grips.swept(grips[0].robot, np.array([grip.configuration for grip in grips]))


class HoldingOracle:
    """Stability oracle that leaves states undecided whose held parts no arms can hold together."""

    def __init__(self, oracle: Stability, joint: JointHolds) -> None:
        """Query `oracle` for the states that `joint` does not exclude."""
        self._oracle, self._joint = oracle, joint
        self.holds_keep_stable, self.replayer = oracle.holds_keep_stable, oracle.replayer
        self.keeps = getattr(oracle, "keeps", None)

    def judge(self, states: States, *, parents: States | None = None) -> Verdicts:
        """Return verdicts as `falsework.search.problem.oracle.Oracle`; excluded states stay undecided."""
        rows = np.flatnonzero(self._joint.possible(states))
        if len(rows) == len(states):
            return self._oracle.judge(states, parents=parents)
        verdicts = Verdicts.blank(len(states))
        if len(rows):
            verdicts.put(rows, self._oracle.judge(states[rows], parents=None if parents is None else parents[rows]))
        return verdicts

    def stable(self, states: States, *, parents: States | None = None) -> Mask:
        """Return whether states are stable and can be held, shape (batch,)."""
        return self.judge(states, parents=parents).stable


def _pair(part: int, other: int) -> tuple[int, int]:
    return min(part, other), max(part, other)


def _some(grips: Sequence[GraspConfiguration]) -> Sequence[GraspConfiguration]:
    return grips[:: -(-len(grips) // _MOST_GRIPS)] if grips else grips
