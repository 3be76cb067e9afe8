"""Output streams of a subcommand: results to standard output, progress and notes to standard error."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from falsework.utils.files.printable import printable

if TYPE_CHECKING:
    from rich.console import Console

    from falsework.search.problem.result import SearchProgress

LOG_EVERY = 30.0
"""Seconds between two lines of progress where the error stream is no terminal."""


def counted(number: int, noun: str) -> str:
    """Return a number and what it counts, such as `1 step` or `2 steps`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def write_line(text: str, stream: TextIO) -> None:
    """Write one line of text to a stream; what it must not or cannot show is escaped."""
    stream.write(_shown(text, stream) + "\n")


def _shown(text: str, stream: TextIO) -> str:
    """Return text as a stream shows it: without control characters, and in its encoding."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    return printable(text).encode(encoding, "backslashreplace").decode(encoding)


class Output:
    """Printer of text or, with `--json`, of JSON. Control characters in text, such as in names, are escaped."""

    def __init__(self, *, machine: bool, aside: bool = False) -> None:
        """Choose the format.

        Args:
            machine: print JSON.
            aside: print to the error stream, since a file is written to standard output.
        """
        self.machine = machine
        self._aside = aside

    @property
    def _stream(self) -> TextIO:
        return sys.stderr if self._aside else sys.stdout

    def record(self, fields: Mapping[str, Any]) -> None:
        """Print one JSON object on a line of its own, for machines only."""
        if self.machine:
            text = json.dumps(fields, allow_nan=False, default=_plain)  # escapes all control characters but one
            write_line(text.replace("\x7f", "\\u007f"), self._stream)
            self._stream.flush()

    def say(self, text: str) -> None:
        """Print a line of a result as text, unless it is printed as a JSON record already."""
        if not self.machine:
            write_line(text, self._stream)

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], *, dim: str = "") -> None:
        """Print a table as text, unless its rows are printed as JSON records already.

        Args:
            headings: of the columns.
            rows: cells, one a column.
            dim: rows that begin with this text are details, which a terminal shows fainter.
        """
        if self.machine:
            return
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in headings:
            table.add_column(Text(_shown(name, self._stream)))
        for row in rows:
            faint = bool(dim) and row[0].startswith(dim)
            table.add_row(*(Text(_shown(cell, self._stream)) for cell in row), style="dim" if faint else None)
        self._console(error=self._aside).print(table)

    def note(self, text: str) -> None:
        """Print a remark beside the result, such as why there is none, on one line of the error stream."""
        write_line(text, sys.stderr)

    @contextmanager
    def bar(self, title: str) -> Iterator[Callable[[int, int, str], None]]:
        """Show progress on the error stream: a bar that leaves nothing behind, or a line now and then in a log.

        Yields:
            Callback `(done, total, message)`.
        """
        if not sys.stderr.isatty():
            yield self._log(title)
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        console = self._console(error=True)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[now]}", markup=False),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(_shown(title, sys.stderr), total=None, now="")
            yield lambda done, total, now: progress.update(
                task, total=total, completed=done, now=_shown(now, sys.stderr)
            )

    def _log(self, title: str) -> Callable[[int, int, str], None]:
        last = time.monotonic()

        def report(done: int, total: int, now: str) -> None:
            nonlocal last
            if time.monotonic() - last >= LOG_EVERY:
                last = time.monotonic()
                self.note(f"{title}: {now}")

        return report

    @contextmanager
    def search_progress(self) -> Iterator[Callable[[SearchProgress], None]]:
        """Show the progress of a search."""
        with self.bar("searching") as show:
            yield lambda now: show(now.level, now.levels, now.words)

    @staticmethod
    def _console(*, error: bool) -> Console:
        from rich.console import Console

        return Console(stderr=error)  # made anew, since tests and shells exchange the streams


def _plain(value: Any) -> Any:
    """Convert NumPy scalars and arrays for JSON."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
