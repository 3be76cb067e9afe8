"""Versioned `.npz` files: a JSON header beside plain arrays, written whole or not at all, never pickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.utils.files.output_file import write_whole
from falsework.utils.json_text import parse_json

_HEADER = "header"


def write_archive(path: Path | str, form: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Save arrays with a header.

    Args:
        path: file to write, replaced if there.
        form: kind and version of the file, such as `falsework.graph/1`.
        header: JSON values.
        arrays: named arrays of numbers.
    """
    entries: dict[str, Any] = {_HEADER: np.array(json.dumps({"format": form, **header})), **arrays}
    write_whole(path, lambda file: np.savez_compressed(file, **entries))


def read_archive(
    path: Path | str, form: str, names: frozenset[str] | None = None
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what `write_archive` wrote.

    Args:
        path: file to read.
        form: the one format and version that is accepted.
        names: the arrays that must be there and no others; unchecked if not given.

    Raises:
        InputError: no such file, not such a file, damaged, or of another format or version.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        header = parse_json(str(arrays.pop(_HEADER)[()]))
    except FileNotFoundError:
        raise InputError(f"there is no file {path}") from None
    except Exception as error:  # NumPy and the unpackers below it fail in many ways on a damaged file
        raise InputError(f"{path} is damaged or not a {form} file ({type(error).__name__}); write it again") from None
    found = header.get("format") if isinstance(header, dict) else None
    if found != form:
        raise InputError(f"{path} has format {found!r}; this version reads {form!r} only")
    if names is not None and set(arrays) != names:
        odd = ", ".join(sorted(set(arrays) ^ names))
        raise InputError(f"{path} is not a valid {form} file: unexpected or absent entries {odd}")
    return header, arrays
