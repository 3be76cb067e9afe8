"""Printable PDF of assembly instructions: a picture, the action and a check box for every step."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.errors import DependencyError, InputError
from falsework.interop.instruction_table import (
    AssemblyInstruction,
    AssemblyInstructions,
    assembly_instructions,
    way_in_words,
    write_sheet,
)
from falsework.utils.files.formats import Exporter
from falsework.viewer.appearance import appearance_at
from falsework.viewer.arrows import arrows_of_step
from falsework.viewer.palette import INK, PRESS, mix, robot_color
from falsework.viewer.pictures.contact_sheet import draw
from falsework.viewer.pictures.render import Camera

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Progress = Callable[[int, int], None]

_POINT = 72.0 / 25.4
"""Points a millimetre."""
_PAGE = (210.0 * _POINT, 297.0 * _POINT)
"""Width and height of a page, A4, in points like all lengths below."""
_MARGIN = 14.0 * _POINT
"""Space at the left and the right of a page."""
_ROW = 41.0 * _POINT
"""Height of the row of a step."""
_FIRST_TOP = 58.0 * _POINT
"""Space above the rows of the first page, which has the title."""
_TOP = 16.0 * _POINT
"""Space above the rows of other pages."""
_PICTURE = (60.0 * _POINT, 38.0 * _POINT)
"""Width and height of the picture of a step."""
_COLUMNS = (0.0, 13.0 * _POINT, 76.0 * _POINT, 126.0 * _POINT)
"""Left edges of the columns: number, picture, action, parts to hold."""
_LISTED_PARTS = 12
"""Names of parts in one line; the rest is a number."""
_LISTED_PRESSES = 2
"""Presses of one step for which there is room."""
CAMERA = Camera(width=480, height=304, zoom=0.96)
"""Default camera of the pictures."""
_REGULAR, _BOLD = "FalseworkSans", "FalseworkSans-Bold"
_GREY = "#77797d"


def instructions_pdf(
    sheet: AssemblyInstructions, *, camera: Camera = CAMERA, progress: Progress | None = None
) -> bytes:
    """Return a PDF of A4 pages.

    Args:
        sheet: assembly instructions.
        camera: how the pictures look at the structure.
        progress: called with the number of pictures drawn and of all.

    Raises:
        DependencyError: reportlab or matplotlib, whose fonts are used, is not installed.
    """
    for name in ("reportlab", "matplotlib"):
        if find_spec(name) is None:
            raise DependencyError(f"a sheet as PDF needs {name}; pip install 'falsework[sheet]', or write .csv")
    from reportlab import rl_config
    from reportlab.pdfgen.canvas import Canvas

    rl_config.useA85 = 0  # pictures as bytes: their ASCII form is a quarter longer, and slow to write
    _register_fonts()
    buffer = io.BytesIO()
    canvas = Canvas(buffer, pagesize=_PAGE, pageCompression=1, invariant=1)
    canvas.setTitle(f"{sheet.assembly.name}: how to build it")
    canvas.setCreator("falsework")
    pages = list(_pages(sheet))
    done = 0
    for number, steps in enumerate(pages, 1):
        top = _FIRST_TOP if number == 1 else _TOP
        if number == 1:
            _head(canvas, sheet)
        for row, step in enumerate(steps):
            _row(canvas, sheet, step, _PAGE[1] - top - (row + 1) * _ROW, camera)
            done += 1
            if progress is not None:
                progress(done, len(sheet.steps))
        _foot(canvas, sheet, number, len(pages))
        canvas.showPage()
    canvas.save()
    return buffer.getvalue()


def _pages(sheet: AssemblyInstructions) -> Iterator[tuple[AssemblyInstruction, ...]]:
    """Yield steps of each page; the first has room for fewer."""
    room = _PAGE[1] - _MARGIN
    first, rest = int((room - _FIRST_TOP) // _ROW), int((room - _TOP) // _ROW)
    yield sheet.steps[:first]
    for begin in range(first, len(sheet.steps), rest):
        yield sheet.steps[begin : begin + rest]


def _head(canvas: Canvas, sheet: AssemblyInstructions) -> None:
    """Draw the title, the glossary, and the rules on which the proofs rest."""
    assembly, left, y = sheet.assembly, _MARGIN, _PAGE[1] - _MARGIN - 8
    _text(canvas, left, y, assembly.name, _BOLD, 18, width=_PAGE[0] - 2 * _MARGIN)
    placed = [step.part for step in sheet.steps if step.place]
    mass = float(assembly.mass.mass[placed].sum())
    facts = f"{len(placed)} parts to place, {mass:.4g} kg; {sheet.supports} supports, {len(sheet.steps)} steps"
    _text(canvas, left, y - 16, facts, _REGULAR, 10.5)
    lines = [
        "A support is a robot, a prop or a pair of hands that keeps a part exactly where it is. Keep to the order.",
        "Never release a part before the sheet says so: the states between steps were proved to stand, no others.",
        f"The proofs hold for friction of at least {assembly.friction:g} and parts of the masses given, at rest, "
        "where the model has them.",
        "Axes: x to the right in plan, y away, z up. Dark parts are fixed. Pictures show the state after the step.",
    ]
    if any(step.presses for step in sheet.steps):
        lines.append(
            "PRESS: a support pushes its part with the force given while the other part is released, then stays there."
        )
    if sheet.start:
        lines.append(f"There before step 1: {_shortened(sheet, sheet.start)}.")
    if sheet.holding(0):
        held = ", ".join(f"{sheet.name(part)} by support {support + 1}" for part, support in sheet.holding(0))
        lines.append(f"Held before step 1: {held}.")
    needed = [step for step in sheet.steps if step.needed]
    if needed:
        when = ", ".join(f"{sheet.name(step.part)} for step {step.number}" for step in needed)
        lines.append(f"Not delivered yet, and needed: {when}.")
    for number, line in enumerate(lines):
        _text(canvas, left, y - 32 - 11.5 * number, line, _REGULAR, 8.3, width=_PAGE[0] - 2 * _MARGIN)
    x, y = left, y - 36 - 11.5 * len(lines)
    for support in range(sheet.supports):
        canvas.setFillColor(robot_color(support))
        canvas.rect(x, y - 2, 10, 10, stroke=0, fill=1)
        x = _text(canvas, x + 14, y, f"support {support + 1}", _REGULAR, 9) + 16
    _text(canvas, x, y, "pale: just released", _REGULAR, 9)


def _row(canvas: Canvas, sheet: AssemblyInstructions, step: AssemblyInstruction, y: float, camera: Camera) -> None:
    """Draw one step, between `y` and `y` plus the height of a row."""
    left, top = _MARGIN, y + _ROW
    canvas.setStrokeColor("#d5d3cd")
    canvas.setLineWidth(0.5)
    canvas.line(left, top, _PAGE[0] - _MARGIN, top)
    _text(canvas, left, top - 17, str(step.number), _BOLD, 14)
    canvas.setStrokeColor(INK)
    canvas.rect(left, top - 42, 13, 13, stroke=1, fill=0)
    canvas.drawImage(
        _picture(sheet, step, camera), left + _COLUMNS[1], y + 1.5 * _POINT, *_PICTURE, preserveAspectRatio=True
    )
    x, width = left + _COLUMNS[2], _COLUMNS[3] - _COLUMNS[2] - 8
    color = robot_color(step.support)
    canvas.setFillColor(color if step.place else mix(color, "#ffffff", 0.55))
    canvas.rect(x, top - 17, 9, 9, stroke=0, fill=1)
    _text(canvas, x + 13, top - 16, step.verb.upper(), _BOLD, 10.5)
    _text(canvas, x, top - 33, sheet.name(step.part), _BOLD, 13, width=width)
    mass = float(sheet.assembly.mass.mass[step.part])
    if step.way is not None:
        _text(canvas, x, top - 47, f"{mass:.4g} kg, comes in {way_in_words(step.way)}", _REGULAR, 8.3, width=width)
        _text(canvas, x, top - 59, f"and is held by support {step.support + 1}", _REGULAR, 8.3, width=width)
    else:
        _text(canvas, x, top - 47, f"support {step.support + 1} lets go and is free", _REGULAR, 8.3, width=width)
        presses = sheet.pressing(step)
        for number, (what, how) in enumerate(presses[:_LISTED_PRESSES]):
            more = len(presses) - _LISTED_PRESSES if number + 1 == _LISTED_PRESSES else 0
            how += f", and {more} more" if more > 0 else ""
            line = top - 59 - 22 * number
            _text(canvas, x, line, f"PRESS {what}", _BOLD, 8.3, color=PRESS, width=width)
            _text(canvas, x, line - 10, how, _REGULAR, 8.3, color=PRESS, width=width)
    if step.needed:
        _text(canvas, x, top - 72, "was late: is it there?", _BOLD, 8.3, width=width)
    _text(
        canvas,
        x,
        y + 8,
        f"{step.placed} part{'' if step.placed == 1 else 's'} placed{'; ' if step.margins else ''}{step.margins}",
        _REGULAR,
        8.3,
        color=_GREY,
        width=width,
    )
    x, width = left + _COLUMNS[3], _PAGE[0] - 2 * _MARGIN - _COLUMNS[3]
    _text(canvas, x, top - 16, "HOLD until released" if step.hold else "nothing is held", _REGULAR, 8.3, color=_GREY)
    lines = max(int((_ROW - 30) // 13), 1)
    shown = step.hold if len(step.hold) <= lines else step.hold[: lines - 1]
    for number, (part, support) in enumerate(shown):
        line = top - 32 - 13 * number
        canvas.setFillColor(robot_color(support))
        canvas.rect(x, line - 1, 8, 8, stroke=0, fill=1)
        _text(canvas, x + 12, line, sheet.name(part), _REGULAR, 9.5, width=width - 12)
    if len(shown) < len(step.hold):
        more = f"and {len(step.hold) - len(shown)} more that are coloured"
        _text(canvas, x, top - 32 - 13 * len(shown), more, _REGULAR, 8.3)


def _foot(canvas: Canvas, sheet: AssemblyInstructions, number: int, pages: int) -> None:
    y = _MARGIN - 16
    about = f"{sheet.assembly.name}, structure {sheet.assembly.identity[:12]}"
    _text(canvas, _MARGIN, y, about, _REGULAR, 7.5, color=_GREY, width=_PAGE[0] / 2)
    canvas.setFont(_REGULAR, 7.5)
    canvas.setFillColor(_GREY)
    canvas.drawRightString(_PAGE[0] - _MARGIN, y, f"page {number} of {pages}")


def _picture(sheet: AssemblyInstructions, step: AssemblyInstruction, camera: Camera) -> Any:
    """Return the state after a step, as an image for the page."""
    from PIL import Image
    from reportlab.lib.utils import ImageReader

    marks = {} if step.place else {step.part: mix(robot_color(step.support), "#ffffff", 0.55)}
    look = appearance_at(sheet.timeline, step.number, marks=marks, travelling=False)
    arrows = list(arrows_of_step(sheet.timeline, step.number).values())
    pixels = np.rint(255 * draw(sheet.assembly, look, camera, arrows=arrows, samples=2)).astype(np.uint8)
    # JPEG goes into the page as it is, a fifth of the size of what the page would make of the pixels.
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=88, subsampling=0)
    file.seek(0)
    return ImageReader(file)


def _text(
    canvas: Canvas,
    x: float,
    y: float,
    text: str,
    font: str,
    size: float,
    *,
    color: str = INK,
    width: float | None = None,
) -> float:
    """Write a line, smaller or cut short if there is no room for it, and return where it ends."""
    if width is not None:
        size = max(0.7 * size, min(size, size * width / max(canvas.stringWidth(text, font, size), 1e-9)))
        while len(text) > 1 and canvas.stringWidth(text, font, size) > width:
            text = text[:-2] + "…"
    canvas.setFillColor(color)
    canvas.setFont(font, size)
    canvas.drawString(x, y, text)
    return x + canvas.stringWidth(text, font, size)


def _shortened(sheet: AssemblyInstructions, parts: tuple[int, ...]) -> str:
    names = ", ".join(sheet.name(part) for part in parts[:_LISTED_PARTS])
    return names if len(parts) <= _LISTED_PARTS else f"{names} and {len(parts) - _LISTED_PARTS} more"


def _register_fonts() -> None:
    """Register fonts with more glyphs than the standard PDF fonts; they come with matplotlib."""
    import matplotlib
    from reportlab.pdfbase.pdfmetrics import getRegisteredFontNames, registerFont
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name, file in ((_REGULAR, "DejaVuSans.ttf"), (_BOLD, "DejaVuSans-Bold.ttf")):
        if name not in getRegisteredFontNames():
            registerFont(TTFont(name, folder / file))


def _write_pdf(
    path: Path | str,
    assembly: Assembly,
    plan: Plan,
    *,
    azimuth: float = CAMERA.azimuth,
    elevation: float = CAMERA.elevation,
    progress: Progress | None = None,
) -> None:
    if not -90 < elevation < 90 or elevation == 0:
        raise InputError(f"an elevation of {elevation:g} degrees sees nothing; give one such as 24")
    camera = replace(CAMERA, azimuth=azimuth, elevation=elevation)
    sheet = assembly_instructions(plan, assembly)
    write_sheet(path, instructions_pdf(sheet, camera=camera, progress=progress))


PDF = Exporter(_write_pdf, (".pdf",), ("Plan",), ("azimuth", "elevation", "progress"))
