"""Numbers of parts that are given by number, by range or by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from operator import index
from typing import Any

from falsework.errors import AssemblyError, InputError

_RANGE = re.compile(r"(\d{1,9})-(\d{1,9})", re.ASCII)
_NUMBER = re.compile(r"\d{1,9}", re.ASCII)
LARGEST_LIST = 100_000
"""Parts that one range may name; a typing error such as 0-99999999 must not fill the memory."""


def part_id(given: Any, names: Sequence[str], what: str) -> int:
    """Return the id of a part that is given by id or by name; `what` begins the message if there is none."""
    if isinstance(given, str):
        number = int(given) if _NUMBER.fullmatch(given) else None
        if given in names:
            named = list(names).index(given)
            if number is not None and number != named and number < len(names):
                raise AssemblyError(
                    f"{what} {given!r}, which is the name of part {named} and the number of part {names[number]!r}; "
                    "rename the part"
                )
            return named
        given = given if number is None else number
    if not isinstance(given, bool) and hasattr(given, "__index__") and 0 <= index(given) < len(names):
        return index(given)
    near = alike(given, names) if isinstance(given, str) else ""
    raise AssemblyError(
        f"{what} {given!r}, which does not exist{near}; give an id from 0 to {len(names) - 1} or a name"
    )


def alike(name: str, names: Sequence[str]) -> str:
    """Return which parts may be meant by a name that none has, such as `; perhaps abutment_E`; empty for none."""
    begin = [one for one in names if one.lower().startswith(name.lower())] if name else []
    near = begin[:3] or get_close_matches(name, names, n=3)
    return f"; perhaps {' or '.join(near)}" if near else ""


def part_range(given: Any, names: Sequence[str]) -> range | None:
    """Return the ids of a range such as `0-16`; None for anything else, such as a part of that name."""
    match = _RANGE.fullmatch(given) if isinstance(given, str) and given not in names else None
    if match is None or not int(match[1]) <= int(match[2]) <= int(match[1]) + LARGEST_LIST:
        return None
    return range(int(match[1]), int(match[2]) + 1)


def part_ids(parts: Sequence[int | str], names: Sequence[str], what: str) -> tuple[int, ...]:
    """Return the ids of parts that are given by id, range or name; ids are not checked.

    Args:
        parts: ids, ranges such as `0-16`, or names.
        what: of the parts, begins the messages.
    """
    if not isinstance(parts, str):
        with suppress(TypeError):
            found: list[int] = []
            for part in parts:
                span = part_range(part, names)
                if span is not None:
                    found += span
                else:
                    found.append(part_id(part, names, f"{what} is part") if isinstance(part, str) else index(part))
            return tuple(found)
    raise InputError(f"{what} parts are {parts!r}; give a list of part numbers or names, such as [3, 4]")


def boundary_ids(boundary: Any, names: Sequence[str]) -> list[int]:
    """Return the ids of the parts that are given as boundary, as far as these exist; errors are reported later.

    Args:
        boundary: ids, ranges or names, or a mask.
    """
    try:
        given = list(boundary)
    except TypeError:
        return []
    if given and all(isinstance(item, bool) or type(item).__name__ in ("bool_", "bool") for item in given):
        return [part for part, fixed in enumerate(given) if fixed and part < len(names)]
    found: list[int] = []
    for item in given:
        with suppress(InputError):
            found += [part for part in part_ids([item], names, "boundary") if 0 <= part < len(names)]
    return found
