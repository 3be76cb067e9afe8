"""Parser of untrusted JSON text with limits on nesting and integers, and without entries that occur twice."""

from __future__ import annotations

import json
from typing import Any

LEVELS = 64
"""Levels of lists and objects that a file may have."""


def parse_json(text: str) -> Any:
    """Parse JSON text.

    Raises:
        ValueError: it is no JSON, has more than `LEVELS` levels, an integer that does not fit into 64 bits, or an
            object with two entries of the same name; the message begins with "it" or "an object in it".
    """
    try:
        data = json.loads(text, parse_int=_integer, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise ValueError(f"it is not valid JSON at {place}; it may be truncated") from None
    except RecursionError:
        raise ValueError(f"it is nested deeper than {LEVELS} levels") from None
    level = [data]
    for _ in range(LEVELS + 1):
        level = [
            entry
            for holder in level
            for entry in (holder.values() if isinstance(holder, dict) else holder if isinstance(holder, list) else ())
            if isinstance(entry, (dict, list))
        ]
        if not level:
            return data
    raise ValueError(f"it is nested deeper than {LEVELS} levels")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"an object in it has the entry {twice[:40]!r} twice")
    return entries


def _integer(digits: str) -> int:
    if len(digits) > 20 or not -(2**63) <= int(digits) < 2**63:
        raise ValueError(f"the integer {digits[:12]}... in it does not fit into 64 bits")
    return int(digits)
