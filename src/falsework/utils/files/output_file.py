"""Output files: whole or not at all; links are followed, pipes are streamed to, devices are refused."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from falsework.errors import InputError

_STREAM = re.compile(r"/dev/std(out|err)|(?:/dev/fd|/proc/self/fd)/(\d+)")
"""Paths that name an open stream of this process."""
ABANDONED = 3600.0
"""Age from which a draft beside a file counts as left by a killed process, seconds."""


def write_whole(path: Path | str, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file under a temporary name beside it, then rename it, so that an interruption leaves no partial file.

    A symbolic link is followed and stays. A pipe, or a stream of this process such as `/dev/stdout`, gets the content
    at once when it is complete.

    Raises:
        InputError: the folder does not exist or cannot be written to, there is no room, or the path is a device, a
            socket or a folder.
    """
    path = Path(path)
    try:
        target = _target(path)
        if isinstance(target, int) or _is(target, stat.S_ISFIFO):
            content = io.BytesIO()
            write(content)
            _stream(target, content.getbuffer())
        else:
            _replace(target, write)
    except BrokenPipeError:
        raise
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else error.strerror or error
        raise InputError(f"cannot write {path}: {reason}; choose another place") from error


def check_writable(path: Path) -> None:
    """Raise where `write_whole` would; only the beginning of a draft is written, and removed."""
    try:
        target = _target(path)
        if isinstance(target, int) or _is(target, stat.S_ISFIFO):
            return
        if not target.parent.is_dir():
            raise InputError(f"cannot write {path}: there is no folder {target.parent}; make it first")
        _try(target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; choose another place") from error


def check_folder(path: Path) -> None:
    """Raise where no file can be written into a folder, which is made, with those above it, if it is not there."""
    try:
        _try(next(place for place in (path, *path.absolute().parents) if place.exists()) / path.name)
    except OSError as error:
        raise InputError(f"cannot write into {path}: {error.strerror or error}; choose another place") from error


def is_standard_output(path: Path | str) -> bool:
    """Return whether a path names the standard output of this process."""
    return _descriptor(Path(path)) == 1


def path_beside(path: Path, file: Path) -> str:
    """Return a path as an output file records it: relative to its folder, or absolute where that means nothing.

    Args:
        path: file or folder that exists.
    """
    if _descriptor(file) is not None:
        return path.resolve().as_posix()
    try:
        return Path(os.path.relpath(path.resolve(), file.resolve().parent)).as_posix()
    except ValueError:  # on another drive there is no relative path
        return path.resolve().as_posix()


def _target(path: Path) -> Path | int:
    """Return the file that a path leads to, or the number of the open stream that it names."""
    descriptor = _descriptor(path)
    if descriptor is not None:
        return descriptor
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise InputError(f"cannot write {path}: its links lead to each other; choose another place")
    if target.is_dir():
        raise InputError(f"{path} is a folder; name a file in it")
    if _is(target, lambda mode: stat.S_ISCHR(mode) or stat.S_ISBLK(mode) or stat.S_ISSOCK(mode)):
        raise InputError(f"{path} is a device or socket and is not written to; name a file")
    return target


def _descriptor(path: Path) -> int | None:
    """Return the number of the open stream that a path names, itself or by a link; None if it names none."""
    if os.name != "posix":
        return None
    found = _STREAM.fullmatch(os.path.abspath(path))
    if found is not None:
        return int(found[2]) if found[2] else {"out": 1, "err": 2}[found[1]]
    for number in (1, 2):
        with contextlib.suppress(OSError):
            entry = path.stat()
            if not stat.S_ISREG(entry.st_mode) and os.path.samestat(entry, os.fstat(number)):
                return number
    return None


def _is(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        return kind(path.stat().st_mode)
    except FileNotFoundError:
        return False


def _stream(target: Path | int, content: memoryview) -> None:
    """Write to a pipe, or to an open stream, which stays open."""
    with open(os.dup(target) if isinstance(target, int) else target, "wb") as file:
        file.write(content)


def _draft(target: Path) -> Path:
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}")


def _try(target: Path) -> None:
    """Begin a draft, and remove it: no look at permissions says what a file system lets be written."""
    draft = _draft(target)
    try:
        draft.open("xb").close()
    finally:
        draft.unlink(missing_ok=True)


def _replace(target: Path, write: Callable[[IO[bytes]], object]) -> None:
    _remove_abandoned(target)
    draft = _draft(target)
    file = draft.open("xb")
    try:
        with file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # else a power cut after the renaming could leave an empty file
        if target.exists():
            shutil.copymode(target, draft)
        os.replace(draft, target)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def _remove_abandoned(target: Path) -> None:
    """Remove drafts of a file that a killed process has left."""
    draft = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{8}}")
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if draft.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > ABANDONED:
                os.unlink(entry.path)
