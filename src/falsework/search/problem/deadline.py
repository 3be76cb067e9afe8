"""Deadlines, and records of the time spent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from falsework.utils.interruption import PIECE
from falsework.utils.quantity import check_deadline

_MOST, _SLICE = 8192, 0.02
"""Batches of verdicts adapt from `PIECE` up to so many, which take about so many seconds. Both change no result."""


class DeadlineExceeded(KeyboardInterrupt):
    """Deadline exceeded in the middle of a batch of verdicts.

    Searches treat it like an interruption from the keyboard: they stop cleanly and return their results so far.
    """


class Deadline:
    """Deadline of a request, with an account of the time spent."""

    def __init__(self, deadline: float | None = None) -> None:
        """Start counting; stop after `deadline` seconds, or never.

        Raises:
            InputError: a deadline of zero or less.
        """
        check_deadline(deadline)
        self._begun = time.perf_counter()
        self._deadline = deadline
        self.reserve = 0.0
        """Seconds before the deadline at which to stop searching, for what is to be done after that."""
        self.spent: dict[str, float] = {}
        """Seconds by kind of work."""
        self.between: Callable[[], None] = lambda: None
        """Called before each piece of work, so that others can go on in between."""

    @property
    def limited(self) -> bool:
        """Whether there is a deadline."""
        return self._deadline is not None

    @property
    def seconds(self) -> float:
        """Since the beginning."""
        return time.perf_counter() - self._begun

    @property
    def left(self) -> float:
        """Seconds until the deadline, infinite without one."""
        return np.inf if self._deadline is None else self._deadline - self.seconds

    @property
    def rest(self) -> float | None:
        """Deadline of a request that takes up what is left, at least a millisecond; None without one."""
        return None if self._deadline is None else max(self.left, 1e-3)

    @property
    def passed(self) -> bool:
        """Whether to stop searching."""
        return self.left <= self.reserve

    def use_reserve(self) -> None:
        """Leave nothing of the time in reserve."""
        self.reserve = 0.0

    def check(self) -> None:
        """Raise if it is time to stop.

        Raises:
            DeadlineExceeded: it is.
        """
        self.between()
        if self.passed:
            raise DeadlineExceeded

    @contextmanager
    def piece(self, what: str) -> Iterator[None]:
        """Do a piece of work, and add its seconds to the account `what`.

        Raises:
            DeadlineExceeded: it is time to stop.
        """
        self.check()
        with self.timed(what):
            yield

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Add the seconds of a piece of work to the account `what`."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.add(what, time.perf_counter() - begun)

    def add(self, what: str, seconds: float) -> None:
        """Add seconds to the account `what`."""
        self.spent[what] = self.spent.get(what, 0.0) + seconds


def pieces(count: int, *, limited: bool) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers of some states in pieces, between which to check a deadline: all at once if there is none.

    Pieces adapt to the time that one takes until the next is asked for.
    """
    begin, size = 0, PIECE if limited else _MOST
    while begin < count:
        since = time.perf_counter()
        yield np.arange(begin, min(begin + size, count))
        begin += size
        if limited:
            taken = max(time.perf_counter() - since, 1e-6)
            size = int(min(max(size * min(_SLICE / taken, 2.0), 1), _MOST))
