"""TOML table reader whose errors name the file and the key."""

from __future__ import annotations

import difflib
import math
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import CellError

Array = NDArray[np.float64]


class Table:
    """One table of a TOML file; keys that are read are recorded, and any remaining key is an error."""

    def __init__(self, source: str, where: str, values: Any) -> None:
        self.source, self.where = source, where
        if not isinstance(values, dict):
            raise CellError(f"{source}: {where or 'the file'} is not a table; write it as [{where}]")
        self._values: dict[str, Any] = dict(values)
        self._known: list[str] = []

    @staticmethod
    def parse(source: str, text: str) -> Table:
        """Return a whole file.

        Raises:
            CellError: not TOML; the message has the line.
        """
        try:
            return Table(source, "", tomllib.loads(text))
        except RecursionError:
            raise CellError(f"{source} is nested too deeply; write it with tables") from None
        except ValueError as error:  # of its syntax, or a number with thousands of digits
            raise CellError(f"{source} is not valid TOML: {' '.join(str(error).split())}") from error

    def name(self, key: str) -> str:
        """Return a key as messages call it, such as `robots[0].base`."""
        return f"{self.where}.{key}" if self.where else key

    def fail(self, key: str, problem: str) -> CellError:
        """Return an error about a key."""
        return CellError(f"{self.source}: {self.name(key)} {problem}")

    def has(self, key: str) -> bool:
        """Return whether a key is there."""
        self._known.append(key)
        return key in self._values

    def take(self, key: str) -> Any:
        """Return the value of a key that must be there.

        Raises:
            CellError: it is not.
        """
        if not self.has(key):
            raise CellError(f"{self.source}: {self.name(key)} is missing")
        return self._values[key]

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string."""
        if default is not None and not self.has(key):
            return default
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise self.fail(key, f"is {value!r}; give a text in quotes")
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Return a number between bounds."""
        if default is not None and not self.has(key):
            return default
        value = self.take(key)
        if not _is_number(value):
            raise self.fail(key, f"is {value!r}; give a number")
        if not low <= value <= high:
            wanted = f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise self.fail(key, f"is {value:g}; give a number {wanted}")
        return float(value)

    def numbers(self, key: str, count: int, default: Iterable[float] | None = None) -> Array:
        """Return a list of numbers of a given length."""
        if default is not None and not self.has(key):
            return np.array(list(default), float)
        value = self.take(key)
        if not isinstance(value, list) or len(value) != count or not all(map(_is_number, value)):
            raise self.fail(key, f"is {value!r}; give {count} numbers in brackets")
        return np.array(value, float)

    def table(self, key: str) -> Table:
        """Return a table inside; empty where it is not there."""
        return Table(self.source, self.name(key), self._values[key] if self.has(key) else {})

    def tables(self, key: str) -> list[Table]:
        """Return an array of tables; empty where it is not there."""
        value = self._values[key] if self.has(key) else []
        if not isinstance(value, list):
            raise self.fail(key, f"is not a list; write each as [[{self.name(key)}]]")
        return [Table(self.source, f"{self.name(key)}[{index}]", entry) for index, entry in enumerate(value)]

    def names(self) -> list[str]:
        """Return all keys."""
        return list(self._values)

    def done(self) -> None:
        """Raise for a key that was not read: most often a typing error."""
        for key in self._values:
            if key not in self._known:
                near = difflib.get_close_matches(key, self._known, 1)
                hint = f"; did you mean {near[0]}?" if near else f"; known are {', '.join(sorted(set(self._known)))}"
                raise self.fail(key, f"is not known{hint}")


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number that a float holds."""
    known = isinstance(value, (int, float)) and not isinstance(value, bool)
    return known and abs(value) <= sys.float_info.max


def read_text(path: Path) -> str:
    """Return the text of a cell file.

    Raises:
        CellError: it is not there or no text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise CellError(f"cell file {path} cannot be read: {reason}") from error
