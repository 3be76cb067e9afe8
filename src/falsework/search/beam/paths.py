"""Paths by which a beam reaches its states: deferred verdicts, and in the order of assembly contact histories."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Frontier, Level, PackedLevel, Rows
from falsework.search.problem.oracle import CountingOracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.stability.contact.build_verifier import StepCertificate

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.varied_replay import AnyReplayer

Array = NDArray[np.float64]

_NOTHING: Array = np.zeros((0, 0, 6))


class BeamPaths:
    """Paths to the states of a beam."""

    def __init__(
        self,
        levels: list[Level | PackedLevel],
        judge: CountingOracle,
        replayer: AnyReplayer | None,
        history_bytes: int,
    ) -> None:
        """Begin with nothing.

        Args:
            levels: of the beam; the list that the beam itself changes.
            judge: asked for the deferred verdicts.
            replayer: of the structure; None where contact histories do not matter.
            history_bytes: memory for histories.
        """
        self._history_bytes = history_bytes
        self._levels, self._judge, self._replayer = levels, judge, replayer
        self.refused = False
        """Whether a candidate for the next level failed the test of its path."""
        self._next: dict[int, History] = {}
        """Histories of candidates for the next level."""
        self._most: float = np.inf
        self._still = _NOTHING
        self._known: list[dict[int, History | None]] = []
        self._known_steps: list[dict[int, tuple[float, int, StepCertificate]]] = []
        """Of the states at rest: the largest movement of a part, that part, and the certificate of the step, whose
        displacement is empty beyond the memory for them."""

    def stable_ancestors(self) -> States:
        """Return for each state of the last level the nearest on the path to it that is known to be stable."""
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
        """Request the deferred verdicts on the paths to states of a level; return which are stable, shape (rows,).

        Args:
            rows: states of the level.
            level: index of the level.
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

    def verifier(self, frontier: Frontier, rows: Rows) -> Mask:
        """Return which stable candidates are reached by paths that are stable too, and come to rest. Shape (rows,)."""
        good = self.stable(frontier.parent(rows))
        if self._replayer is not None and good.any():
            rows, level = rows[good], len(self._levels) - 1
            rests = np.zeros(len(rows), dtype=bool)
            origins = self._levels[level].states
            for k, (row, origin, state) in enumerate(
                zip(rows, frontier.parent(rows), frontier.states(rows), strict=True)
            ):
                history = self._history(level, int(origin))
                if history is not None:
                    rests[k], after = self._replayer.step(history, origins[origin], state)
                    if rests[k]:
                        self._next[int(row)] = after
            self._judge.sliding += int((~rests).sum())
            good[good] = rests
        self.refused = self.refused or not good.all()
        return good

    def keep(self, rows: Rows) -> None:
        """Take over the histories of the candidates that became the last level, and forget the earliest beyond room."""
        for place, row in enumerate(rows.tolist()):
            if row in self._next:
                self._put(len(self._levels) - 1, place, self._next[row])
        self._next = {}
        count = sum(map(len, self._known))
        for known in self._known[1:-1]:
            if count <= self._most:
                break
            count -= len(known)
            known.clear()

    def rewind(self, level: int) -> None:
        """Forget all levels after `level`."""
        self._next = {}
        del self._known[level + 1 :], self._known_steps[level + 1 :]

    def summary(self) -> PlanReplay | None:
        """Return the replay of the path to the first state of the last level; None where it does not come to rest."""
        row, level = 0, len(self._levels) - 1
        if self._replayer is None or self._history(level, row) is None:
            return None
        most: tuple[float, int] = (0.0, -1)
        steps: list[StepCertificate] = []
        for number in range(level, -1, -1):
            moved, part, step = self._known_steps[number][row]
            most = max(most, (moved, part))
            steps.append(step)
            row = int(self._levels[number].parent[row])
        steps.reverse()
        known = all(len(step.displacement) for step in steps)
        presses = tuple(step.presses for step in steps)
        return PlanReplay(True, *most, None, presses, tuple(steps) if known else ())

    def _history(self, level: int, row: int) -> History | None:
        """Return the history of a state of a level; None where the path to it does not stand."""
        replayer = self._replayer
        assert replayer is not None
        self._fit(len(self._levels))
        path = [row]  # back to a state whose history is known, or to the first level
        while path[-1] not in self._known[level + 1 - len(path)] and len(path) <= level:
            path.append(int(self._levels[level + 1 - len(path)].parent[path[-1]]))
        first = level + 1 - len(path)
        if path[-1] not in self._known[first]:
            start = replayer.replay(self._levels[0].states[path[-1]][None])
            self._put(0, path[-1], start.histories[0] if start.histories else None)
        history = self._known[first][path[-1]]
        for at in range(first + 1, level + 1):
            before, after = path[level + 1 - at], path[level - at]
            if history is not None:
                states = self._levels[at - 1].states[before], self._levels[at].states[after]
                rests, history = replayer.step(history, *states)
                history = history if rests else None
            self._put(at, after, history)
        return history

    def _put(self, level: int, row: int, history: History | None) -> None:
        """Remember the history of a state, None where the path to it does not stand."""
        self._fit(level + 1)
        self._known[level][row] = history
        if history is not None:
            self._most = self._history_bytes // max(history.nbytes, 1)
            step = StepCertificate(self._kept(history.track), history.torn.copy(), history.presses)
            self._known_steps[level][row] = history.moved, history.part, step

    def _kept(self, track: Array | None) -> Array:
        """Return the displacement of a step to keep: most steps only hold a part, and share one of zeros."""
        if track is None or len(self._levels) * track.nbytes > 2 * self._history_bytes:
            return _NOTHING
        if track.any():
            return track.copy()
        if self._still.shape != track.shape:
            self._still = np.zeros_like(track)
        return self._still

    def _fit(self, count: int) -> None:
        """Make room for the histories of `count` levels."""
        self._known.extend({} for _ in range(count - len(self._known)))
        self._known_steps.extend({} for _ in range(count - len(self._known_steps)))
