"""Interruption of long computations by those who started them: clocks of searches, and turns that are over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

PIECE = 8
"""States judged, or steps replayed, between two checks at first."""
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
