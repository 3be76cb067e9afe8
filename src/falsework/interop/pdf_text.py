"""Text and pictures on pages of PDF: lines that fit, paragraphs, fonts and images."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.viewer.palette import INK

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

REGULAR, BOLD = "FalseworkSans", "FalseworkSans-Bold"
"""Names of the fonts, once they are registered."""


def write_line(
    canvas: Canvas,
    x: float,
    y: float,
    text: str,
    font: str,
    size: float,
    *,
    color: str = INK,
    width: float | None = None,
    end: float | None = None,
) -> float:
    """Write a line, smaller if there is no room for it, and return where it ends; before `end` instead, if given."""
    if width is not None:
        size = min(size, size * width / max(canvas.stringWidth(text, font, size), 1e-9))
    canvas.setFillColor(color)
    canvas.setFont(font, size)
    if end is not None:
        canvas.drawRightString(end, y, text)
        return end
    canvas.drawString(x, y, text)
    return x + canvas.stringWidth(text, font, size)


def write_paragraph(
    canvas: Canvas, x: float, y: float, text: str, size: float, *, width: float, color: str = INK, leading: float = 10.0
) -> float:
    """Write a text in as many lines as it takes, and return the place of the line after it."""
    for line in broken_lines(text, size, width):
        write_line(canvas, x, y, line, REGULAR, size, color=color, width=width)
        y -= leading
    return y


def broken_lines(text: str, size: float, width: float) -> list[str]:
    """Return the lines of a text that is broken between words."""
    from reportlab.lib.utils import simpleSplit

    return simpleSplit(text, REGULAR, size, width)


def jpeg(image: NDArray[np.floating]) -> Any:
    """Return a picture for a page, as JPEG: a fifth of the size of what the page would make of the pixels."""
    from PIL import Image
    from reportlab.lib.utils import ImageReader

    file = io.BytesIO()
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(file, "JPEG", quality=88, subsampling=0)
    file.seek(0)
    return ImageReader(file)


def register_fonts() -> None:
    """Register fonts with more glyphs than the standard PDF fonts; they come with matplotlib."""
    import matplotlib
    from reportlab.pdfbase.pdfmetrics import getRegisteredFontNames, registerFont
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name, file in ((REGULAR, "DejaVuSans.ttf"), (BOLD, "DejaVuSans-Bold.ttf")):
        if name not in getRegisteredFontNames():
            registerFont(TTFont(name, folder / file))
