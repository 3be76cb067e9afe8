"""Versioned JSON files: atomic writing, and reading of untrusted ones."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from falsework.errors import PlanError
from falsework.utils.files.input_file import read_text
from falsework.utils.files.output_file import write_whole
from falsework.utils.json_text import parse_json


def write_json(path: Path | str, data: Mapping[str, Any], spread: Container[str]) -> None:
    """Write JSON, whole or not at all: an entry a line, and a line for each element of the lists to spread."""
    # Short lines keep the file readable and a difference between two files small.
    lines = []
    for key, value in data.items():
        if key in spread and value:
            written = "[\n  " + ",\n  ".join(_dump(entry) for entry in value) + "\n ]"
        else:
            written = _dump(value)
        lines.append(f" {json.dumps(key)}: {written}")
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    write_whole(path, lambda file: file.write(text.encode("utf-8", "backslashreplace")))


def _dump(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def read_json(path: Path | str, kind: str = "JSON file", remedy: str = "write it again") -> Any:
    """Return the values in a JSON file.

    Args:
        kind: what it should be, in messages.
        remedy: what to do about a damaged file.
    """
    try:
        return parse_json(read_text(path))
    except FileNotFoundError:
        raise PlanError(f"there is no {kind} {path}") from None
    except IsADirectoryError:
        raise PlanError(f"{path} is a folder, not a {kind}; name another file") from None
    except OSError as error:
        raise PlanError(f"{path} cannot be read: {error.strerror}; name another file") from None
    except UnicodeDecodeError:
        raise PlanError(f"{path} cannot be read: it is no text in UTF-8; name another file") from None
    except ValueError as error:
        raise PlanError(f"{path} cannot be read: {error}; {remedy}") from None


_CHECKED_BY = {"plan": "falsework check", "robot plan": "falsework robots check"}
"""Commands that check files, by their kind."""


def check_format(data: Any, form: str, about: str, command: str) -> None:
    """Raise for values that are of another format: no other fault of theirs is worth a message.

    Args:
        about: beginning of the message.
        command: what writes such files.
    """
    found = format_in(data)
    if not found:
        raise PlanError(f'{about}it has no "format"; give a file that `{command}` wrote')
    of, _, version = found.partition("/")
    if version and of != form.partition("/")[0]:
        other = of.removeprefix("falsework.").replace("-", " ")
        own = f", or check this one by `{_CHECKED_BY[other]}`" if other in _CHECKED_BY else ""
        raise PlanError(f"{about}it is a file of another kind ({other}); give a file that `{command}` wrote{own}")
    if found != form:
        raise PlanError(f"{about}its format is {found!r}; this version reads {form!r} only; plan again")


def format_in(data: Any) -> str:
    """Return the entry `format` of the values of a file; empty if it has none."""
    form = data.get("format") if isinstance(data, dict) else None
    return form if isinstance(form, str) else ""


def read_format(path: Path | str) -> str:
    """Read the entry `format` of a JSON file; empty if it has none."""
    return format_in(read_json(path))
