"""Deadlines, and records of the time spent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from falsework.utils.interruption import interrupted_by
from falsework.utils.quantity import check_deadline


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
        self._deadline = None if deadline == np.inf else deadline
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
    def interrupts(self) -> Iterator[None]:
        """End computations within when it is time to stop, if there is a deadline; they raise `DeadlineExceeded`."""
        if not self.limited:
            yield
            return
        with interrupted_by(self.check):
            yield

    @contextmanager
    def piece(self, what: str) -> Iterator[None]:
        """Do work whose pieces `check` comes between, and add its seconds to the account `what`.

        Raises:
            DeadlineExceeded: it is time to stop.
        """
        with interrupted_by(self.check), self.timed(what):
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
