"""Fonts of this machine for letters that the font of Matplotlib lacks, such as Chinese and Japanese ones."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

_BASE = "DejaVu Sans"
"""Font that comes with Matplotlib."""
_BOXES = "Last Resort"
"""Font of Matplotlib that has a box for every letter; begins its name."""


class FontWarning(UserWarning):
    """No font has letters of a text."""


def font_families(text: str) -> list[str]:
    """Return families that have the letters of a text between them, that of Matplotlib first; warn once of others."""
    from matplotlib.font_manager import findfont

    families, missing = [_BASE], _of(text) - _letters(findfont(_BASE))
    while missing:
        best = max(_candidates(), key=lambda entry: len(missing & _letters(entry.fname)))
        if not missing & _letters(best.fname):
            _warn()
            break
        families.append(best.name)
        missing = missing - _letters(best.fname)
    return families


def font_file(text: str) -> str:
    """Return the file of the font that has most letters of a text, that of Matplotlib if it has all that any has."""
    from matplotlib.font_manager import findfont

    files, letters = [findfont(_BASE), *(entry.fname for entry in _candidates())], _of(text)
    best = files[0] if letters <= _letters(files[0]) else max(files, key=lambda file: len(letters & _letters(file)))
    if letters - _letters(best):
        _warn()
    return best


@contextmanager
def fitting_fonts(figure: Any) -> Iterator[None]:
    """Give the texts of a figure of Matplotlib fonts that have their letters, while it is drawn."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if not text.get_text().isascii():
            text.set_fontfamily(font_families(text.get_text()))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # which is said once, with a remedy
        yield


def _of(text: str) -> frozenset[str]:
    """Return the letters of a text."""
    return frozenset("".join(text.split()))


def _candidates() -> list[Any]:
    """Return the upright fonts of this machine, those of usual weight first."""
    from matplotlib.font_manager import fontManager

    upright = [one for one in fontManager.ttflist if one.style == "normal" and not one.name.startswith(_BOXES)]
    return sorted(upright, key=lambda entry: str(entry.weight) not in ("400", "normal", "regular", "book"))


@cache
def _letters(file: str) -> frozenset[str]:
    """Return the letters that a font has; none if it cannot be read, as those made of pictures."""
    from matplotlib.ft2font import FT2Font

    try:
        return frozenset(map(chr, FT2Font(file).get_charmap()))
    except (RuntimeError, ValueError, OSError):
        return frozenset()


@cache
def _warn() -> None:
    """Warn, once in a process, of letters that no font has."""
    warnings.warn(
        "no font of this machine has some letters of the texts, which are boxes in pictures; install one that has "
        "them, such as Noto Sans CJK (Debian: fonts-noto-cjk)",
        FontWarning,
        stacklevel=3,
    )
