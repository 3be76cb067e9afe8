"""Pictures of states for layers below the one that draws them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

_painter = ""


def register_painter(place: str) -> None:
    """Name the function that draws a state, `package.module:function`; its layer depends on those that use it here."""
    global _painter
    _painter = place


def frame_of(assembly: Any, state: NDArray[Any], robots: int, words: str) -> NDArray[Any]:
    """Return a picture of a state, uint8, shape (height, width, 3), of one size for a structure.

    Args:
        state: of its parts, shape (parts,).
        robots: parts that may be held at once.
        words: the line above.
    """
    module, _, name = _painter.partition(":")
    return getattr(import_module(module), name)(assembly, state, robots, words)
