"""Paths by which a search reaches its states: deferred verdicts, and in the order of assembly contact histories."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.beam.frontier import Frontier, Level, PackedLevel, Rows
from falsework.search.beam.settings import MEMORY, SLIP
from falsework.search.problem.oracle import CountingOracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.stability.contact.build_verifier import StepCertificate
from falsework.stability.contact.varied_replay import RouteReplay

if TYPE_CHECKING:
    from falsework.stability.contact.history import History, Presses
    from falsework.stability.contact.replay import Replayer

Array = NDArray[np.float64]
K = TypeVar("K")

_NOTHING: Array = np.zeros((0, 0, 6))


class PathHistories(Generic[K]):
    """Contact histories of states along the paths by which a search reached them; the oldest are forgotten first."""

    def __init__(
        self,
        replayer: Replayer,
        before: Callable[[K], K | None],
        state: Callable[[K], States],
        room: int = MEMORY,
    ) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            before: returns what names the state from which a state was reached; None for the first.
            state: returns the state of a name, shape (parts,).
            room: memory for histories, bytes.
        """
        self._replayer, self._before, self._state, self._room = replayer, before, state, room
        self._changes = replayer.changes
        self._known: dict[K, History | None] = {}
        """None where the path to a state does not come to rest."""
        self._steps: dict[K, tuple[float, int, StepCertificate]] = {}
        """Of the states at rest: the largest movement of a part, that part, and the certificate of the step, whose
        displacement is empty beyond the memory for them."""
        self._still = _NOTHING
        self.replays = [0, 0, 0]
        """Steps at rest, their iterations, and those of steps that failed."""

    @property
    def lost(self) -> float:
        """Iterations of the steps that failed, divided by the mean of those at rest."""
        taken, spent, lost = self.replays
        return lost * taken / max(spent, 1)

    def step(self, before: K, after: States) -> History | None:
        """Return the history of a state reached from another; None where the path to it does not come to rest."""
        history = self._of(before)
        if history is None:
            return None
        begun = self._replayer.iterations
        rests, history = self._replayer.step(history, self._state(before), after)
        spent = self._replayer.iterations - begun
        if not rests:
            self.replays[2] += spent
            return None
        self.replays[0] += 1
        self.replays[1] += spent
        return history

    def slips(self, before: K, history: History) -> bool:
        """Return whether the step from a state to one with this history moves parts far, though they come to rest."""
        known = self._of(before)
        return known is not None and self._replayer.slip(known, history) > SLIP

    def keep(self, name: K, history: History | None) -> None:
        """Remember the history of a state."""
        self._known[name] = history
        if history is None:
            return
        step = StepCertificate(self._kept(history.track), history.torn.copy(), history.presses)
        self._steps[name] = history.moved, history.part, step
        while len(self._known) > max(self._room // max(history.nbytes, 1), 4):
            del self._known[next(iter(self._known))]

    def forget(self, gone: Callable[[K], bool]) -> None:
        """Forget states that are no longer reached as they were."""
        for known in (self._known, self._steps):
            for name in [name for name in known if gone(name)]:
                del known[name]

    def built(self, last: K) -> tuple[States, Presses] | None:
        """Return the states on the path to a state, and their presses; None where it does not come to rest."""
        if self._of(last) is None:
            return None
        path = self._path(last)
        return np.array([self._state(at) for at in path]), [self._steps[at][2].presses for at in path]

    def summary(self, last: K) -> PlanReplay | None:
        """Return the replay of the path to a state; None where it does not come to rest."""
        if self._of(last) is None:
            return None
        path = [self._steps[name] for name in self._path(last)]
        most = max((0.0, -1), *((moved, part) for moved, part, _ in path))
        steps = [step for _, _, step in path]
        known = all(len(step.displacement) for step in steps)
        return PlanReplay(True, *most, None, tuple(step.presses for step in steps), tuple(steps) if known else ())

    def _path(self, name: K) -> list[K]:
        """Return the names of the states on the path to a state, from the first on."""
        path = [name]
        while (before := self._before(path[-1])) is not None:
            path.append(before)
        return path[::-1]

    def _of(self, name: K) -> History | None:
        """Return the history of a state, along its path from the last state whose history is known."""
        if self._changes != self._replayer.changes:
            self._learn(name)
        path = [name]
        while path[-1] not in self._known and (before := self._before(path[-1])) is not None:
            path.append(before)
        last = path.pop()
        if last not in self._known:
            start = self._replayer.replay(self._state(last)[None])
            self.keep(last, start.histories[0] if start.histories else None)
        history = self._known[last]
        for after in reversed(path):
            if history is not None:
                rests, history = self._replayer.step(history, self._state(last), self._state(after))
                history = history if rests else None
            self.keep(after, history)
            last = after
        return history

    def _learn(self, name: K) -> None:
        """Replay the path to a state under the changes of settings that are new, and forget what is not on it."""
        replayer, count, path, end = self._replayer, len(self._changes), self._path(name), 0
        if replayer.changes[:count] == self._changes:
            end = [*(at in self._steps for at in path), False].index(False)
        states = np.array([self._state(at) for at in path[:end]])
        presses = [self._steps[at][2].presses for at in path[:end]]
        histories = [self._known.get(at) for at in path[:end]]
        for change in replayer.changes[count:]:
            if not end:  # the first state does not come to rest
                break
            states, presses, route = states[:end], presses[:end], RouteReplay(replayer, change)
            end = route.begin(states, presses)
            for first, found in route.pieces(states):
                for history in found[end - first :]:
                    if (known := histories[end]) is not None:
                        histories[end] = replace(known, changed=(*known.changed, history))
                    end += 1
        self._changes = replayer.changes
        known = zip(path[:end], histories, strict=False)
        self._known = {at: history for at, history in known if history is not None}
        self._steps = {at: self._steps[at] for at in path[:end]}

    def _kept(self, track: Array | None) -> Array:
        """Return the displacement of a step to keep: most steps only hold a part, and share one of zeros."""
        if track is None or len(self._steps) * track.nbytes > 2 * self._room:
            return _NOTHING
        if track.any():
            return track.copy()
        if self._still.shape != track.shape:
            self._still = np.zeros_like(track)
        return self._still


class BeamPaths:
    """Paths to the states of a beam."""

    def __init__(
        self,
        levels: list[Level | PackedLevel],
        judge: CountingOracle,
        replayer: Replayer | None,
        history_bytes: int,
    ) -> None:
        """Begin with nothing.

        Args:
            levels: of the beam; the list that the beam itself changes.
            judge: asked for the deferred verdicts.
            replayer: of the structure; None where contact histories do not matter.
            history_bytes: memory for histories.
        """
        self._levels, self._judge = levels, judge
        self.refused = False
        """Whether a candidate for the next level failed the test of its path."""
        self._next: dict[int, History] = {}
        """Histories of candidates for the next level."""
        self._histories: PathHistories[tuple[int, int]] | None = None
        """By level and row."""
        if replayer is not None:
            self._histories = PathHistories(
                replayer, self._before, lambda at: levels[at[0]].state(at[1]), history_bytes
            )

    def _before(self, at: tuple[int, int]) -> tuple[int, int] | None:
        level, row = at
        return (level - 1, int(self._levels[level].parent[row])) if level else None

    @property
    def lost(self) -> float:
        """See `PathHistories.lost`; 0 where contact histories do not matter."""
        return 0.0 if self._histories is None else self._histories.lost

    @property
    def replays(self) -> list[int]:
        """See `PathHistories.replays`; zero where contact histories do not matter."""
        return [0, 0, 0] if self._histories is None else self._histories.replays

    @replays.setter
    def replays(self, known: list[int]) -> None:
        if self._histories is not None:
            self._histories.replays = known

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

    def verifier(self, frontier: Frontier, rows: Rows, *, waits: bool = False) -> Mask:
        """Return which stable candidates are reached by paths that are stable too, and come to rest. Shape (rows,).

        If it `waits`, a step that moves parts far counts as failed while a robot is free to prevent it.
        """
        good = self.stable(frontier.parent(rows))
        if self._histories is not None and good.any():
            rows, level = rows[good], len(self._levels) - 1
            rests = np.zeros(len(rows), dtype=bool)
            for k, (row, origin, state) in enumerate(
                zip(rows, frontier.parent(rows), frontier.states(rows), strict=True)
            ):
                before = level, int(origin)
                history = self._histories.step(before, state)
                hasty = waits and history is not None and bool(frontier.fixing[origin].any())
                if history is not None and not (hasty and self._histories.slips(before, history)):
                    rests[k], self._next[int(row)] = True, history
            self._judge.sliding += int((~rests).sum())
            good[good] = rests
        self.refused = self.refused or not good.all()
        return good

    def keep(self, rows: Rows) -> None:
        """Take over the histories of the candidates that became the last level."""
        for place, row in enumerate(rows.tolist()):
            if self._histories is not None and row in self._next:
                self._histories.keep((len(self._levels) - 1, place), self._next[row])
        self._next = {}

    def rewind(self, level: int) -> None:
        """Forget all levels after `level`."""
        self._next = {}
        if self._histories is not None:
            self._histories.forget(lambda at: at[0] > level)

    def built(self) -> tuple[States, Presses] | None:
        """Return what all paths to the last level have in common, see `PathHistories.built`."""
        number, rows = len(self._levels) - 1, np.arange(len(self._levels[-1].parent))
        while number and len(rows) > 1:
            number, rows = number - 1, np.unique(self._levels[number].parent[rows])
        return None if self._histories is None else self._histories.built((number, int(rows[0])))

    def summary(self) -> PlanReplay | None:
        """Return the replay of the path to the first state of the last level; None where it does not come to rest."""
        return None if self._histories is None else self._histories.summary((len(self._levels) - 1, 0))
