"""Judgement of an independent judge on a plan; the judges, which take long to import, are in modules beside it."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta
from msgspec.structs import asdict

from falsework.assembly.assembly_model import Count
from falsework.utils.models import FileModel


class Judgement(FileModel, frozen=True):
    """How far a plan was built by discrete elements on springs as stiff as the contacts of the criterion."""

    built: Count
    """States that came to rest or were left undecided, from the first on, in the order of assembly."""
    of: Annotated[int, Meta(ge=1)]
    """States of the plan."""
    falls_at: Count | None = None
    """The next state if it collapses; None if it does not, or was not built before the time was up."""
    part: Annotated[int, Meta(ge=-1)] = -1
    """The part that moved most there; -1 if nothing falls."""
    undecided: tuple[Count, ...] = ()
    """States in which parts still moved at the step limit, without having collapsed."""

    @property
    def stands(self) -> bool:
        """Whether every state was built and none collapses."""
        return self.built == self.of

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**asdict(self), "undecided": list(self.undecided)}
