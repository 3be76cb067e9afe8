"""Links of the page that go to a reading of its slider, for lists and charts in HTML and SVG.

The answer to such a request is 204 (No Content), at which browsers stay on the page. No script is needed, which the
content security policy would refuse.
"""

from __future__ import annotations

import math
from urllib.parse import parse_qs, urlsplit

PATH = "/go"


def link_to(reading: float, inside: str, *, style: str = "color:inherit;text-decoration:none") -> str:
    """Return a link to a step, or a second of a schedule.

    Args:
        reading: of the slider.
        inside: HTML or SVG that is clicked.
        style: of the link.
    """
    return f'<a href="{PATH}?to={reading:.6g}" style="{style}">{inside}</a>'


def reading_of(path: str) -> float | None:
    """Return the reading that a request asks for; None if it is no request of such a link."""
    parts = urlsplit(path)
    if parts.path != PATH:
        return None
    try:
        reading = float(parse_qs(parts.query)["to"][0])
    except (KeyError, ValueError):
        return None
    return reading if math.isfinite(reading) else None
