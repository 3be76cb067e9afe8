"""Output streams of a subcommand: results to standard output, progress and notes to standard error."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import resources
from typing import TYPE_CHECKING, Any, TextIO

from falsework.cli.arguments import spell_options
from falsework.cli.exit_code import Exit
from falsework.utils.files.printable import printable

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from falsework.search.problem.result import SearchProgress

ANSWER_FORMAT = "falsework.answer/1"
"""Format of JSON answers; `answer.schema.json` describes it."""
_FILE_WIDTH = 200
"""Columns of tables where the output is no terminal."""
_PREFIX = "falsework: "
"""Beginning of notes, which answers leave out."""
_OUTCOMES = {
    Exit.WRONG_INPUT: "wrong_input",
    Exit.CONDITIONAL: "conditional",
    Exit.NO_MEMORY: "no_memory",
    Exit.INTERRUPTED: "interrupted",
}
"""Outcomes with the exit codes that mean the same in all commands."""

LOG_EVERY = 30.0
"""Seconds between two lines of progress where the error stream is no terminal."""


def answer_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of answers."""
    return json.loads(resources.files("falsework.cli").joinpath("answer.schema.json").read_text(encoding="utf-8"))


def write_line(text: str, stream: TextIO) -> None:
    """Write one line of text to a stream; what it must not or cannot show is escaped."""
    stream.write(_shown(text, stream) + "\n")


def _shown(text: str, stream: TextIO) -> str:
    """Return text as a stream shows it: without control characters, and in its encoding."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    return printable(text).encode(encoding, "backslashreplace").decode(encoding)


class Output:
    """Printer of text or, with `--json`, of one JSON answer. Control characters in text are escaped."""

    def __init__(
        self,
        *,
        machine: bool,
        aside: bool = False,
        command: str | None = None,
        outcomes: tuple[str, str] = ("done", "failed"),
    ) -> None:
        """Choose the format.

        Args:
            outcomes: outcomes with the exit codes 0 and 1, unless the subcommand names another.
        """
        self.machine = machine
        self._aside = aside
        self.command = command
        self._outcomes = {Exit.DONE: outcomes[0], Exit.NO: outcomes[1], **_OUTCOMES}
        self._fields: dict[str, Any] = {}
        self._files: list[str] = []
        self._notes: list[str] = []
        self._answered = False
        self.replaced: Path | None = None
        """File, or folder with files, that will be replaced, until a line has said so: when the work begins, or at the
        latest when a file is written."""

    @property
    def _stream(self) -> TextIO:
        return sys.stderr if self._aside else sys.stdout

    def record(self, fields: Mapping[str, Any]) -> None:
        """Add fields to the JSON answer."""
        self._fields |= fields

    def row(self, table: str, fields: Mapping[str, Any]) -> None:
        """Add an object to a list of the JSON answer, such as one for each state."""
        self._fields.setdefault(table, []).append(fields)

    def file(self, path: Path | str) -> None:
        """Name a file or folder that was written, for the JSON answer."""
        self._announce()
        self._files.append(str(path))

    def _announce(self) -> None:
        """Say once that a file, or files of a folder, will be replaced."""
        if self.replaced is not None:
            path, self.replaced = self.replaced, None
            kind, fate = "file", "and is replaced where there is a result"
            if path.is_dir():
                kind, fate = "folder", "with files: those of the same names are replaced, the others stay"
            self.note(f"falsework: {path} exists {fate}; --out names another {kind}")

    def outcome(self, name: str, code: Exit = Exit.NO) -> Exit:
        """Name the outcome that an exit code stands for in this answer, and return the code."""
        self._outcomes[code] = name
        return code

    def answer(self, code: Exit, error: str | None = None) -> None:
        """Print the JSON answer on one line, for machines only; commands that go on for long call it at their start."""
        if not self.machine or self._answered:
            return
        self._answered = True
        answer = {
            "format": ANSWER_FORMAT,
            "command": self.command,
            "ok": code == Exit.DONE,
            "outcome": self._outcomes[code],
            "files": self._files,
            "notes": self._notes,
        }
        if error is not None:
            answer["error"] = error
        # All control characters but one are escaped.
        text = json.dumps(answer | self._fields, allow_nan=False, default=_plain)
        write_line(text.replace("\x7f", "\\u007f"), self._stream)
        self._stream.flush()

    def say(self, text: str) -> None:
        """Print a line of a result as text, unless it is printed as a JSON record already."""
        if not self.machine:
            write_line(text, self._stream)

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], *, dim: str = "") -> None:
        """Print a table as text, unless its rows are printed as JSON records already.

        Args:
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
        self._notes.append(printable(text.removeprefix(_PREFIX)))
        write_line(text, sys.stderr)

    @contextmanager
    def bar(self, title: str) -> Iterator[Callable[[int, int, str], None]]:
        """Show progress on the error stream: a bar that leaves nothing behind, or a line now and then in a log.

        Yields:
            Callback `(done, total, message)`.
        """
        self._announce()
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

    @contextmanager
    def count(self, title: str, what: str) -> Iterator[Callable[[int, int], None]]:
        """Show progress as `bar` does, by the number of what is done, such as `state 3 of 9`.

        Yields:
            Callback `(done, total)`.
        """
        with self.bar(title) as show:
            yield lambda done, total: show(done, total, f"{what} {done} of {total}")

    def _log(self, title: str) -> Callable[[int, int, str], None]:
        last = time.monotonic()

        def report(done: int, total: int, now: str) -> None:
            nonlocal last
            if time.monotonic() - last >= LOG_EVERY:
                last = time.monotonic()
                write_line(f"{title}: {now}", sys.stderr)

        return report

    @contextmanager
    def search_progress(self) -> Iterator[Callable[[SearchProgress], None]]:
        """Show the progress of a search."""
        with self.bar("searching") as show:
            yield lambda now: show(now.level, now.levels, now.words)

    @staticmethod
    def _console(*, error: bool) -> Console:
        from rich.console import Console

        # Made anew, since tests and shells exchange the streams; a file is no terminal, and has room for whole tables.
        stream = sys.stderr if error else sys.stdout
        return Console(stderr=error, width=None if stream.isatty() else _FILE_WIDTH)


def exit_of_good(plan: Path, overrides: Mapping[str, Any], output: Output, *, accepted: bool) -> Exit:
    """Return the exit code of a check that found nothing wrong, and say what it depends on.

    Args:
        overrides: options that the plan sets and the command line does not give, see `structure_to_check`.
    """
    if not overrides or accepted:
        return Exit.DONE
    output.note(
        f"falsework: {plan}: good only with options of the structure that the plan sets itself: "
        f"{spell_options(overrides)}; give them too, or --accept-overrides"
    )
    return Exit.CONDITIONAL


def _plain(value: Any) -> Any:
    """Convert NumPy scalars and arrays for JSON."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
