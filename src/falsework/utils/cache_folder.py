"""User folder that caches compiled code."""

from __future__ import annotations

import os
import warnings
from functools import cache
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of compiled code: `FALSEWORK_CACHE`, else the user's cache folder."""
    named = os.environ.get("FALSEWORK_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~").expanduser() / ".cache") / "falsework"


def read_cache(name: str) -> bytes | None:
    """Return the content cached under a name, or None."""
    try:
        return (cache_folder() / name).read_bytes()
    except OSError:
        return None


def write_cache(name: str, content: bytes) -> None:
    """Cache content under a name; warn once if the folder cannot be written."""
    kept = cache_folder() / name
    fresh = kept.with_suffix(f".{os.getpid()}.tmp")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_bytes(content)
        fresh.replace(kept)
    except OSError:
        warn_of_no_cache(str(kept.parent))


class CacheWarning(UserWarning):
    """Compiled code cannot be kept."""


@cache
def warn_of_no_cache(folder: str) -> None:
    """Warn, once in a process, that a folder cannot keep compiled code."""
    warnings.warn(
        f"compiled code cannot be kept in {folder} and is compiled again at every start; "
        "name a folder that can be written in FALSEWORK_CACHE and NUMBA_CACHE_DIR",
        CacheWarning,
        stacklevel=2,
    )
