"""Versioned JSON files: atomic writing, and strict reading with precise errors."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from falsework.errors import PlanError
from falsework.utils.files.output_file import write_whole
from falsework.utils.json_text import parse_json


def write_json(path: Path | str, data: Mapping[str, Any], spread: Container[str]) -> None:
    """Write JSON, whole or not at all: an entry a line, and a line for each element of the lists to spread.

    Raises:
        InputError: the file cannot be written.
    """
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


class Reader:
    """Strict reader of JSON values with precise errors.

    A subclass for one kind of file gives its name in messages, the format, and the command that writes it.
    """

    kind: ClassVar[str]
    form: ClassVar[str]
    command: ClassVar[str]

    def __init__(self, source: str) -> None:
        self._source = source

    @classmethod
    def load(cls, path: Path | str) -> Any:
        """Return the JSON values in a file.

        Raises:
            PlanError: no such file, or no JSON.
        """
        path = Path(path)
        try:
            return parse_json(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise PlanError(f"there is no {cls.kind} file {path}") from None
        except OSError as error:
            raise PlanError(f"{path} cannot be read: {error.strerror}; name a file of `{cls.command}`") from None
        except UnicodeDecodeError:
            raise PlanError(f"{path} is not a {cls.kind}: it is no text; name a file of `{cls.command}`") from None
        except json.JSONDecodeError:
            raise PlanError(f"{path} is not valid JSON; it may be truncated; plan again") from None
        except ValueError as error:
            raise PlanError(f"{path} cannot be read as a {cls.kind}: {error}; plan again") from None

    def _header(self, data: Any, keys: set[str], optional: frozenset[str] = frozenset()) -> None:
        """Check the format first: for a file of another version no other error is reported."""
        if not isinstance(data, dict) or "format" not in data:
            self._fail('it has no "format"', f"give a file that `{self.command}` wrote")
        if data["format"] != self.form:
            of, _, version = str(data["format"]).partition("/")
            if version and of != self.form.partition("/")[0]:
                other = of.removeprefix("falsework.").replace("-", " ")
                self._fail(f"it is a file of another kind ({other})", f"give a file that `{self.command}` wrote")
            self._fail(f"its format is {data['format']!r}", f"this version reads {self.form!r} only; plan again")
        self._keys(data, keys, f"the {self.kind}", optional)

    def _keys(self, value: Any, keys: set[str], place: str, optional: frozenset[str] = frozenset()) -> None:
        if not isinstance(value, dict):
            self._fail(f"{place} is not an object")
        absent = sorted(keys - set(value))
        if absent:
            self._fail(f"{place} lacks {absent[0]!r}")
        unknown = sorted(set(value) - keys - optional)
        if unknown:
            self._fail(f"{place} has an unknown entry {unknown[0]!r}", "it may be from another version; plan again")

    def _list(self, value: Any, place: str) -> list[Any]:
        if not isinstance(value, list):
            self._fail(f"{place} is not a list")
        return value

    def _fail(self, what: str, remedy: str = "the file is damaged; plan again") -> NoReturn:
        raise PlanError(f"{self._source} is not a valid {self.kind}: {what}; {remedy}")


def read_format(path: Path | str) -> str:
    """Read the entry `format` of a JSON file; empty if it has none.

    Raises:
        PlanError: it is no JSON.
    """
    try:
        content = parse_json(Path(path).read_text(encoding="utf-8"))
    except json.JSONDecodeError:
        raise PlanError(f"{path} is not valid JSON; it may be truncated; write it again") from None
    except OSError as error:
        raise PlanError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise PlanError(f"{path} is not valid JSON: it is no text; write it again") from None
    except ValueError as error:
        raise PlanError(f"{path} cannot be read: {error}; write it again") from None
    form = content.get("format") if isinstance(content, dict) else None
    return form if isinstance(form, str) else ""
