"""Watch over the files that a page shows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path

_EVERY = 0.5
"""Seconds between two looks at the files."""


class FileWatch:
    """Thread that calls a function after files have changed; files that are not there are left out."""

    def __init__(self, files: Callable[[], Iterable[str | Path]], changed: Callable[[], object]) -> None:
        """Begin to watch.

        Args:
            files: names of the files, asked for anew at every look.
            changed: what is done after a change; it must not raise.
        """
        self._files, self._changed = files, changed
        self._stop = threading.Event()
        self._stamps = self._stamped()
        self._thread = threading.Thread(target=self._watch, name="falsework-files", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        self._thread.join(timeout=5)

    def _stamped(self) -> dict[str, int]:
        return {str(name): Path(name).stat().st_mtime_ns for name in self._files() if Path(name).is_file()}

    def _watch(self) -> None:
        while not self._stop.wait(_EVERY):
            try:
                stamps = self._stamped()
            except OSError:  # a file has gone between the question and its time
                continue
            if stamps != self._stamps:
                self._stamps = stamps
                self._changed()
