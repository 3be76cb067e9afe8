"""Letters that the font of Matplotlib lacks are drawn with a font of the machine that has them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from falsework.utils.display.fonts import fitting_fonts, font_families, font_file

font_manager = pytest.importorskip("matplotlib.font_manager", reason="pictures need Matplotlib")
SQUARE, BAR = chr(0x10FF10), chr(0x10FF11)
"""Private letters, which no font has but the one made here."""


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[Path]:
    """A font with two letters beside those of ASCII, known to Matplotlib as those of the machine are."""
    from fontTools.fontBuilder import FontBuilder
    from fontTools.pens.ttGlyphPen import TTGlyphPen

    glyphs, widths = {}, {".notdef": 500, "square": 1000, "bar": 1000}
    for name, width in ((".notdef", 100), ("square", 800), ("bar", 200)):
        pen = TTGlyphPen(None)
        pen.moveTo((0, 0))
        for corner in ((0, 800), (width, 800), (width, 0)):
            pen.lineTo(corner)
        pen.closePath()
        glyphs[name] = pen.glyph()
    font = FontBuilder(1000)
    font.setupGlyphOrder(list(glyphs))
    font.setupCharacterMap({ord(SQUARE): "square", ord(BAR): "bar"})
    font.setupGlyf(glyphs)
    font.setupHorizontalMetrics({name: (width, 0) for name, width in widths.items()})
    font.setupHorizontalHeader(ascent=800, descent=-200)
    font.setupNameTable({"familyName": "Falsework Letters", "styleName": "Regular"})
    font.setupOS2()
    font.setupPost()
    path = tmp_path / "letters.ttf"
    font.save(path)
    fonts = font_manager.fontManager
    known = list(fonts.ttflist)
    fonts.addfont(path)
    yield path
    fonts.ttflist[:] = known


def test_fonts_have_the_letters_of_a_text_between_them(installed: Path) -> None:
    assert font_families("größe λ") == ["DejaVu Sans"]
    assert font_families(f"block {SQUARE}") == ["DejaVu Sans", "Falsework Letters"]
    assert font_file("größe λ") == font_manager.findfont("DejaVu Sans")
    assert font_file(SQUARE + BAR) == str(installed)


@pytest.mark.parametrize("form", ["png", "svg"])
def test_texts_of_figures_are_drawn_with_them(installed: Path, form: str, tmp_path: Path) -> None:
    """A font draws the same box for each letter that it lacks."""
    from matplotlib.figure import Figure

    drawn = []
    for letter in (SQUARE, BAR):
        figure = Figure(figsize=(1, 1))
        text = figure.text(0.1, 0.5, f"a {letter}")
        file = tmp_path / f"{ord(letter)}.{form}"
        with fitting_fonts(figure):
            figure.savefig(file, metadata={"Date": None} if form == "svg" else None)
        assert "Falsework Letters" in text.get_fontfamily()
        drawn.append(file.read_bytes())
    assert drawn[0] != drawn[1]


def test_what_to_install_is_said_once() -> None:
    """In one warning, in place of one for each letter."""
    program = f"""
import io, warnings
from matplotlib.figure import Figure
from falsework.utils.display.fonts import fitting_fonts
warnings.simplefilter("always")
for letter in ({SQUARE!r}, {BAR!r}):
    figure = Figure()
    figure.text(0.5, 0.5, letter)
    with fitting_fonts(figure):
        figure.savefig(io.BytesIO())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.count("FontWarning: no font of this machine has some letters") == 1
    assert "fonts-noto-cjk" in done.stderr
    assert "Glyph" not in done.stderr
