"""Ways by which a beam reaches its states: deferred verdicts, and contact histories."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Frontier, Level, PackedLevel, Rows
from falsework.search.beam.replays import Replays
from falsework.search.problem.oracle import CountingOracle

if TYPE_CHECKING:
    from falsework.stability.contact.varied_replay import AnyReplayer


class BeamPaths:
    """Ways to the states of a beam."""

    def __init__(self, levels: list[Level | PackedLevel], judge: CountingOracle, replayer: AnyReplayer | None) -> None:
        """Begin with nothing.

        Args:
            levels: of the beam; the list that the beam itself changes.
            judge: asked for the deferred verdicts.
            replayer: of the structure; None where contact histories do not matter.
        """
        self._levels, self._judge = levels, judge
        self.replays = None if replayer is None else Replays(replayer, levels)

    def stable_ancestors(self) -> States:
        """Return for each state of the last level the nearest on the way to it that is known to be stable."""
        states = self._levels[-1].states.copy()
        at = np.arange(len(states))
        left = at.copy()
        for here, before in zip(self._levels[:0:-1], self._levels[-2::-1], strict=True):
            left = left[here.grounded[at[left]] <= 0]
            if not len(left):
                break
            at[left] = here.parent[at[left]]
            states[left] = before.states[at[left]]
        return states

    def stable(self, rows: NDArray[np.int64], level: int = -1) -> Mask:
        """Request the deferred verdicts on the ways to states of a level; return which ways are stable.

        Args:
            rows: states of the level.
            level: index of the level.

        Returns:
            Shape (rows,).
        """
        here = self._levels[level]
        waiting = np.unique(rows[here.grounded[rows] == 0])
        if len(waiting):
            below = self.stable(here.parent[waiting], level - 1)
            here.grounded[waiting[~below]] = -1
            waiting = waiting[below]
            if len(waiting):
                parents = self._levels[level - 1].states[here.parent[waiting]]
                stable = self._judge.stable(here.states[waiting], parents)
                here.grounded[waiting] = np.where(stable, 1, -1)
        return here.grounded[rows] > 0

    def verifier(self, frontier: Frontier) -> PathVerifier:
        """Return the test of the ways to candidates for the next level."""
        return PathVerifier(self, frontier, self._judge)


class PathVerifier:
    """Test of stable candidates: their ways are stable too, and come to rest with contact history."""

    def __init__(self, paths: BeamPaths, frontier: Frontier, judge: CountingOracle) -> None:
        self.refused = False
        """Whether a candidate failed the test."""
        self._paths, self._frontier, self._judge = paths, frontier, judge

    def __call__(self, rows: Rows) -> Mask:
        """See `falsework.search.beam.selection.Verifier`."""
        frontier, replays = self._frontier, self._paths.replays
        good = self._paths.stable(frontier.parent(rows))
        if replays is not None and good.any():
            rows = rows[good]
            rests = replays.comes_to_rest(rows, frontier.parent(rows), frontier.states(rows))
            self._judge.sliding += int((~rests).sum())
            good[good] = rests
        self.refused = self.refused or not good.all()
        return good


__all__ = ["BeamPaths", "PathVerifier"]
