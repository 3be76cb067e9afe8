"""Fonts and pictures on pages of PDF."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

REGULAR, BOLD = "FalseworkSans", "FalseworkSans-Bold"
"""Names of the fonts, once they are registered."""


def register_fonts() -> None:
    """Register fonts with more glyphs than the standard PDF fonts; they come with matplotlib."""
    import matplotlib
    from reportlab.pdfbase.pdfmetrics import getRegisteredFontNames, registerFont, registerFontFamily
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name, file in ((REGULAR, "DejaVuSans.ttf"), (BOLD, "DejaVuSans-Bold.ttf")):
        if name not in getRegisteredFontNames():
            registerFont(TTFont(name, folder / file))
    registerFontFamily(REGULAR, REGULAR, BOLD, REGULAR, BOLD)


def jpeg(image: NDArray[np.floating]) -> io.BytesIO:
    """Return a picture as a JPEG file: a fifth of the size of what a page would make of the pixels."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(file, "JPEG", quality=88, subsampling=0)
    file.seek(0)
    return file
