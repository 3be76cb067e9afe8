"""Readers whose libraries are compiled code, which damaged files end or hold up: they run apart, with limits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from falsework.assembly.draft import Draft
from falsework.errors import InputError
from falsework.utils.child_process import ChildDiedError, run_in_child

_MEMORY, _MEMORY_PER_BYTE = 4 << 30, 2000
"""Address space of the process: for the libraries, and for each byte of the file."""
_SECONDS, _SECONDS_PER_BYTE = 20.0, 20e-6
"""Time of the process: for its start, and for each byte of the file."""


def read_apart(read: Callable[..., Draft], path: Path, *arguments: object, library: str) -> Draft:
    """Read a file in a process of its own."""
    if not path.is_file():
        raise InputError(f"there is no file {path}; name another")
    size = path.stat().st_size
    memory, seconds = _MEMORY + _MEMORY_PER_BYTE * size, _SECONDS + _SECONDS_PER_BYTE * size
    try:
        return run_in_child(read, path, *arguments, memory=memory, seconds=seconds)
    except ChildDiedError as error:
        how = f"stopped ({error})"
    except MemoryError:
        how = "takes more memory than a file of its size may"
    raise InputError(f"{path} cannot be read: {library} {how}; the file is damaged, export it again")
