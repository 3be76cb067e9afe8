"""Errors of readers: whatever fails while a file is interpreted is reported as a fault of the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from falsework.errors import FalseworkError, InputError


@contextmanager
def blamed_on(path: Path | str, remedy: str) -> Iterator[None]:
    """Turn exceptions that are no messages to a user into one that names the file; `--debug` shows where they arose.

    Readers check what they can name precisely. Formats and libraries leave further ways to fail, which no list holds.

    Raises:
        InputError: in place of any exception that is no `FalseworkError`, lack of memory, or warning that is an error.
    """
    try:
        yield
    except (FalseworkError, MemoryError, Warning):
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:
        text = " ".join(str(error).split())
        what = type(error).__name__ + (f": {text[:120]}" if text else "")
        raise InputError(f"{path} is damaged or not what it seems ({what}); {remedy}") from error
