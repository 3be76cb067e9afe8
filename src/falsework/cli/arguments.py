"""Parsers of part numbers and states given as command-line arguments."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.errors import InputError, StateError
from falsework.utils.json_text import parse_json

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States

_RANGE = re.compile(r"(\d+)-(\d+)")
LARGEST_LIST = 100_000
"""Parts that one list may name; a typing error such as 0-99999999 must not fill the memory."""


def parse_parts(text: str, option: str, names: Sequence[str] = ()) -> tuple[int, ...]:
    """Read a list of parts such as `3,4`, `0-16` or `keystone,7`.

    Args:
        text: numbers, ranges or names, separated by commas.
        option: option that the text belongs to, for the message.
        names: names of the parts, in order; without them only numbers are understood.

    Raises:
        InputError: an item is neither a number, a range nor a name.
    """
    parts: list[int] = []
    for item in (piece.strip() for piece in text.split(",")):
        if item.isdecimal():
            parts.append(int(item))
        elif item in names:
            parts.append(list(names).index(item))
        elif (match := _RANGE.fullmatch(item)) and int(match[1]) <= int(match[2]) <= int(match[1]) + LARGEST_LIST:
            parts.extend(range(int(match[1]), int(match[2]) + 1))
        else:
            raise InputError(f"{option} {text}: {item!r} is not a part; give numbers such as 3,4 or 0-16, or names")
    return tuple(parts)


def parse_numbers(text: str, option: str, count: Sequence[int] = (1, 2)) -> list[float]:
    """Read numbers separated by commas.

    Raises:
        InputError: no numbers, or not as many as `count` allows.
    """
    try:
        numbers = [float(item) for item in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in count or not all(math.isfinite(number) for number in numbers):
        shown = f"{option}{text}" if option.endswith(("=", "@")) else f"{option} {text}"
        raise InputError(f"{shown}: give {' or '.join(map(str, count))} numbers without units, such as 0.1")
    return numbers


def parse_load(text: str) -> dict[str, Any]:
    """Read a load such as `keystone=0,0,-1000` or `7=0,0,-1000@0.2,0,1` as an entry of `loads` in `assembly.json`.

    Raises:
        InputError: it is written otherwise.
    """
    part, equals, rest = text.rpartition("=")
    force, at, place = rest.partition("@")
    if not (part and equals):
        raise InputError(f"--load {text}: give a part and its force in N, such as keystone=0,0,-1000")
    option = f"--load {part}="
    load: dict[str, Any] = {"part": part, "force": parse_numbers(force, option, (3,))}
    return load | {"at": parse_numbers(place, f"{option}{force}@", (3,))} if at else load


def read_states(path: Path) -> Any:
    """Read states from a JSON list or a `.npy` file, without checking their length or values.

    Raises:
        StateError: no such file, or neither JSON nor NumPy.
    """
    import numpy as np

    if not path.is_file():
        raise StateError(f"no file {path}; give a JSON list of states or a .npy array")
    try:
        if path.suffix.lower() == ".npy":
            # Mapped first: a file that is shorter than it claims is refused before memory is taken for it.
            return np.array(np.load(path, allow_pickle=False, mmap_mode="r"))
        content = parse_json(path.read_text(encoding="utf-8"))
    except Exception as error:  # NumPy fails in many ways on a damaged file
        raise StateError(f"{path} cannot be read; give a JSON list of states or a .npy array") from error
    if not isinstance(content, list):
        raise StateError(f"{path} contains no list; give a JSON list of states such as [[2, 1, 0], [2, 2, 0]]")
    return content


def parse_state(text: str, option: str, assembly: Assembly) -> States:
    """Read one state: `complete`, `empty`, digits such as `2110`, or a file with one state.

    Returns:
        Shape (parts,).

    Raises:
        StateError: not a state of this structure.
    """
    from falsework.assembly.state import as_states, complete_state, empty_state

    if text == "complete":
        return complete_state(assembly.boundary)
    if text == "empty":
        return empty_state(assembly.boundary)
    if text and set(text) <= set("012"):
        content: Any = [int(digit) for digit in text]
    elif text.startswith("["):
        try:
            content = parse_json(text)
        except ValueError as error:
            raise StateError(f"{option} {text}: {error}") from error
    elif Path(text).is_file():
        content = read_states(Path(text))
    else:
        raise StateError(f"{option} {text}: neither complete, empty, digits such as 2110 nor a file with a state")
    try:
        states = as_states(content, assembly.boundary)
    except StateError as error:
        raise StateError(f"{option} {text}: {error}") from None
    if len(states) != 1:
        raise StateError(f"{option} {text}: holds {len(states)} states; give one")
    return states[0]
