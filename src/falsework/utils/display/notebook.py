"""Notebooks: what objects show there, and progress in the output of a cell."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from html import escape
from typing import Any, Protocol, TypeVar

from falsework.utils.display.drawing import drawn

_EVERY = 0.2
"""Seconds between two updates of a line."""


class Displayed:
    """Object that notebooks show with a picture and a table, made when it is shown."""

    def _repr_html_(self) -> str | None:
        return drawn("html", self)


def in_notebook() -> bool:
    """Return whether the code runs in a cell of a notebook."""
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class Reported(Protocol):
    """Progress of a search."""

    @property
    def share(self) -> float:
        """How far it is, from 0 to 1."""

    @property
    def words(self) -> str:
        """The progress on one line."""


P = TypeVar("P", bound=Reported)


def or_notebook(report: Callable[[P], None] | None, title: str) -> Callable[[P], None] | None:
    """Return a callback as it is; where none is given, in notebooks, one that shows progress in the cell.

    Args:
        report: called with progress; None if not given.
    """
    show = notebook_progress(title) if report is None else None
    return report if show is None else lambda now: show(now.share, now.words)


def notebook_progress(title: str) -> Callable[[float, str], None] | None:
    """Return a function that shows a share, from 0 to 1, and words in the cell; None outside notebooks."""
    if not in_notebook():
        return None
    from IPython.display import HTML, display

    shown: Any = None
    last = 0.0

    def report(share: float, words: str) -> None:
        nonlocal shown, last
        now = time.monotonic()
        if shown is not None and share < 1 and now - last < _EVERY:
            return
        last = now
        bar = f"<progress value='{share:.3f}' max='1'></progress>"
        line = HTML(f"<div>{escape(title)} {bar} {escape(words)}</div>")
        if shown is None:
            shown = display(line, display_id=True)
        else:
            shown.update(line)

    return report
