"""Escapes for the page: the one way in which text that is not the viewer's own enters HTML or Markdown.

The page shows Markdown with the HTML in it, so a name could hold script.
"""

from __future__ import annotations

import html

from falsework.utils.files.printable import printable

_HARMLESS = frozenset(" ,.-;:%()/'")
"""Characters beside letters and digits that stand for themselves within a line of Markdown."""


def html_text(text: str) -> str:
    """Return HTML that shows a text as it is."""
    return html.escape(printable(text))


def markdown_text(text: str) -> str:
    """Return Markdown that shows a text as it is, within a line."""
    return "".join(c if c.isalnum() or c in _HARMLESS else f"&#{ord(c)};" for c in printable(text))
