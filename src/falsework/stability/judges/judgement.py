"""Judgement of an independent judge on a plan; the judges, which take long to import, are in modules beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from falsework.errors import InputError


@dataclass(frozen=True)
class Judgement:
    """How far a plan was built by discrete elements on springs as stiff as the contacts of the criterion."""

    built: int
    """States that came to rest or were left undecided, from the first on, in the order of assembly."""
    of: int
    """States of the plan."""
    falls_at: int | None = None
    """The next state if it collapses; None if it does not, or was not built before the time was up."""
    part: int = -1
    """The part that moved most there; -1 if nothing falls."""
    undecided: tuple[int, ...] = ()
    """States in which parts still moved at the step limit, without having collapsed."""

    @property
    def stands(self) -> bool:
        """Whether every state was built and none collapses."""
        return self.built == self.of

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**vars(self), "undecided": list(self.undecided)}

    @classmethod
    def read(cls, data: Any, states: int, parts: int) -> Judgement:
        """Read what `to_dict` returned for a plan of so many states and parts.

        Raises:
            InputError: anything else.
        """
        if not isinstance(data, dict) or set(data) != set(cls.__dataclass_fields__):
            raise InputError(f"it must have {', '.join(cls.__dataclass_fields__)}, and nothing else")
        built, falls_at, undecided = data["built"], data["falls_at"], data["undecided"]
        rows = [built, data["of"], *(undecided if isinstance(undecided, list) else [None])]
        if not all(type(row) is int and 0 <= row <= states for row in rows) or data["of"] != states:
            raise InputError(f"built, of and undecided must be numbers of states; the plan has {states}")
        known = falls_at is None or (type(falls_at) is int and falls_at == built < states)
        if not known or any(row >= built for row in undecided):
            raise InputError(f"{built} states were built, which does not go with falls_at or undecided")
        if type(data["part"]) is not int or not -1 <= data["part"] < parts:
            raise InputError(f"part is {data['part']!r}; it must be a part number below {parts}, or -1")
        return cls(built, states, falls_at, data["part"], tuple(undecided))
