"""Interruption of long computations by those who started them: clocks of searches, and turns that are over."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from numpy.typing import NDArray

PIECE = 8
"""States judged, or steps replayed, between two checks at first."""
_MOST, _SLICE = 8192, 0.02
"""Pieces adapt from `PIECE` up to so many, which take about so many seconds. Both change no result."""
_CHECKS: ContextVar[tuple[tuple[Callable[[], None], bool], ...]] = ContextVar("checks", default=())


@contextmanager
def interrupted_by(check: Callable[[], None], *, large: bool = False) -> Iterator[None]:
    """Let computations within call something between their pieces; they end with what it raises.

    What a computation has found by then it may keep, so that it goes on from there when it is asked again.

    Args:
        check: what they call.
        large: call it between large pieces alone, to take turns, say.
    """
    before = _CHECKS.set((*_CHECKS.get(), (check, large)))
    try:
        yield
    finally:
        _CHECKS.reset(before)


def check_interruption(*, large: bool = False) -> None:
    """Call what `interrupted_by` was given: before each piece, `large` or not, of a computation that may take long."""
    for check, only_large in _CHECKS.get():
        if large or not only_large:
            check()


def pieces(count: int, between: Callable[[], None] | None = None) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers of some states in pieces, each after a check: large ones where nothing is checked.

    Pieces adapt to the time that one takes until the next is asked for.

    Args:
        count: number of states.
        between: called before each piece too, if given.
    """
    checked = between is not None or any(not large for _, large in _CHECKS.get())
    begin, size = 0, PIECE if checked else _MOST
    while begin < count:
        check_interruption()
        if between is not None:
            between()
        since = time.perf_counter()
        yield np.arange(begin, min(begin + size, count))
        begin += size
        if checked:
            taken = max(time.perf_counter() - since, 1e-6)
            size = int(min(max(size * min(_SLICE / taken, 2.0), 1), _MOST))
