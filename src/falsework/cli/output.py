"""Output streams of a subcommand: results to standard output, progress and notes to standard error."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from falsework.utils.files.printable import printable

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from falsework.search.problem.result import SearchProgress

LOG_EVERY = 30.0
"""Seconds between two lines of progress where the error stream is no terminal."""


def counted(number: int, noun: str) -> str:
    """Return a number and what it counts, such as `1 step` or `2 steps`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def write_line(text: str, stream: TextIO) -> None:
    """Write one line of text to a stream; what it must not or cannot show is escaped."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    stream.write(printable(text).encode(encoding, "backslashreplace").decode(encoding) + "\n")


class Output:
    """Printer of text or, with `--json`, of JSON."""

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
            write_line(json.dumps(fields, allow_nan=False, default=_plain), self._stream)
            self._stream.flush()

    def say(self, text: RenderableType) -> None:
        """Print a result as one line of text or as a table, unless it is printed as a JSON record already."""
        if self.machine:
            return
        if isinstance(text, str):
            write_line(text, self._stream)
        else:
            self._console(error=self._aside).print(text, markup=False, highlight=False)

    def note(self, text: str) -> None:
        """Print a remark of one line beside the result, such as why there is none, to the error stream."""
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
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[now]}"), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(title, total=None, now="")
            yield lambda done, total, now: progress.update(task, total=total, completed=done, now=now)

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

            def report(now: SearchProgress) -> None:
                doing = f"{now.direction}, width {now.width}: step {now.level} of {now.levels}"
                show(now.level, now.levels, f"{doing}, {now.kept} states kept, {now.asked} verdicts")

            yield report

    @staticmethod
    def _console(*, error: bool) -> Console:
        from rich.console import Console, ConsoleOptions
        from rich.segment import Segment

        class PlainConsole(Console):
            """Console on which texts cannot control the terminal."""

            def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
                for segment in super().render(renderable, options):
                    lines = "\n".join(map(printable, segment.text.split("\n")))
                    yield segment if segment.control else segment._replace(text=lines)

        return PlainConsole(stderr=error)  # made anew, since tests and shells exchange the streams


def _plain(value: Any) -> Any:
    """Convert NumPy scalars and arrays for JSON."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
