"""Text that a terminal shows as it is: control characters are escaped."""

from __future__ import annotations

import re

_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line separators, marks that change the direction of writing, and bytes of file names that are no
text (lone surrogates), which most streams cannot encode."""


def printable(text: str) -> str:
    r"""Return text on one line in which control characters are escaped, such as `\x1b` and `\n`.

    Names in files come from anywhere; printed raw, they could move the cursor, hide lines or add forged ones.
    """
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
