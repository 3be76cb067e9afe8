"""User folder that caches compiled code.

Code that runs is checked first: a damaged file would end the process without a message.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from functools import cache
from pathlib import Path

from falsework.errors import InputError
from falsework.utils.files.output_file import write_whole

_DIGEST = hashlib.sha256().digest_size
"""Bytes of the digest with which a file begins."""


def cache_folder() -> Path:
    """Return the folder of compiled code: `FALSEWORK_CACHE`, else the user's cache folder."""
    named = os.environ.get("FALSEWORK_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~").expanduser() / ".cache") / "falsework"


def read_cache(name: str) -> bytes | None:
    """Return the content cached under a name; None if there is none, or with a warning if it is damaged."""
    return read_sealed(cache_folder() / name)


def write_cache(name: str, content: bytes) -> None:
    """Cache content under a name; warn once if the folder cannot be written."""
    kept = cache_folder() / name
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_sealed(kept, content)
    except (OSError, InputError):
        warn_of_no_cache(str(kept.parent))


def read_sealed(path: Path) -> bytes | None:
    """Return what `write_sealed` wrote; None if there is no such file, or with a warning if it is damaged."""
    try:
        found = path.read_bytes()
    except OSError:
        return None
    digest, content = found[:_DIGEST], found[_DIGEST:]
    if hashlib.sha256(content).digest() == digest:
        return content
    warnings.warn(f"{path} is damaged; what it cached is compiled again", CacheWarning, stacklevel=2)
    return None


def write_sealed(path: Path, content: bytes) -> None:
    """Write content after its digest, whole or not at all."""
    write_whole(path, lambda file: file.write(hashlib.sha256(content).digest() + content))


class CacheWarning(UserWarning):
    """Compiled code cannot be kept, or is damaged."""


@cache
def warn_of_no_cache(folder: str) -> None:
    """Warn, once in a process, that a folder cannot keep compiled code."""
    warnings.warn(
        f"compiled code cannot be kept in {folder} and is compiled again at every start; "
        "name a folder that can be written in FALSEWORK_CACHE and NUMBA_CACHE_DIR",
        CacheWarning,
        stacklevel=2,
    )
