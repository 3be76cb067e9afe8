"""Folder of the user that keeps compiled code."""

from __future__ import annotations

import logging
import os
from functools import lru_cache
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of compiled code: `FALSEWORK_CACHE`, else the user's cache folder."""
    named = os.environ.get("FALSEWORK_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~").expanduser() / ".cache") / "falsework"


def read_cache(name: str) -> bytes | None:
    """Return what is kept under a name, or None."""
    try:
        return (cache_folder() / name).read_bytes()
    except OSError:
        return None


def write_cache(name: str, content: bytes) -> None:
    """Keep content under a name; warn once where the folder cannot be written."""
    kept = cache_folder() / name
    fresh = kept.with_suffix(f".{os.getpid()}.tmp")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_bytes(content)
        fresh.replace(kept)
    except OSError as error:
        warn_of_no_cache(str(error))


@lru_cache(maxsize=1)
def _warn_once() -> None:
    logging.getLogger("falsework").warning(
        "compiled code cannot be kept in %s and is compiled again at every start; "
        "name a folder that can be written in FALSEWORK_CACHE",
        cache_folder(),
    )


def warn_of_no_cache(reason: str) -> None:
    """Warn, once in a process, that compiled code cannot be kept."""
    logging.getLogger("falsework").debug("no cache: %s", reason)
    _warn_once()
