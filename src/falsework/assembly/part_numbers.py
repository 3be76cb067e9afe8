"""Numbers of parts that are given by number or by name."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from operator import index
from typing import Any

from falsework.errors import AssemblyError, InputError


def part_id(given: Any, names: Sequence[str], what: str) -> int:
    """Return the id of a part that is given by id or by name; `what` begins the message if there is none."""
    if isinstance(given, str) and given in names:
        return list(names).index(given)
    if isinstance(given, str) and given.isdecimal():
        given = int(given)
    if not isinstance(given, bool) and hasattr(given, "__index__") and 0 <= index(given) < len(names):
        return index(given)
    raise AssemblyError(f"{what} {given!r}, which does not exist; give an id from 0 to {len(names) - 1} or a name")


def part_ids(parts: Sequence[int | str], names: Sequence[str], what: str) -> tuple[int, ...]:
    """Return the ids of parts that are given by id or by name; ids are not checked.

    Args:
        parts: ids or names.
        names: of all parts, in order.
        what: of the parts, begins the messages.

    Raises:
        InputError: no list, an entry that is neither, or a name that no part has.
    """
    if not isinstance(parts, str):
        with suppress(TypeError):
            return tuple(
                part_id(part, names, f"{what} is part") if isinstance(part, str) else index(part) for part in parts
            )
    raise InputError(f"{what} parts are {parts!r}; give a list of part numbers or names, such as [3, 4]")
