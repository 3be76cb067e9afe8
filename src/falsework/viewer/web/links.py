"""Links of the page that go to a step or a second, for lists and charts in HTML and SVG.

The answer to such a request is 204 (No Content), at which browsers stay on the page. No script is needed, which the
content security policy would refuse.
"""

from __future__ import annotations

import math
from typing import Literal
from urllib.parse import parse_qs, urlsplit

from falsework.utils.quantity import format_number

PATH = "/go"
Unit = Literal["step", "seconds"]


def link_to(unit: Unit, value: float, inside: str) -> str:
    """Return a link to a step, or to a second of a schedule."""
    return f'<a href="{PATH}?{unit}={format_number(value, 6)}" style="color:inherit;text-decoration:none">{inside}</a>'


def target_of(path: str) -> tuple[Unit, float] | None:
    """Return where a request wants to go; None if it is no request of such a link."""
    parts = urlsplit(path)
    if parts.path != PATH:
        return None
    query = parse_qs(parts.query)
    units: tuple[Unit, ...] = ("step", "seconds")
    for unit in units:
        try:
            value = float(query[unit][0])
        except (KeyError, ValueError):
            continue
        if math.isfinite(value):
            return unit, value
    return None
