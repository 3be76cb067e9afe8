"""Joint holds: two or three parts that arms cannot hold at the same time, learned from holds that fail."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from falsework.assembly.state import HELD, REMOVED, Mask, States
from falsework.robots.kernels.coordination import Swept, conflicts
from falsework.robots.keyframes.grasp_configurations import GraspConfiguration, GraspConfigurations
from falsework.robots.schedule.swept_bodies import SweptBodies
from falsework.search.problem.oracle import WrappedOracle
from falsework.stability.oracle import StabilityOracle
from falsework.stability.verdict import Verdicts

Group = tuple[int, ...]
"""Two or three parts, ascending."""
Usable = Callable[[GraspConfiguration, int, States], bool]

_MOST_GRIPS = 60
"""Grasp configurations of one arm that are compared with those of others, spread over all of them."""


class JointHolds:
    """Groups of parts of which one could not be held while arms held the others.

    If some arms collide with every choice of grasps, they cannot hold these parts at the same time, nor with more parts
    present, since grasps only become fewer. That excludes states for all orders of actions (conflict-driven learning:
    Dechter, Enhancement schemes for constraint processing, 1990).
    """

    def __init__(self, grips: GraspConfigurations, usable: Usable) -> None:
        """Compare only grasps that are usable: an arm can approach them, and the part leave with them later."""
        self.grips, self.cell, self._usable = grips, grips.cell, usable
        self._bodies = SweptBodies(grips.cache.world)
        self.rivals: set[Group] = set()
        """Groups that could not be held at the same time."""
        self.excluded = 0
        """Number of excluded groups, each with the parts present."""
        self._excluded: dict[Group, list[Mask]] = defaultdict(list)
        self._possible: dict[Group, list[Mask]] = defaultdict(list)

    def forget(self) -> None:
        """Allow everything again, since other grasps have become possible."""
        self._excluded.clear()
        self._possible.clear()

    def learn(self, parts: Iterable[int], state: States) -> bool:
        """Record two or three parts that could not be held at the same time, and compare their grasps.

        Args:
            state: state in which one of them could not be held, shape (parts,).

        Returns:
            Whether that excludes further states.
        """
        group, present = tuple(sorted(parts)), state != REMOVED
        self.rivals.add(group)
        smaller = (group, *itertools.combinations(group, 2))
        if any((known <= present).all() for some in smaller for known in self._excluded.get(some, ())):
            return False
        if any((present <= known).all() for known in self._possible[group]):
            return False
        if self._together(group, state):
            self._possible[group].append(present)
            return False
        self.exclude(group, state)
        return True

    def exclude(self, parts: Iterable[int], state: States) -> None:
        """Exclude holding some parts together where all parts of a state are present, shape (parts,)."""
        self.excluded += 1
        self._excluded[tuple(sorted(parts))].append(state != REMOVED)

    def learn_from(self, states: States) -> bool:
        """Compare the grasps of rivals held together in states, (batch, parts); return whether that excludes any."""
        new = False
        for state in states:
            held = set(np.flatnonzero(state == HELD).tolist())
            for group in sorted(self.rivals):
                new |= held.issuperset(group) and self.learn(group, state)
        return new

    def possible(self, states: States) -> Mask:
        """Return which of the states, shape (batch, parts), hold no excluded group; shape (batch,)."""
        found: Mask = np.ones(len(states), dtype=bool)
        for group, least in self._excluded.items():
            rows = np.flatnonzero((states[:, group] == HELD).all(axis=1))
            for present in least if len(rows) else ():
                found[rows] &= (states[rows][:, present] == REMOVED).any(axis=1)
        return found

    def _together(self, group: Group, state: States) -> bool:
        """Return whether arms have usable grasps of some parts that do not collide."""
        robots = range(self.cell.robot_count)
        grips = {(robot, part): _some(self.grips.get(robot, part, state)) for robot in robots for part in group}
        usable = {key: np.ones(len(found), dtype=bool) for key, found in grips.items()}
        clear: dict[tuple[tuple[int, int], tuple[int, int]], Mask] = {}
        for chosen in itertools.permutations(robots, len(group)):
            keys = list(zip(chosen, group, strict=True))
            if not all(grips[key] for key in keys):
                continue
            for pair in itertools.combinations(keys, 2):
                if pair not in clear:
                    clear[pair] = self.clear(*(grips[key] for key in pair))
            while (rows := _compatible([usable[key] for key in keys], keys, clear)) is not None:
                # Only grasps that do not collide are asked whether they are usable.
                useless = [
                    (key, row)
                    for key, row in zip(keys, rows, strict=True)
                    if not self._usable(grips[key][row], key[1], state)
                ]
                if not useless:
                    return True
                for key, row in useless:
                    usable[key][row] = False
        return False

    def clear(self, mine: Sequence[GraspConfiguration], theirs: Sequence[GraspConfiguration]) -> Mask:
        """Return which grasps of two arms do not collide, shape (mine, theirs)."""
        one, other = self.swept(mine), self.swept(theirs)
        return ~conflicts((one, one), (other, other), self.cell.margins.line)

    def swept(self, grips: Sequence[GraspConfiguration]) -> Swept:
        """Return the bodies of an arm in configurations of it."""
        return self._bodies.resting(grips[0].robot, np.array([grip.configuration for grip in grips]), None)


class HoldingOracle(WrappedOracle):
    """Stability oracle that leaves states undecided whose held parts no arms can hold together."""

    def __init__(self, oracle: StabilityOracle, joint: JointHolds) -> None:
        super().__init__(oracle)
        self._joint = joint

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts as `falsework.search.problem.oracle.Oracle`; excluded states stay undecided."""
        rows = np.flatnonzero(self._joint.possible(states))
        if len(rows) == len(states):
            return self.oracle.verdicts(states, near=near, require_certificate=require_certificate)
        verdicts = Verdicts.all_undecided(len(states))
        if len(rows):
            verdicts.put(rows, self.oracle.verdicts(states[rows], near=None if near is None else near[rows]))
        return verdicts

    def plausible(self, states: States, parents: States) -> Mask:
        """Return which states can be held, and may be at rest: `StabilityOracle.plausible`. Shape (batch,)."""
        found = self._joint.possible(states)
        found[found] = self.oracle.plausible(states[found], parents[found])
        return found


def _compatible(
    usable: Sequence[Mask], keys: Sequence[tuple[int, int]], clear: dict[tuple[tuple[int, int], tuple[int, int]], Mask]
) -> list[int] | None:
    """Return one grasp for each arm and part, of which no two collide; None if there are none."""
    if not usable:
        return []
    for row in np.flatnonzero(usable[0]).tolist():
        left = [mask & clear[keys[0], key][row] for mask, key in zip(usable[1:], keys[1:], strict=True)]
        if all(mask.any() for mask in left):
            rest = _compatible(left, keys[1:], clear)
            if rest is not None:
                return [row, *rest]
    return None


def _some(grips: Sequence[GraspConfiguration]) -> Sequence[GraspConfiguration]:
    return grips[:: -(-len(grips) // _MOST_GRIPS)] if grips else grips
