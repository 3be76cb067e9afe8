"""Search for a second plan in a process of its own, beside the first, since a search for orders uses one core.

The process gets its request by its standard input and answers by its standard output. Unlike the processes of
`multiprocessing` it does not run the main module of the program again, which a library must not ask for.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from types import TracebackType
from typing import Any

from falsework.robots.plans.robot_plan import RobotPlan
from falsework.utils.child_process import child_environment

_POLL = 0.1
"""Seconds between two looks at the time, and at signals, which some systems do not deliver while a thread waits."""
_MAIN = f"from {__name__} import answer; answer()"


class SecondSearch:
    """Running search of another process. As a context it ends with the process, whatever happens."""

    def __init__(self, search: Callable[..., RobotPlan | None], given: dict[str, Any]) -> None:
        """Begin.

        Args:
            search: function of a module, which finds the plan.
            given: its arguments by name.
        """
        self._answer = b""
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _MAIN],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=child_environment(),
            )
        except OSError:  # no interpreter, or no room for another process
            return
        self._thread = Thread(target=self._exchange, args=(pickle.dumps((search, given)),), daemon=True)
        self._thread.start()

    def _exchange(self, request: bytes) -> None:
        assert self._process is not None
        question, reply = self._process.stdin, self._process.stdout
        assert question is not None
        assert reply is not None
        try:
            question.write(request)
            question.flush()  # kept open: the end of the input ends the process
            self._answer = reply.read()
        except (OSError, ValueError):  # the process has ended, or was ended
            self._answer = b""

    def plan(self, seconds: float) -> RobotPlan | None:
        """Wait for the plan, at most some seconds; None without one, and where the process failed."""
        begun = time.perf_counter()
        if self._process is None:
            return None
        while self._thread.is_alive() and time.perf_counter() - begun < seconds:
            self._thread.join(_POLL)
        return None if self._thread.is_alive() or not self._answer else pickle.loads(self._answer)

    def __enter__(self) -> SecondSearch:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._thread.join()
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                with suppress(OSError):  # what was not written has no reader any more
                    pipe.close()


def answer() -> None:
    """Carry out the request at the standard input; the main program of the other process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the process that waits, which ends this one
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever libraries print, compiled ones too, stays out of the answer
    search, given = pickle.load(sys.stdin.buffer)
    Thread(target=_watch, daemon=True).start()
    out.write(pickle.dumps(search(**given)))
    out.flush()
    os._exit(0)  # the thread still reads, which blocks the end of the interpreter


def _watch() -> None:
    """End with the process that waits."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)
