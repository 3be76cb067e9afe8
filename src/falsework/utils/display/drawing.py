"""Functions that draw objects, by name: their layer depends on those of the objects, which must not know it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_drawers: dict[str, str] = {}


def register_drawers(**places: str) -> None:
    """Name functions that draw, `package.module:function`, by what they draw."""
    _drawers.update(places)


def drawn(what: str, *given: Any) -> Any:
    """Return what the function of a name makes of what it is given; its module is imported now."""
    module, _, name = _drawers[what].partition(":")
    return getattr(import_module(module), name)(*given)
