"""Output streams of a subcommand: results to standard output, progress and notes to standard error."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from falsework.search.problem.result import SearchProgress

LOG_EVERY = 30.0
"""Seconds between two lines of progress where the error stream is no terminal."""
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line separators, marks that change the direction of writing, and bytes of file names that are no
text (lone surrogates), which most streams cannot encode."""


def printable(text: str) -> str:
    r"""Return text on one line in which control characters are escaped, such as `\x1b` and `\n`.

    Names in files come from anywhere; printed raw, they could move the cursor, hide lines or add forged ones.
    """
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def counted(number: int, noun: str) -> str:
    """Return a number and what it counts, such as `1 step` or `2 steps`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


class Output:
    """Printer of text or, with `--json`, of JSON. Control characters in text, such as in names, are escaped."""

    def __init__(self, *, machine: bool) -> None:
        self.machine = machine

    def record(self, fields: Mapping[str, Any]) -> None:
        """Print one JSON object on a line of its own, for machines only."""
        if self.machine:
            text = json.dumps(fields, allow_nan=False, default=_plain)  # escapes all control characters but one
            sys.stdout.write(text.replace("\x7f", "\\u007f") + "\n")
            sys.stdout.flush()

    def say(self, text: str) -> None:
        """Print a line of a result as text, unless it is printed as a JSON record already."""
        if not self.machine:
            sys.stdout.write(printable(text) + "\n")

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
            table.add_column(Text(printable(name)))
        for row in rows:
            faint = bool(dim) and row[0].startswith(dim)
            table.add_row(*(Text(printable(cell)) for cell in row), style="dim" if faint else None)
        self._console(error=False).print(table)

    def note(self, text: str) -> None:
        """Print a remark beside the result, such as why there is none, on one line of the error stream."""
        sys.stderr.write(printable(text) + "\n")

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
            yield lambda done, total, now: progress.update(task, total=total, completed=done, now=printable(now))

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
        from rich.console import Console

        return Console(stderr=error)  # made anew, since tests and shells exchange the streams


def _plain(value: Any) -> Any:
    """Convert NumPy scalars and arrays for JSON."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
