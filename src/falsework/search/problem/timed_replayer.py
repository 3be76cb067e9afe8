"""Contact replays of candidate routes within the deadline of a request."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.state import States
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.stability.contact.newton import RESTS
from falsework.stability.contact.replay import History, Presses, Replay, Replayer, ReplaySettings
from falsework.stability.holds import Press
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings

_PIECE = 8
"""Steps replayed between two checks of the time."""


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

    def to_dict(self) -> dict[str, Any]:
        """Return the replay as a JSON object."""
        return {"stands": self.stands, "steps": self.steps, "of": self.of, "largest_movement": self.moved}


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
    def begin(cls, count: int) -> _Progress:
        return cls(np.zeros(count, np.int8), np.zeros(count), np.full(count, -1, np.int32), np.full(count, np.nan))

    @property
    def over(self) -> bool:
        return self.fell or self.reached == len(self.result)


class DeadlineReplayer:
    """Replayer that checks the deadline between steps and replays no sequence twice.

    Searches use it like a `Replayer`. They exclude the state in which a sequence fails. Every sequence has the two
    ends, so if an end fails, its neighbour is excluded.
    """

    def __init__(self, replayer: Replayer, clock: Deadline, between: Callable[[], None] = lambda: None) -> None:
        """Replay until `clock` has run out; call `between` before each few steps."""
        self.unfinished: States | None = None
        """The last sequence whose replay the clock cut short, in the order of assembly."""
        self.fallen: States | None = None
        """Failing sequence that gets farthest."""
        self.fell_after = 0
        """Number of its steps that come to rest."""
        self.ruled_out: set[bytes] = set()
        """States between the ends at which sequences failed."""
        self._replayer = replayer
        self._clock = clock
        self._between = between
        self._known: dict[bytes, _Progress] = {}

    @property
    def problem(self) -> Problem:
        """As of `Replayer`."""
        return self._replayer.problem

    @property
    def settings(self) -> StabilitySettings:
        """As of `Replayer`."""
        return self._replayer.settings

    def vary(self, settings: StabilitySettings, replay: ReplaySettings) -> DeadlineReplayer:
        """Return a replayer of the same structure under other settings, with the same clock."""
        return DeadlineReplayer(self._replayer.vary(settings, replay), self._clock, self._between)

    def first_tipping(self, states: States, histories: Sequence[History]) -> int | None:
        """Return the first state that a small motion leaves, see `Replayer.first_tipping`."""
        self._look()
        with self._clock.timed("replays"):
            return self._replayer.first_tipping(states, histories)

    def unlimited(self) -> Replayer:
        """Return the replayer that does not look at the deadline, for another thread.

        Its work is in no account of time: it takes place beside that of the search.
        """
        return self._replayer

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay as `Replayer.replay`, without histories unless a single state is replayed.

        Raises:
            DeadlineExceeded: the deadline passed; `unfinished` then is this sequence.
        """
        sequence = np.asarray(states, dtype=np.uint8)
        if history is not None or presses is not None or len(sequence) < 2:
            self._look()
            with self._clock.timed("replays"):
                return self._replayer.replay(sequence, history, presses)
        progress = self._go_on(sequence)
        if not progress.over:
            self.unfinished = sequence
            raise DeadlineExceeded
        result = progress.result.copy()
        if progress.fell:
            result[:] = RESTS
            result[_inner(progress.reached, len(sequence)) or len(sequence) :] = 0
        return Replay(result, progress.moved, progress.part, progress.residual, 0.0, presses=tuple(progress.presses))

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        """Replay a step as `Replayer.step`.

        Raises:
            DeadlineExceeded: the deadline passed.
        """
        self._look()
        with self._clock.timed("replays"):
            return self._replayer.step(history, before, after)

    def as_time_allows(self, states: States) -> Replayed:
        """Replay a sequence, or as much of it as the deadline allows.

        Args:
            states: in the order of assembly, shape (steps + 1, parts).
        """
        progress = self._go_on(np.asarray(states, dtype=np.uint8))
        stands = False if progress.fell else True if progress.over else None
        moved = float(progress.moved[: progress.reached].max(initial=0.0))
        return Replayed(stands, max(progress.reached - 1, 0), len(states) - 1, moved)

    def _look(self) -> None:
        self._between()
        if self._clock.passed:
            raise DeadlineExceeded

    def _go_on(self, states: States) -> _Progress:
        progress = self._known.setdefault(states.tobytes(), _Progress.begin(len(states)))
        while not progress.over:
            self._between()
            if self._clock.passed:
                break
            first = max(progress.reached - 1, 0)  # the last state at rest, whose history is known
            rows = slice(first, first + _PIECE + 1)
            with self._clock.timed("replays"):
                found = self._replayer.replay(states[rows], progress.history)
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
            if progress.fell:
                self._note(states, progress.reached)
            if progress.over:
                progress.history = None  # a megabyte for a large structure, and nothing comes after
        return progress

    def _note(self, states: States, row: int) -> None:
        """Record that a sequence fails in state `row`."""
        if self.fallen is None or row - 1 > self.fell_after:
            self.fallen, self.fell_after = states, max(row - 1, 0)
        inner = _inner(row, len(states))
        if inner is not None:
            self.ruled_out.add(states[inner].tobytes())


def _inner(row: int, count: int) -> int | None:
    """Return the state to exclude if a sequence of `count` states fails in state `row`; None if it has only ends."""
    return min(max(row, 1), count - 2) if count > 2 else None
