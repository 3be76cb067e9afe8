"""Values in COMPAS data with their paths in the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NoReturn, TypeVar

from falsework.errors import InputError
from falsework.utils.models import path_to, read_model

Kind = TypeVar("Kind")

_AGAIN = "write it again with compas.json_dump"


@dataclass(frozen=True, eq=False)
class CompasItem:
    """JSON value in a file."""

    value: Any
    about: str
    """Beginning of messages, with the name of the file."""
    where: str = ""
    """Path of the value in the file."""

    def read(self, kind: type[Kind]) -> Kind:
        """Convert the value to a model; InputError with the path of what does not fit."""
        return read_model(kind, self.value, self.about, InputError, self.where, f"; {_AGAIN}")

    def at(self, *steps: int | str) -> CompasItem:
        """Return the value at the end of some steps, each an entry of a list or object that is there."""
        found = self
        for step in steps:
            found = replace(found, value=found.value[step], where=path_to(found.where, step))
        return found

    def get(self, key: str) -> Any:
        """Return the value of an entry of an object; None if there is none, or it is no object."""
        return self.value.get(key) if isinstance(self.value, dict) else None

    def entries(self) -> Iterator[tuple[int | str, CompasItem]]:
        """Yield steps to the entries of a list or object, with these; none of another value."""
        kind = type(self.value)
        for step in self.value if kind is dict else range(len(self.value)) if kind is list else ():
            yield step, self.at(step)

    def opened(self) -> CompasItem:
        """Return the content of an object that may or may not be wrapped with the name of its class.

        The first version of COMPAS called the content `value`.
        """
        if isinstance(self.value, dict):
            for key in ("data", "value") if "dtype" in self.value else ("data",):
                if key in self.value:
                    return self.at(key)
        return self

    def several(self, key: str) -> Iterator[CompasItem]:
        """Yield the contents of the objects in an entry of an object: a list, one, or none."""
        if value := self.get(key):
            inside = self.at(key)
            for entry in [inside] if isinstance(value, dict) else [entry for _, entry in inside.entries()]:
                yield entry.opened()

    def fail(self, what: str, remedy: str = _AGAIN) -> NoReturn:
        """Refuse the file."""
        raise InputError(f"{self.about}{what}; {remedy}")
