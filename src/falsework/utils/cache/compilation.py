"""Message that numba compiles kernels, which may take minutes without any other sign."""

from __future__ import annotations

import sys
from functools import cache
from threading import Timer

_SLOW = 1.0
"""Seconds of one compilation after which it is said."""


@cache
def announce_compilation() -> None:
    """Have one line on stderr, once in a process, say that numba compiles kernels, where this takes long."""
    from numba.core import event

    class Announcer(event.Listener):
        """Timer of the outermost compilation; numba compiles one kernel at a time, and those that it calls within."""

        depth = 0
        timer = Timer(_SLOW, _say)

        def on_start(self, event: event.Event) -> None:
            """Begin to wait."""
            self.depth += 1
            if self.depth == 1:
                self.timer = Timer(_SLOW, _say)
                self.timer.daemon = True
                self.timer.start()

        def on_end(self, event: event.Event) -> None:
            """Cease to wait."""
            self.depth -= 1
            if not self.depth:
                self.timer.cancel()

    event.register("numba:compile", Announcer())


@cache
def _say() -> None:
    sys.stderr.write(
        "falsework: numba compiles kernels, which may take minutes the first time "
        "(in a clone, `make kernels` compiles them beforehand)\n"
    )
