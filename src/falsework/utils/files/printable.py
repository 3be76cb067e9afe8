"""Text of files made safe to show: control characters become escapes."""

from __future__ import annotations

import unicodedata

_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Categories of Unicode that control a terminal, the direction of text or the line, or are no characters at all."""


def printable(text: str) -> str:
    """Return a text with its control characters, line breaks included, as escapes such as `\\x1b`.

    Names come from files: on a terminal they could move the cursor, hide a line or write one of their own.
    """
    if text.isprintable():
        return text
    return "".join(c.encode("unicode_escape").decode() if unicodedata.category(c) in _UNSEEN else c for c in text)
