"""Contact replays of the routes of a replanning request, which begin with what is built and end with its clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.state import Mask, States
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import barred_row
from falsework.stability.contact.history import Change, History, Presses, Replay
from falsework.stability.contact.newton import RESTS
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import TRUE_FRICTION
from falsework.stability.holds import Press
from falsework.utils.interruption import PIECE


@dataclass(frozen=True)
class Replayed:
    """Result of a replay of a plan in the order of assembly, with contact history."""

    stands: bool | None
    """True if every state comes to rest, False if one does not, None if the deadline came first."""
    steps: int
    """Steps of assembly that were replayed and came to rest."""
    of: int
    """Steps of the plan."""
    moved: float
    """Largest movement of a part in these steps since it was placed, m."""
    part: int = -1
    """The part that moved that far, -1 if none moved."""
    residuals: tuple[float, ...] = ()
    """Residual of each state that came to rest, shares of gravity."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of the step to each of these states."""

    def to_dict(self) -> dict[str, Any]:
        """Return the replay as a JSON object."""
        return {"stands": self.stands, "steps": self.steps, "of": self.of, "moved_mm": self.moved * 1e3}

    @property
    def summary(self) -> PlanReplay:
        """Summary of the replay, which is over."""
        falls_at = None if self.stands else len(self.residuals[: self.steps + 1])
        return PlanReplay(self.stands is True, self.moved, self.part, falls_at, self.presses)


@dataclass(eq=False)
class _Progress:
    """Replay that can be continued."""

    result: np.ndarray
    moved: np.ndarray
    part: np.ndarray
    residual: np.ndarray
    history: History | None = None
    reached: int = 0
    """States that came to rest."""
    fell: bool = False
    presses: list[tuple[Press, ...]] = field(default_factory=list)
    """Presses of the step to each of these states."""

    @classmethod
    def from_count(cls, count: int) -> _Progress:
        return cls(np.zeros(count, np.int8), np.zeros(count), np.full(count, -1, np.int32), np.full(count, np.nan))

    @property
    def over(self) -> bool:
        return self.fell or self.reached == len(self.result)


@dataclass(eq=False)
class Falls:
    """What replays that failed, or that the clock cut short, leave for the search."""

    unfinished: States | None = None
    """The last sequence whose replay the clock cut short, in the order of assembly."""
    fallen: States | None = None
    """Failing sequence that gets farthest."""
    failed_after: int = 0
    """Number of its steps that come to rest."""
    ruled_out: set[bytes] = field(default_factory=set)
    """States between the ends at which sequences failed."""


class RequestReplayer(Replayer):
    """Replayer of one request: it ends with the clock and replays no sequence twice, but goes on where it ended.

    Searches exclude the state in which a sequence fails. Every sequence has the two ends, so if an end fails, its
    neighbour is excluded.
    """

    def __init__(
        self,
        replayer: Replayer,
        clock: Deadline,
        built: tuple[States, Presses] | None = None,
    ) -> None:
        """Replay until a clock has run out.

        Args:
            replayer: replays.
            clock: as it is.
            built: states that have been built, the last of which is the first of every sequence, and the presses of
                the steps that led to each of them; sequences then begin with that history, not from rest.
        """
        super().__init__(replayer.assembly, replayer.settings, replayer.replay_settings, replayer.solver)
        self._replayer = replayer
        self._built = built
        self._prefix: _Progress | None = None
        self._clock = clock
        self._known: dict[tuple[bytes, Presses | None], _Progress] = {}
        self._requests: dict[Change, RequestReplayer] = {}
        self.falls = Falls()
        """Of this one and of replayers under other settings."""

    @property
    def iterations(self) -> int:
        """As of `Replayer`."""
        return self._replayer.iterations

    def vary(self, change: Change) -> RequestReplayer:
        """Return the replayer of the same structure under changed settings, with the same clock."""
        if change not in self._requests:
            self._requests[change] = RequestReplayer(self._replayer.vary(change), self._clock, self._built)
            self._requests[change].falls = self.falls
        return self._requests[change]

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay as `Replayer.replay` does; where several states have no history before them, without histories.

        Raises:
            DeadlineExceeded: the deadline passed; `unfinished` then is this sequence.
        """
        sequence = np.asarray(states, dtype=np.uint8)
        if history is None and len(sequence) == 1 and (built := self._replay_built()) is not None:
            if not built.over:
                self.falls.unfinished = sequence
                raise DeadlineExceeded
            result, histories = np.full(1, 0 if built.fell else RESTS), [] if built.fell else [built.history]
            ends = built.moved[-1:], built.part[-1:], built.residual[-1:]
            return Replay(result, *ends, tuple(filter(None, histories)))
        if history is not None or len(sequence) < 2:
            return self._within_time(sequence, history, presses)
        if presses is not None and self._built is not None:
            presses = (*self._built[1], *presses[1:])
        progress, before = self._continue(sequence, presses), self._before
        if not progress.over:
            self.falls.unfinished = sequence
            raise DeadlineExceeded
        result = progress.result[before:].copy()
        if progress.fell:
            result[:] = RESTS
            result[barred_row(progress.reached - before, len(sequence)) or len(sequence) :] = 0
        arrays = progress.moved[before:], progress.part[before:], progress.residual[before:]
        return Replay(result, *arrays, presses=tuple(progress.presses[before:]))

    def replay_in_time(self, states: States, presses: Presses | None = None) -> Replayed:
        """Replay a sequence, or as much of it as the deadline allows; with a reserve, under the true friction too.

        Args:
            states: in the order of assembly, shape (steps + 1, parts).
            presses: of the steps that lead to each state, those that have been built included; chosen where they are
                needed if not given.

        Returns:
            The result for the states that have been built and the sequence, together.
        """
        progress = self._continue(np.asarray(states, dtype=np.uint8), presses)
        at_rest = slice(progress.reached)
        stands = False if progress.fell else True if progress.over else None
        moved, done = progress.moved[at_rest], tuple(progress.presses)
        most = int(np.argmax(moved)) if len(moved) else -1
        found = Replayed(
            stands,
            max(progress.reached - 1, 0),
            len(progress.result) - 1,
            float(moved[most]) if most >= 0 else 0.0,
            int(progress.part[most]) if most >= 0 else -1,
            tuple(progress.residual[at_rest].tolist()),
            done,
        )
        if stands and self.settings.reserve != 1.0:
            plain = self.vary(TRUE_FRICTION).replay_in_time(states, done)
            found = replace(found, stands=plain.stands, steps=plain.steps)
        return found

    def executed_fails_at(self) -> int | None:
        """Return the first state that has been built and does not come to rest; None if all do, as far as time allows.

        A sequence that fails there fails whatever comes after.
        """
        prefix = self._replay_built()
        return prefix.reached if prefix is not None and prefix.fell else None

    def has_built(self, states: States) -> Mask:
        """Return which states are the one that has been built, if it comes to rest as far as time allows."""
        if self._built is None or self.executed_fails_at() is not None:
            return np.zeros(len(states), dtype=bool)
        return (states == self._built[0][-1]).all(axis=-1)

    @property
    def _before(self) -> int:
        """Number of states before the first of every sequence."""
        return 0 if self._built is None else len(self._built[0]) - 1

    def _replay_built(self) -> _Progress | None:
        if self._built is not None and (self._prefix is None or not self._prefix.over):
            states, presses = self._built
            self._prefix = self._prefix or _Progress.from_count(len(states))
            self._advance(self._prefix, states, tuple(map(tuple, presses)))
        return self._prefix

    def _begin(self, count: int) -> _Progress:
        """Return the progress of a sequence of some states, as far as it has been built."""
        progress, prefix = _Progress.from_count(self._before + count), self._replay_built()
        if prefix is not None:
            for name in ("result", "moved", "part", "residual"):
                getattr(progress, name)[: len(prefix.result)] = getattr(prefix, name)
            progress.history, progress.reached, progress.fell = prefix.history, prefix.reached, prefix.fell
            progress.presses = [*prefix.presses]
        return progress

    def _continue(self, states: States, presses: Presses | None) -> _Progress:
        given = None if presses is None else tuple(map(tuple, presses))
        key = states.tobytes(), given
        if key not in self._known:
            self._known[key] = self._begin(len(states))
        progress, before = self._known[key], self._before
        if progress.over:
            return progress
        whole = states if self._built is None else np.concatenate([self._built[0][:before], states])
        if given is None and progress.reached <= before and self._built is not None:
            self._advance(progress, whole, tuple(map(tuple, self._built[1])), upto=before + 1)
        self._advance(progress, whole, given)
        if progress.fell:
            self._note(states, progress.reached - before)
        if progress.over:
            progress.history = None  # a megabyte for a large structure, and nothing comes after
        return progress

    def _advance(self, progress: _Progress, states: States, given: Presses | None, *, upto: int | None = None) -> None:
        """Replay further states of a sequence, as far as the clock allows."""
        count = len(states) if upto is None else upto
        while not progress.fell and progress.reached < count:
            first = max(progress.reached - 1, 0)  # the last state at rest, whose history is known
            rows = slice(first, min(first + PIECE + 1, count))
            try:
                found = self._within_time(states[rows], progress.history, given and given[rows])
            except DeadlineExceeded:
                break
            done = int(np.argmin(np.append(found.stands == RESTS, False)))
            fresh = slice(progress.reached, first + done)
            skipped = progress.reached - first
            for name in ("moved", "part", "residual"):
                getattr(progress, name)[fresh] = getattr(found, name)[skipped:done]
            progress.result[fresh] = RESTS
            progress.fell = done < len(states[rows])
            if done:
                progress.presses += found.presses[skipped:done]
                progress.reached, progress.history = first + done, found.histories[done - 1]

    def _within_time(self, states: States, history: History | None, presses: Presses | None) -> Replay:
        """Replay as `Replayer.replay` does, until the clock has run out."""
        with self._clock.piece("replays"):
            return self._replayer.replay(states, history, presses)

    def _note(self, states: States, row: int) -> None:
        """Record that a sequence fails in state `row`."""
        falls = self.falls
        if falls.fallen is None or row - 1 > falls.failed_after:
            falls.fallen, falls.failed_after = states, max(row - 1, 0)
        inner = barred_row(row, len(states))
        if inner is not None:
            falls.ruled_out.add(states[inner].tobytes())
