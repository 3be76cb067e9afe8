"""Versioned `.npz` files: a JSON header beside plain arrays, written whole or not at all, never pickled."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.utils.files.output_file import write_whole
from falsework.utils.json_text import parse_json
from falsework.utils.models import shown

_HEADER = "header"
_ROOM, _EXPANSION = 1 << 28, 256
"""Arrays of an archive may take 256 MiB, or so many times the size of the file if that is more: states that differ in a
few parts are packed to a hundredth, while an archive of zeros could claim a thousand times its size."""
_PIECE = 1 << 24
"""Bytes that are read at a time, so that no array is in memory twice."""


def write_archive(path: Path | str, form: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Save arrays with a header.

    Args:
        form: kind and version of the file, such as `falsework.graph/1`.
    """
    entries: dict[str, Any] = {_HEADER: np.array(json.dumps({"format": form, **header})), **arrays}
    write_whole(path, lambda file: np.savez_compressed(file, **entries))


def read_archive(
    path: Path | str, form: str, names: frozenset[str] | None = None, *, room: int = _ROOM
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what `write_archive` wrote.

    Format, names and sizes are checked before an array is read.

    Args:
        form: the one format and version that is accepted.
        names: the arrays that must be there and no others; unchecked if not given.
        room: bytes of arrays that are read in any case.

    Raises:
        InputError: no such file, not such a file, damaged, of another format or version, or one whose arrays are far
            larger than the file.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            if len(entries) < len(archive.infolist()):
                raise ValueError("an entry occurs twice")
            sizes = sum(entry.file_size for entry in entries.values())
            if sizes > (most := max(room, _EXPANSION * path.stat().st_size)):
                raise InputError(
                    f"{path} has {path.stat().st_size} bytes and claims arrays of {sizes}, more than the {most} that "
                    f"are read from such a file; it is damaged or not a {form} file; write it again"
                )
            if (described := entries.pop(f"{_HEADER}.npy", None)) is None:
                raise ValueError("it has no header")
            try:
                header = parse_json(str(_read_entry(archive, described)[()]))
            except ValueError as error:
                raise ValueError(f"its header cannot be read: {error}") from None
            _check_format(path, header, form)
            found = {name.removesuffix(".npy") for name in entries}
            if names is not None and found != names:
                odd = ", ".join(sorted(found ^ names))
                raise InputError(f"{path} is not a valid {form} file: unexpected or absent entries {odd}")
            return header, {name.removesuffix(".npy"): _read_entry(archive, entry) for name, entry in entries.items()}
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"there is no file {path}") from None
    except ValueError as error:
        raise InputError(f"{path} is damaged or not a {form} file: {error}; write it again") from None
    except Exception:  # zipfile and the unpackers below it fail in many ways on a damaged file
        raise InputError(f"{path} is damaged or not a {form} file: it is no whole .npz; write it again") from None


def read_array(path: Path | str) -> NDArray[Any]:
    """Read a `.npy` file, never pickled, whose size must be the one that it claims."""
    with open(path, "rb") as file:
        return _read_numbers(file, Path(path).stat().st_size)


def check_header(path: Path | str, header: Mapping[str, Any], kinds: Mapping[str, type], remedy: str) -> None:
    """Check the entries of the header of an archive.

    Args:
        header: as `read_archive` returns it, with its format.
        kinds: type of each entry that must be there, and no others, beside the format; `list` stands for a list of
            whole numbers.
        remedy: remedy for a damaged file.
    """
    if odd := set(header) ^ {"format", *kinds}:
        raise InputError(f"{path} is damaged: unexpected or absent header entries {', '.join(sorted(odd))}; {remedy}")
    for name, kind in kinds.items():
        value = header[name]
        if type(value) is not kind or (kind is list and not all(type(entry) is int for entry in value)):
            raise InputError(f"{path} is damaged: its header entry {name} is {str(value)[:40]!r}; {remedy}")


def _check_format(path: Path, header: Any, form: str) -> None:
    found = header.get("format") if isinstance(header, dict) else None
    if found != form:
        raise InputError(f"{path} has format {found!r}; this version reads {form!r} only")


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    if not entry.filename.endswith(".npy"):
        raise ValueError(f"its entry {shown(entry.filename)} is no array")
    with archive.open(entry) as file:
        try:
            return _read_numbers(file, entry.file_size)
        except Exception:  # NumPy fails in many ways on a damaged header
            raise ValueError(f"its array {shown(entry.filename)} is damaged") from None


def _read_numbers(file: IO[bytes], size: int) -> NDArray[Any]:
    """Read an array in NumPy's format from a stream of so many bytes."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, columns_first, kind = readers[version](file)
    if kind.hasobject or math.prod(shape) * kind.itemsize != size - file.tell():
        raise ValueError(f"an array of {size} bytes claims the shape {shape}")
    data = bytearray(size - file.tell())
    rest = memoryview(data)
    while len(rest):
        got = file.read(min(len(rest), _PIECE))
        if not got:
            raise ValueError("it ends early")
        rest[: len(got)], rest = got, rest[len(got) :]
    return np.frombuffer(data, dtype=kind).reshape(shape, order="F" if columns_first else "C")
